"""The command ``vslam run``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import (
    KITTI_ROOT,
    Calib,
    Depth,
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

  vslam run --data ~/kitti --seq 00 --map runs/latest --localize
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
    depth: Depth = None,
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
        DetectorName | None,
        typer.Option(
            help="Loop detector; [b]none[/b] for odometry only; those after capsule-pruned need "
            "[b]--weights[/b].",
            show_default="bow, or that of --map",
        ),
    ] = None,
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
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", help="Go on in this map, the map.npz of a run for example."
        ),
    ] = None,
    localize: Annotated[
        bool,
        typer.Option("--localize", help="Only track in the map of --map; it stays as it is."),
    ] = False,
    save_map: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the map to this file, too, in place of another."),
    ] = None,
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

    if localize and map_file is None:
        raise InputError("--localize: name the map to localise in with --map.")
    if localize and save_map is not None:
        raise InputError("--save-map: localising changes no map; leave it out.")
    if map_file is not None:
        if compare_loops:
            raise InputError("--compare-loops: not for a run that goes on in a map; leave it out.")
        map_file, detector = _map_to_go_on_in(map_file, detector)
    detector = detector or "bow"
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
    options = source_options(calib, right, depth, fps, side_by_side, topics, depth_scale)
    with render_bar(shown=not quiet) as on_render:
        source = open_source(
            kind, data, seq, options,
            start=start, every=every, max_frames=max_frames, sensor=sensor,
            on_render=on_render,
        )  # fmt: skip
    perturbation.bound_to(source)  # refuses laws that the data cannot serve
    if is_live(source):
        if compare_loops:
            raise InputError("--compare-loops: a camera cannot be seen twice; leave it out.")
        realtime = True

    # Bad input has been refused by now; what follows takes a second to import.
    from vslam.cli.summary import print_summary
    from vslam.report.folder import create_run_folder, write_results
    from vslam.run.outcome import RunSettings
    from vslam.run.pipeline import require_camera, run_sequence, with_comparison
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
        map=map_file,
        localize=localize,
    )
    if map_file is not None:
        require_camera(map_file, source.camera)
    viewer = None if view is None else open_viewer(view)
    folder = create_run_folder(out, kind, source.name, perturbation.name, detector)
    recorder: Recorder = RerunRecorder(folder / "recording.rrd") if record else NullRecorder()
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
    report = write_results(folder, outcome, pages=pages, ply=ply, map_file=save_map)
    if not quiet:
        print_summary(report, folder)
    if outcome.interrupted:
        raise typer.Exit(1)


def _map_to_go_on_in(file: Path, detector: DetectorName | None) -> tuple[Path, DetectorName]:
    """The map of a file or of the folder of a run, and the detector that it was made with."""
    from vslam.maps.storage import map_file_of, read_header

    file = map_file_of(file)
    made_with: DetectorName = read_header(file)["detector"]["name"]
    if detector not in (None, made_with):
        raise InputError(
            f"--detector {detector}: {file} was made with the detector {made_with}; leave it out."
        )
    return file, made_with
