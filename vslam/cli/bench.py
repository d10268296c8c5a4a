"""The command ``vslam bench``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import (
    METHOD,
    OUTPUT,
    Jobs,
    Quiet,
    Scheduler,
    Seeds,
    ThreadsOfRun,
    Thresholds,
    Weights,
    kind_of_source,
    names_in,
    open_given,
    option,
    read_thresholds,
    reads_source,
    sequences,
)
from vslam.cli.report import write_overview_of
from vslam.errors import InputError, counted

if TYPE_CHECKING:
    from collections.abc import Generator

    from vslam.datasets.frames import Source
    from vslam.datasets.sources import SourceOptions
    from vslam.lab.bench.execute import CellOutcome, RunOptions
    from vslam.lab.bench.grid import Cell

_UNKNOWN_LENGTH = 1000  # frames of a stream of unknown length, to estimate the time
_FIRST_SEQUENCES = "00-05"
_EXAMPLES = """
[b]Examples[/b]
  vslam bench                        (KITTI 00-05 in $KITTI_ROOT)
  vslam bench --dataset synthetic    (the same routes in rendered towns)
  vslam bench --seqs 00,05-07 --perturb brightness:1.5+blur:0.5 --jobs 4
  vslam bench --dataset synthetic --seqs demo --detectors bow,capsule,both
  vslam bench --data drive.mp4 --side-by-side --calib stereo.yaml --seeds 1

The same command continues a benchmark that was stopped (docs/howto/bench.md).
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(bench)


@reads_source(without=("seq", "start", "every", "mask"))
def bench(
    given: SourceOptions,
    seqs: Annotated[str | None, sequences("00-05")] = None,
    perturb: Annotated[
        str,
        option(
            METHOD,
            "LIST",
            "Perturbations, separated by commas; + joins several in one, such as "
            "fog:60+blur:0.5 ([b]vslam perturb --list[/b]).",
        ),
    ] = "none,brightness",
    detectors: Annotated[
        str,
        option(METHOD, "NAMES", "Loop detectors, separated by commas; the first is the baseline."),
    ] = "bow,both",
    weights: Weights = None,
    seeds: Seeds = 3,
    config: Thresholds = None,
    jobs: Jobs = 1,
    threads: ThreadsOfRun = None,
    scheduler: Scheduler = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("bench"),
    quiet: Quiet = False,
) -> None:
    """Compare loop detectors on sequences under perturbations."""
    chosen = names_in(detectors)
    from vslam.cli.console import console
    from vslam.lab.bench import execute
    from vslam.lab.bench.estimate import check_disk, duration, estimate, size
    from vslam.lab.bench.grid import make_grid, parse_perturbations, thresholds_digest
    from vslam.lab.bench.table import GridProgress, shown_live
    from vslam.loopclosure.registry import parse_weights, require_detector

    files = parse_weights(weights or [], chosen)
    for name in chosen or [""]:
        require_detector(name, files.get(name), option="--detectors")
    laws = parse_perturbations(perturb)
    out = out.absolute()
    kind = kind_of_source(given)
    given = absolute(given)
    if seqs is None and kind in ("kitti", "synthetic"):
        seqs = _FIRST_SEQUENCES
    opened = open_all(kind, given, seqs, shown=not quiet)
    frames = {name: source.n_expected or _UNKNOWN_LENGTH for name, source in opened.items()}
    options = cell_options(kind, given, config, threads, jobs, scheduler, out)
    cells = make_grid(
        kind, frames, laws, chosen, seeds, given.max_frames, files,
        sensor=given.sensor, calib=tuple(map(str, given.calib)),
        thresholds=thresholds_digest(options.config),
    )  # fmt: skip
    execute.prepare(out, identity_of(kind, given))
    finished = execute.finished_cells(cells, out, options.config)
    progress = GridProgress(cells, finished, frames, out, jobs)
    missing = progress.missing
    needed = estimate(missing, progress.reports, frames, jobs)
    check_disk(needed, out)
    console(shown=not quiet).announce(
        f"{counted(len(cells), 'run')}, {len(missing)} to do: about {duration(needed.seconds)} "
        f"with {jobs} at a time ({needed.basis}), {size(needed.kept)} in {out} and "
        f"{size(needed.scratch)} while it runs"
    )
    stopped = False
    try:
        with shown_live(progress, shown=not quiet) as say:
            outcomes = outcomes_of(missing, options, jobs, scheduler, out, shown=not quiet)
            with closing(outcomes):
                for outcome in outcomes:
                    say(progress.add(outcome))
    except KeyboardInterrupt:
        stopped = True
    finally:
        execute.tidy(out)
    for cell, why in progress.failed.items():
        typer.echo(f"failed: {cell.name}: {why}", err=True)
    if progress.reports and not stopped:
        done = {cell.detector for cell in progress.reports}
        # All runs of the first detector may have failed.
        baseline = next(name for name in chosen if name in done)
        write_overview_of([out], [], out, baseline=baseline, quiet=quiet)
    counts = (
        f"{len(progress.reports)} of {counted(len(cells), 'run')} finished, "
        f"{len(progress.failed)} failed"
    )
    if not quiet:
        again = "; repeat the command to continue" if stopped or progress.failed else ""
        typer.echo(f"{'stopped: ' if stopped else ''}{counts}{again}")
    if stopped or progress.failed:
        raise typer.Exit(1)


