"""The command ``vslam eval``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import AlignmentName

_EXAMPLE = "[b]Example[/b]\n  vslam eval runs/latest/trajectory.tum --gt groundtruth.tum"


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command("eval", epilog=_EXAMPLE)(evaluate_files)


def evaluate_files(
    estimate: Annotated[Path, typer.Argument(help="Trajectory in the format of KITTI or TUM.")],
    gt: Annotated[
        Path, typer.Option(metavar="FILE", help="Ground truth in the format of KITTI or TUM.")
    ],
    align: Annotated[
        AlignmentName,
        typer.Option(
            metavar="se3|sim3|none",
            help="Alignment with the ground truth; [b]sim3[/b] also fits the scale.",
        ),
    ] = "se3",
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="times.txt of the sequence, to compare a KITTI file with a TUM file.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Compare a trajectory with the ground truth: ATE, RPE and KITTI drift."""
    import json

    from vslam.cli.tables import print_rows
    from vslam.evaluation.trajectories import evaluate_trajectory, evo_command, read_pair
    from vslam.trajectory import trajectory_format

    trajectory, ground_truth = read_pair(estimate, gt, times)
    evaluation = evaluate_trajectory(trajectory, ground_truth, align)
    if as_json:
        typer.echo(json.dumps(evaluation.summary(), indent=2))
        return
    matched = f"{evaluation.frames} of {len(trajectory)} have a ground truth"
    rows = [
        ("frames", matched),
        ("alignment", align),
        ("ATE RMSE", f"{evaluation.ate_rmse_m:.3f} m"),
        ("ATE mean, max", f"{evaluation.ate_mean_m:.3f} m, {evaluation.ate_max_m:.3f} m"),
        ("RPE per frame", f"{evaluation.rpe_m:.4f} m, {evaluation.rpe_deg:.4f} deg"),
    ]
    if evaluation.t_rel_percent is None:
        rows.append(("drift", "path shorter than 100 m"))
    else:
        rows.append(("t_rel", f"{evaluation.t_rel_percent:.3f} %"))
        rows.append(("r_rel", f"{evaluation.r_rel_deg_per_100m:.3f} deg/100 m"))
    # evo compares files of one format, and no straight lines.
    format_ = trajectory_format(gt)
    if format_ == trajectory_format(estimate) and not evaluation.on_one_line:
        rows.append(("reproduce", evo_command(estimate, gt, align, format_)))
    print_rows(rows)
