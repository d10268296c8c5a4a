"""The command ``vslam eval``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import AlignmentName
from vslam.support.errors import InputError

if TYPE_CHECKING:
    from vslam.report.schema import ReportJson

_EXAMPLES = """
[b]Examples[/b]
  vslam eval runs/latest
  vslam eval runs/latest --gt groundtruth.tum
  vslam eval orbslam3.txt --gt ~/kitti/poses/00.txt
"""


app = typer.Typer()


@app.command("eval", epilog=_EXAMPLES)
def evaluate_files(
    estimate: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|FILE",
            help="Folder of a run, or a trajectory in the format of KITTI, TUM or EuRoC.",
        ),
    ],
    gt: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Ground truth in the format of KITTI, TUM or EuRoC.",
            show_default="the ground truth of the run",
        ),
    ] = None,
    align: Annotated[
        AlignmentName | None,
        typer.Option(
            metavar="se3|sim3|none",
            help="Alignment with the ground truth. [b]sim3[/b] also fits the scale.",
            show_default="sim3 for a monocular run without an IMU, otherwise se3",
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="times.txt of the sequence. It is needed to compare a KITTI file with a file of "
            "another format.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Compare the trajectory of a run or of a file with the ground truth.

    The command prints ATE, RPE and the drift as KITTI defines it.
    """
    import json

    from vslam.cli.tables import show_sections
    from vslam.evaluation.trajectories import (
        command_of_evo,
        evaluate_trajectory,
        evaluation_warnings,
        read_pair,
    )
    from vslam.report.page import Alert, Pairs, Section
    from vslam.run.outcome import alignment_of

    alignment: str = align or "se3"
    sensor = None
    if estimate.is_dir():
        estimate, gt, report = _files_of_run(estimate, gt, times)
        sensor, metric = report.sensor, report.metric_since_s is not None
        alignment = align or alignment_of(sensor, metric=metric)
    elif gt is None:
        raise InputError(
            f"{estimate}: give its ground truth with --gt, or give the folder of a run that has "
            "one, such as runs/latest; for a video or images, use vslam run first."
        )
    trajectory, ground_truth = read_pair(estimate, gt, times)
    evaluation = evaluate_trajectory(trajectory, ground_truth, alignment)
    warnings = evaluation_warnings(evaluation, sensor)
    if sensor is not None and gt.resolve().parent.name == "state_groundtruth_estimate0":
        warnings.append(
            f"{gt} has the poses of the IMU, and the run those of the left camera: leave out --gt "
            "to use the ground truth of the camera"
        )
    if as_json:
        typer.echo(json.dumps(evaluation.summary() | {"warnings": warnings}, indent=2))
        return
    matched = f"{evaluation.frames} of {len(trajectory)} have a ground truth"
    rows = [
        ("frames", matched),
        ("alignment", alignment),
        ("ATE RMSE", f"{evaluation.ate_rmse_m:.4f} m"),
        ("ATE mean, max", f"{evaluation.ate_mean_m:.4f} m, {evaluation.ate_max_m:.4f} m"),
        ("RPE per frame", f"{evaluation.rpe_m:.4f} m, {evaluation.rpe_deg:.4f} deg"),
    ]
    if evaluation.t_rel_percent is None:
        rows.append(("drift", "path shorter than 100 m"))
    else:
        rows.append(("t_rel", f"{evaluation.t_rel_percent:.3f} %"))
        rows.append(("r_rel", f"{evaluation.r_rel_deg_per_100m:.3f} deg/100 m"))
    if (command := command_of_evo(estimate, gt, evaluation)) is not None:
        rows.append(("reproduce", command))
    alerts = [Alert(f"Warning: {warning}") for warning in warnings]
    show_sections([Section("", [*alerts, Pairs(rows)])])


def _files_of_run(
    folder: Path, gt: Path | None, times: Path | None
) -> tuple[Path, Path, ReportJson]:
    """Return the files of the trajectory and of the ground truth of a run, and its report."""
    from vslam.report.schema import ReportJson
    from vslam.types.trajectory import trajectory_format

    report = ReportJson.read(folder / "report.json")
    written = (folder / name for name in ("ground_truth_kitti.txt", "ground_truth.tum"))
    gt = gt or next((file for file in written if file.exists()), None)
    if gt is None:
        raise InputError(f"{folder}: this run had no ground truth; give one with --gt.")
    with_times = times is not None or trajectory_format(gt) != "kitti"
    name = "trajectory.tum" if with_times else "trajectory_kitti.txt"
    return folder / name, gt, report
