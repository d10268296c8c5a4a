"""The command ``vslam doctor``."""

from __future__ import annotations

from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.console import Console
from vslam.cli.options import (
    Thresholds,
    open_given,
    option,
    read_thresholds,
    reads_source,
    require_data,
)
from vslam.support.errors import InputError, counted
from vslam.support.options import OUTPUT

if TYPE_CHECKING:
    from vslam.types.source_options import SourceOptions

_EXAMPLES = """
[b]Examples[/b]
  vslam doctor ~/euroc/V1_01_easy
  vslam doctor drive.mp4 --side-by-side --calib stereo.yaml
  vslam doctor ~/kitti --seq 06 --calib camchain.yaml --out doctor.html
"""


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@reads_source()
def doctor(
    given: SourceOptions,
    config: Thresholds = None,
    out: Annotated[
        Path | None,
        option(
            OUTPUT,
            "FILE",
            "HTML page to write. An existing file is replaced.",
            unset="doctor.html, or doctor-2.html and so on",
        ),
    ] = None,
) -> None:
    """Check images, calibration and timestamps before a run.

    The exit code is 1 if the check finds a fault.
    """
    from vslam.datasets.frames import first_frames
    from vslam.doctor.examine import Diagnosis, examine, write_page
    from vslam.doctor.findings import Finding, lines

    require_data(given)
    thresholds = read_thresholds(config)
    try:
        diagnosis = examine(first_frames(open_given(given, Console(shown=True))), thresholds)
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        diagnosis = Diagnosis([Finding("input", "fault", measured or fix, fix if measured else "")])
    for line in lines(diagnosis.findings):
        typer.echo(line)
    page = out or _unused_path(Path("doctor.html"))
    # The findings are printed first, because the disk may be full.
    write_page(diagnosis, f"Doctor: {given.data or given.dataset}", page)
    n = len(diagnosis.faults)
    typer.echo(f"{page}: {counted(n, 'fault') if n else 'no faults'}")
    if diagnosis.faults:
        raise typer.Exit(1)


def _unused_path(path: Path) -> Path:
    numbered = (path.with_stem(f"{path.stem}-{n}") for n in count(2))
    return next(one for one in chain((path,), numbered) if not one.exists())
