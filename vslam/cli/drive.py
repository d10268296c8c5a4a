"""What ``vslam run`` does once its options are known to make sense."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import typer

from vslam.errors import InputError

if TYPE_CHECKING:
    from vslam.run.options import RunOptions


@dataclass(frozen=True)
class Output:
    """What a run shows and writes; another one may be wanted when it is resumed."""

    record: bool
    view: Literal["native", "web"] | None
    pages: bool
    ply: bool
    quiet: bool


def drive(
    options: RunOptions,
    output: Output,
    *,
    out: Path = Path(),
    resume: Path | None = None,
    compare_loops: bool = False,
) -> None:
    """Open the images, run SLAM and write the results.

    Args:
        out: where to make the folder of the run.
        resume: the folder of the run to go on with instead.
    """
    with ExitStack() as lock:
        _drive(options, output, out, resume, lock, compare_loops=compare_loops)


def _drive(
    options: RunOptions,
    output: Output,
    out: Path,
    resume: Path | None,
    lock: ExitStack,
    *,
    compare_loops: bool,
) -> None:
    from vslam.cli.options import SourceName, kind_of_source, source_options
    from vslam.datasets.perturbation import parse_perturbation
    from vslam.datasets.sources import open_source
    from vslam.datasets.stream import count_expected, is_live

    o, shown = options, not output.quiet
    if shown:
        from vslam.cli.progress import announce, progress_bar, render_bar
    else:
        from vslam.cli.quiet import announce, progress_bar, render_bar
    kind = kind_of_source(cast("SourceName | None", o.dataset), o.data)
    perturbation = parse_perturbation(o.perturb, o.seed)
    of_source = source_options(
        list(o.calib), o.right, o.depth, o.fps, o.side_by_side, o.topics, o.depth_scale
    )
    with render_bar(shown=shown) as on_render:
        source = open_source(
            kind, o.data, o.seq, of_source,
            start=o.start, every=o.every, max_frames=o.max_frames, sensor=o.sensor,
            on_render=on_render,
        )  # fmt: skip
    perturbation.bound_to(source)  # refuses laws that the data cannot serve
    if is_live(source):
        if compare_loops:
            raise InputError("--compare-loops: a camera cannot be seen twice; leave it out.")
        if resume is not None:
            raise InputError(
                f"--resume {resume}: what a camera has shown is gone; go on in its map with "
                "--map FOLDER/autosave.npz."
            )

    # Bad input has been refused by now; what follows takes a second to import.
    from vslam.cli.summary import print_summary
    from vslam.report.folder import create_run_folder, write_results
    from vslam.run.autosave import FolderAutosave, find_unfinished, lock_run, remove_autosave
    from vslam.run.moments import MomentRecorder
    from vslam.run.options import write_options
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
        detector=o.detector,
        sensor=source.camera.sensor,
        seed=o.seed,
        threads=o.threads,
        start=o.start,
        every=o.every,
        max_frames=o.max_frames,
        config=o.thresholds,
        weights=o.weights,
        realtime=o.realtime or is_live(source),
        calib=o.calib,
        map=o.map_file,
        localize=o.localize,
    )
    if o.map_file is not None and resume is None:
        require_camera(o.map_file, source.camera)
    unfinished = None
    if resume is not None:
        lock.enter_context(lock_run(resume))
        unfinished = find_unfinished(resume)
        require_camera(unfinished.map, source.camera)
    viewer = None if output.view is None else open_viewer(output.view)
    recording = "recording.rrd"
    if resume is None or unfinished is None:
        folder = create_run_folder(out, kind, source.name, perturbation.name, o.detector)
        lock.enter_context(lock_run(folder))
        write_options(folder, o)
    else:
        folder = resume
        recording = f"recording-from-{len(unfinished.progress.tracks)}.rrd"
    recorder: Recorder = RerunRecorder(folder / recording) if output.record else NullRecorder()
    moments = MomentRecorder()
    if output.pages:
        recorder = SeveralRecorders((recorder, moments))
    if viewer is not None:
        recorder = SeveralRecorders((recorder, RerunRecorder(viewer)))
        if viewer.address:
            announce(f"live at {viewer.address}", shown=shown)
    if is_cold():
        announce("first run: compiling the kernels, less than a minute ...", shown=shown)
    compile_kernels(processes=min(settings.threads, 2), load=settings.realtime)
    # When only localising there is nothing to save but the poses.
    autosave = FolderAutosave(
        folder, 0.0 if o.localize else o.autosave, f"{settings.dataset} {source.name}"
    )
    with progress_bar(count_expected(source), shown=shown) as on_frame:
        outcome = run_sequence(
            source, perturbation, settings, recorder,
            on_frame=on_frame, autosave=autosave, resume=unfinished,
        )  # fmt: skip
    if compare_loops and not outcome.interrupted:
        with progress_bar(count_expected(source), shown=shown) as on_frame:
            outcome = with_comparison(outcome, perturbation, on_frame=on_frame)
    report = write_results(
        folder, outcome, moments.moments, pages=output.pages, ply=output.ply, map_file=o.save_map
    )
    if not outcome.interrupted:
        remove_autosave(folder)
    if shown:
        print_summary(report, folder)
    if outcome.interrupted:
        raise typer.Exit(1)
