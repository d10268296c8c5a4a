"""The command ``vslam report``, which writes one report about many runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import Quiet, option
from vslam.support.errors import counted
from vslam.support.options import OUTPUT

_EXAMPLES = """
[b]Examples[/b]
  vslam report bench
  vslam report runs/20261121-1* other/bench --baseline bow --out comparison
  vslam report bench --trajectory ORB-SLAM3@00=orbslam3/00.txt
"""


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER", help="Folders of runs, at any depth."),
    ],
    trajectory: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="Trajectory of another system, in the format of KITTI or TUM. "
            "NAME@SEQ@PERTURB=FILE also gives its sequence and perturbation. The trajectory is "
            "aligned like the runs of the sequence. A NAME that ends in ', mono' also fits the "
            "scale.",
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Detector or system with which the others are compared.",
            show_default="the simplest detector",
        ),
    ] = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("report"),
    quiet: Quiet = False,
) -> None:
    """Compare finished runs in one report, with detectors side by side."""
    write_overview_of(runs, trajectory or [], out, baseline=baseline, quiet=quiet)


def write_overview_of(
    runs: list[Path],
    trajectories: list[str],
    out: Path,
    *,
    baseline: str | None = None,
    quiet: bool,
) -> None:
    """Write the report about finished runs. Unless ``quiet``, its first tables and its path are
    printed."""
    from vslam.cli.tables import show_sections
    from vslam_lab.overview.render import write_overview
    from vslam_lab.overview.versus import versus

    written = write_overview(runs, trajectories, out, baseline)
    if not quiet:
        show_sections(versus(written))
        for note in written.notes:
            typer.echo(f"note: {note}", err=True)
        typer.echo(f"\n{out / 'report.html'}: {counted(len(written.runs), 'run')}")
