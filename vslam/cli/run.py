"""The command ``vslam run``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import (
    KITTI_ROOT,
    Data,
    Dataset,
    DetectorName,
    Every,
    MaxFrames,
    Perturb,
    Seed,
    SensorName,
    Seq,
    Start,
    Thresholds,
)
from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam run --data ~/kitti --seq 00

  vslam run --data ~/kitti --seq 06 --perturb brightness:1.5,blur:0.5 --seed 3

  vslam run --dataset synthetic --seq demo

  vslam run --seq 00 --max-frames 200 --no-record --quiet
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(run)


def run(
    data: Data = KITTI_ROOT,
    dataset: Dataset = "kitti",
    seq: Seq = "00",
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
    sensor: Annotated[
        SensorName,
        typer.Option(help="[b]mono[/b] reads the left camera alone; its scale is arbitrary."),
    ] = "stereo",
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
    from vslam.datasets import open_sequence
    from vslam.datasets.perturbation import parse_perturbation
    from vslam.machine import available_cores

    thresholds = Config() if config is None else load_config(config)
    with render_bar(shown=not quiet) as on_render:
        sequence = open_sequence(
            dataset, data, seq,
            start=start, every=every, max_frames=max_frames, monocular=sensor == "mono",
            on_render=on_render,
        )  # fmt: skip
    perturbation = parse_perturbation(perturb, seed, sequence.timestamps)

    # Bad input has been refused by now; what follows takes a second to import.
    from vslam.cli.summary import print_summary
    from vslam.report.folder import create_run_folder, write_results
    from vslam.run.outcome import RunSettings
    from vslam.run.pipeline import run_sequence, with_comparison
    from vslam.run.recorder import NullRecorder, RerunRecorder
    from vslam.run.warmup import compile_kernels, is_cold

    settings = RunSettings(
        dataset=dataset,
        sequence=seq,
        perturb=perturbation.name,
        detector=detector,
        sensor=sensor,
        seed=seed,
        threads=threads or min(available_cores(), 4),
        start=start,
        every=every,
        max_frames=max_frames,
        config=thresholds,
        weights=weights,
        realtime=realtime,
    )
    folder = create_run_folder(out, dataset, seq, perturbation.name, detector)
    recorder = RerunRecorder(folder / "recording.rrd") if record else NullRecorder()
    if is_cold():
        announce("first run: compiling the kernels, less than a minute ...", shown=not quiet)
    compile_kernels(processes=min(settings.threads, 2))
    with progress_bar(len(sequence), shown=not quiet) as on_frame:
        outcome = run_sequence(sequence, perturbation, settings, recorder, on_frame=on_frame)
    if compare_loops and not outcome.interrupted:
        with progress_bar(len(sequence), shown=not quiet) as on_frame:
            outcome = with_comparison(outcome, perturbation, on_frame=on_frame)
    report = write_results(folder, outcome, pages=pages, ply=ply)
    if not quiet:
        print_summary(report, folder)
    if outcome.interrupted:
        raise typer.Exit(1)
