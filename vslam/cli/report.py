"""The command ``vslam report``: one report of many runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_EXAMPLES = """
[b]Examples[/b]

  vslam report bench

  vslam report runs/20261121-1* other/bench --baseline bow --out comparison

  vslam report runs --serve

  vslam report bench --trajectory ORB-SLAM3@00=orbslam3/00.txt
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(report)


def report(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders of those.")],
    trajectory: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[@SEQ[@PERTURB]]=FILE",
            help="Trajectory of another system, KITTI or TUM format, to compare with; aligned as "
            "the runs of that sequence are, or with scale if its name ends in ', mono'.",
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Detector or system that the others are set against.",
            show_default="the simplest",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("report"),
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="Show a page of all runs, to be compared side by side, on this machine alone, "
            "until Ctrl-C; nothing is written.",
        ),
    ] = False,
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="Of --serve.", show_default="any that is free"),
    ] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing.")] = False,
) -> None:
    """Write one report of finished runs: detectors side by side, trajectories, curves."""
    if serve:
        serve_runs(runs, port)
        return
    write_overview_of(runs, trajectory or [], out, baseline=baseline, quiet=quiet)


def serve_runs(folders: list[Path], port: int) -> None:
    """Serve a page of the runs in some folders until Ctrl-C."""
    from vslam.lab.overview.serve import make_server

    with make_server(folders, port) as server:
        typer.echo(f"http://127.0.0.1:{server.server_port}/ shows the runs; Ctrl-C ends it")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            typer.echo("ended")


def write_overview_of(
    runs: list[Path],
    trajectories: list[str],
    out: Path,
    *,
    baseline: str | None = None,
    quiet: bool,
) -> None:
    """Write the report of finished runs; unless ``quiet``, show its first tables and say where it
    is."""
    from vslam.cli.tables import show_sections
    from vslam.lab.overview import write_overview
    from vslam.lab.overview.versus import versus

    written = write_overview(runs, trajectories, out, baseline)
    if not quiet:
        show_sections(versus(written))
        for note in written.notes:
            typer.echo(f"note: {note}", err=True)
        typer.echo(f"\n{out / 'report.html'}: {len(written.runs)} runs")