def absolute(given: SourceOptions) -> SourceOptions:
    """The same options with absolute paths, because each run has a working folder of its own."""
    paths = {
        name: path.absolute()
        for name in ("right", "depth")
        if (path := getattr(given, name)) is not None
    }
    data = given.data
    if data and Path(data).exists():
        data = str(Path(data).absolute())
    calib = tuple(path.absolute() for path in given.calib)
    return given.model_copy(update={**paths, "data": data, "calib": calib})


def cell_options(
    kind: str,
    given: SourceOptions,
    config: str | None,
    threads: int | None,
    jobs: int,
    scheduler: str | None,
    out: Path,
) -> RunOptions:
    """The settings that all cells of a benchmark share."""
    from vslam.lab.bench.execute import RunOptions, scratch_folder
    from vslam.machine import available_cores

    return RunOptions(
        data=Path(given.data) if kind != "synthetic" else None,
        config=read_thresholds(config).model_dump_json(indent=2) + "\n",  # as a run writes it
        threads=threads or max(1, min(available_cores() // jobs, 4)),
        scratch=None if scheduler else scratch_folder(out),
        source=tuple(_words_of(given)),
    )


def _words_of(given: SourceOptions) -> list[str]:
    """Options of ``vslam run`` that all cells share; the others are in the cells."""
    words = ["--side-by-side"] if given.side_by_side else []
    values = {
        "--right": given.right,
        "--depth": given.depth,
        "--fps": given.fps,
        "--topics": given.topics or None,
        "--depth-scale": given.depth_scale,
    }
    return words + [str(x) for pair in values.items() if pair[1] is not None for x in pair]


def identity_of(kind: str, given: SourceOptions) -> str:
    """A text that identifies the data of a benchmark."""
    if kind != "synthetic":
        return " ".join([given.data, *_words_of(given), *map(str, given.calib)])
    from vslam.datasets.synthetic import Variation, store

    return f"rendered towns {store.folder_name(Variation())}"


def open_all(
    kind: str, given: SourceOptions, seqs: str | None, *, shown: bool
) -> dict[str, Source]:
    """Open every sequence by name, so that missing data is reported before the first run.

    Synthetic sequences are rendered here, because two runs cannot render one at the same time.
    """
    from vslam.cli.console import console
    from vslam.datasets.sources import LIVE
    from vslam.lab.bench.grid import parse_sequences

    named = f"--data {given.data}" if given.data else f"--dataset {kind}"
    once = f"{named}: a live camera gives each image once; record a video or a bag."
    if kind in LIVE:
        raise InputError(once)
    opened = {}
    for name in [None] if seqs is None else parse_sequences(seqs):
        options = given.model_copy(update={"dataset": kind, "seq": name})
        source = open_given(options, console(shown=shown))
        if source.live:
            raise InputError(once)
        opened[name or source.name] = source
    return opened


def outcomes_of(
    cells: list[Cell],
    options: RunOptions,
    jobs: int,
    scheduler: str | None,
    out: Path,
    *,
    shown: bool,
) -> Generator[CellOutcome, None, None]:
    """Run cells on this machine or on a cluster, and yield their outcomes."""
    if scheduler is not None:
        from vslam.lab.bench.cluster import run_on_cluster

        return run_on_cluster(cells, options, scheduler, out)
    from vslam.cli.console import console
    from vslam.lab.bench.execute import run_here
    from vslam.machine import available_cores
    from vslam.run.warmup import compile_kernels, is_cold

    if cells and is_cold():  # once, not in each run
        message = "first run: compiling the kernels, less than a minute ..."
        console(shown=shown).announce(message)
        compile_kernels(processes=min(available_cores(), 2))
    return run_here(cells, options, jobs, out)
