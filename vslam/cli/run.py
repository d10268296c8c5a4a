"""The command ``vslam run``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import (
    KITTI_ROOT,
    Calib,
    DepthScale,
    DetectorName,
    Every,
    FramesPerSecond,
    MaxFrames,
    Perturb,
    Right,
    Seed,
    Sensor,
    Seq,
    SideBySide,
    Source,
    SourceKind,
    Start,
    Thresholds,
    Topics,
    ViewerName,
    kind_of_source,
    source_options,
)
from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam run --data ~/kitti --seq 00

  vslam run --data ~/kitti --seq 06 --perturb brightness:1.5,blur:0.5 --seed 3

  vslam run --dataset synthetic --seq demo

  vslam run --dataset euroc --data ~/euroc/V1_01_easy

  vslam run --seq 00 --max-frames 200 --no-record --quiet

  vslam run --data drive.mp4 --side-by-side --calib stereo.yaml
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(run)


def run(
    data: Source = str(KITTI_ROOT),
    dataset: SourceKind = None,
    seq: Seq = None,
    calib: Calib = None,
    right: Right = None,
    fps: FramesPerSecond = None,
    side_by_side: SideBySide = False,
    topics: Topics = "",
    depth_scale: DepthScale = None,
    perturb: Perturb = "none",
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    seed: Seed = 0,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="Threads; the result does not depend on it.", show_default="cores, up to 4"
        ),
    ] = None,
    detector: Annotated[
        DetectorName,
        typer.Option(
            help="Loop detector; [b]none[/b] for odometry only; those after capsule-pruned need "
            "[b]--weights[/b]."
        ),
    ] = "bow",
    weights: Annotated[
        Path | None, typer.Option(help="Safetensors file of a learned detector (vslam train).")
    ] = None,
    sensor: Sensor = None,
    out: Annotated[Path, typer.Option(help="Where the folders of the runs go.")] = Path("runs"),
    config: Thresholds = None,
    compare_loops: Annotated[
        bool,
        typer.Option("--compare-loops", help="Run again without loop closing; print both."),
    ] = False,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Play frames at their times; drop overtaken ones."),
    ] = False,
    record: Annotated[bool, typer.Option(help="Write a Rerun recording.")] = True,
    view: Annotated[
        ViewerName | None,
        typer.Option(help="Show the run live in Rerun, in a window or in the browser, too."),
    ] = None,
    pages: Annotated[
        bool,
        typer.Option(
            "--report/--no-report",
            help="Write report.html, report.md and figures; without, of the report only its JSON, "
            "which is all that [b]vslam report[/b] needs of a run.",
        ),
    ] = True,
    ply: Annotated[bool, typer.Option("--ply", help="Write the landmarks as map.ply.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")] = False,
) -> None:
    """Run SLAM on a sequence and write trajectory, map, recording and report to a folder."""
    from vslam.loopclosure.registry import require_detector

    require_detector(detector, weights)
    if compare_loops and detector == "none":
        raise InputError("--compare-loops: nothing to compare with --detector none; name another.")
    if compare_loops and realtime:
        raise InputError("--compare-loops: two runs drop different frames; leave out --realtime.")

    from vslam.cli.progress import announce, progress_bar, render_bar
    from vslam.config import Config, load_config
    from vslam.datasets.perturbation import parse_perturbation
    from vslam.datasets.sources import open_source
    from vslam.datasets.stream import count_expected, is_live
    from vslam.machine import available_cores

    thresholds = Config() if config is None else load_config(config)
    kind = kind_of_source(dataset, data)
    perturbation = parse_perturbation(perturb, seed)
    options = source_options(calib, right, fps, side_by_side, topics, depth_scale)
    with render_bar(shown=not quiet) as on_render:
        source = open_source(
            kind, data, seq, options,
            start=start, every=every, max_frames=max_frames, sensor=sensor,
            on_render=on_render,
        )  # fmt: skip
    if is_live(source):
        if compare_loops:
            raise InputError("--compare-loops: a camera cannot be seen twice; leave it out.")
        realtime = True

    # Bad input has been refused by now; what follows takes a second to import.
    from vslam.cli.summary import print_summary
    from vslam.report.folder import create_run_folder, write_results
    from vslam.run.moments import MomentRecorder
    from vslam.run.outcome import RunSettings
    from vslam.run.pipeline import run_sequence, with_comparison
    from vslam.run.recorder import (
        NullRecorder,
        Recorder,
        RerunRecorder,
        SeveralRecorders,
        open_viewer,
    )
    from vslam.run.warmup import compile_kernels, is_cold

    settings = RunSettings(
        dataset=kind,
        sequence=source.name,
        perturb=perturbation.name,
        detector=detector,
        sensor=source.camera.sensor,
        seed=seed,
        threads=threads or min(available_cores(), 4),
        start=start,
        every=every,
        max_frames=max_frames,
        config=thresholds,
        weights=weights,
        realtime=realtime,
        calib=tuple(calib or ()),
    )
    viewer = None if view is None else open_viewer(view)
    folder = create_run_folder(out, kind, source.name, perturbation.name, detector)
    recorder: Recorder = RerunRecorder(folder / "recording.rrd") if record else NullRecorder()
    moments = MomentRecorder()
    if pages:
        recorder = SeveralRecorders((recorder, moments))
    if viewer is not None:
        recorder = SeveralRecorders((recorder, RerunRecorder(viewer)))
        if viewer.address:
            announce(f"live at {viewer.address}", shown=not quiet)
    if is_cold():
        announce("first run: compiling the kernels, less than a minute ...", shown=not quiet)
    compile_kernels(processes=min(settings.threads, 2))
    with progress_bar(count_expected(source), shown=not quiet) as on_frame:
        outcome = run_sequence(source, perturbation, settings, recorder, on_frame=on_frame)
    if compare_loops and not outcome.interrupted:
        with progress_bar(count_expected(source), shown=not quiet) as on_frame:
            outcome = with_comparison(outcome, perturbation, on_frame=on_frame)
    report = write_results(folder, outcome, moments.moments, pages=pages, ply=ply)
    if not quiet:
        print_summary(report, folder)
    if outcome.interrupted:
        raise typer.Exit(1)
