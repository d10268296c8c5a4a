"""The command ``vslam doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import (
    Calib,
    Dataset,
    Every,
    MaxFrames,
    SensorName,
    Seq,
    Start,
    Thresholds,
)
from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam doctor ~/euroc/V1_01_easy --dataset euroc

  vslam doctor ~/kitti --seq 06 --calib camchain.yaml --out doctor.html
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(doctor)


def doctor(
    source: Annotated[Path, typer.Argument(help="Folder with the data set, as --data of a run.")],
    dataset: Dataset = "kitti",
    seq: Seq = "00",
    calib: Calib = None,
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    sensor: Annotated[
        SensorName, typer.Option(help="[b]mono[/b] looks at the left camera alone.")
    ] = "stereo",
    config: Thresholds = None,
    out: Annotated[Path, typer.Option(help="HTML page to write.")] = Path("doctor.html"),
) -> None:
    """Check images, calibration and times before a run; exit code 1 if there is a fault."""
    from vslam.config import Config, load_config
    from vslam.datasets import open_sequence
    from vslam.doctor.examine import Diagnosis, examine
    from vslam.doctor.findings import Finding
    from vslam.doctor.page import write_page

    thresholds = Config() if config is None else load_config(config)
    try:
        sequence = open_sequence(
            dataset, source, seq,
            start=start, every=every, max_frames=max_frames, monocular=sensor == "mono",
            calib=calib or (),
        )  # fmt: skip
        diagnosis = examine(sequence, thresholds.orb)
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        diagnosis = Diagnosis([Finding("input", "fault", measured or fix, fix if measured else "")])
    write_page(diagnosis, f"Doctor: {source}", out)
    for finding in diagnosis.findings:
        typer.echo(f"{finding.verdict:<8} {finding.check:<16} {finding.measured}")
        if finding.fix:
            typer.echo(f"{'':<8} {'':<16} fix: {finding.fix}")
    typer.echo(f"{out}: {len(diagnosis.faults)} faults")
    if diagnosis.faults:
        raise typer.Exit(1)
