"""The command ``vslam doctor``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import (
    Calib,
    Depth,
    DepthScale,
    Every,
    FramesPerSecond,
    MaxFrames,
    Right,
    Sensor,
    Seq,
    SideBySide,
    SourceKind,
    Start,
    Thresholds,
    Topics,
    kind_of_source,
    source_options,
)
from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam doctor ~/euroc/V1_01_easy

  vslam doctor drive.mp4 --side-by-side --calib stereo.yaml

  vslam doctor ~/kitti --seq 06 --calib camchain.yaml --out doctor.html
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(doctor)


def doctor(
    source: Annotated[str, typer.Argument(help="What to look at, as --data of a run.")],
    dataset: SourceKind = None,
    seq: Seq = None,
    calib: Calib = None,
    right: Right = None,
    depth: Depth = None,
    fps: FramesPerSecond = None,
    side_by_side: SideBySide = False,
    topics: Topics = "",
    depth_scale: DepthScale = None,
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    sensor: Sensor = None,
    config: Thresholds = None,
    out: Annotated[Path, typer.Option(help="HTML page to write.")] = Path("doctor.html"),
) -> None:
    """Check images, calibration and times before a run; exit code 1 if there is a fault."""
    from vslam.config import Config, load_config
    from vslam.datasets.frames import first_frames
    from vslam.datasets.sources import open_source
    from vslam.doctor.examine import Diagnosis, examine
    from vslam.doctor.findings import Finding
    from vslam.doctor.page import write_page

    thresholds = Config() if config is None else load_config(config)
    try:
        options = source_options(calib, right, depth, fps, side_by_side, topics, depth_scale)
        found = open_source(
            kind_of_source(dataset, source), source, seq, options,
            start=start, every=every, max_frames=max_frames, sensor=sensor,
        )  # fmt: skip
        diagnosis = examine(first_frames(found), thresholds.orb)
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        diagnosis = Diagnosis([Finding("input", "fault", measured or fix, fix if measured else "")])
    for finding in diagnosis.findings:
        typer.echo(f"{finding.verdict:<8} {finding.check:<16} {finding.measured}")
        if finding.fix:
            typer.echo(f"{'':<8} {'':<16} fix: {finding.fix}")
    write_page(diagnosis, f"Doctor: {source}", out)  # after what it says: a disk may be full
    n = len(diagnosis.faults)
    typer.echo(f"{out}: {n or 'no'} fault{'' if n == 1 else 's'}")
    if diagnosis.faults:
        raise typer.Exit(1)
