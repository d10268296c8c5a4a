"""The command ``vslam bench``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import KITTI_ROOT, Data, Dataset, Thresholds, Weights, names_in
from vslam.cli.report import write_overview_of

if TYPE_CHECKING:
    from collections.abc import Generator

    from vslam.bench.execute import CellOutcome, RunOptions
    from vslam.bench.grid import Cell

_EXAMPLES = """
[b]Examples[/b]

  vslam bench --data ~/kitti --seqs 00-05 --perturb none,brightness --detectors none,bow --runs 3

  vslam bench --dataset synthetic --seqs demo --perturb brightness:0.5,brightness:1,brightness:2

  vslam bench --data ~/kitti --seqs 00,05-07 --perturb brightness:1.5+blur:0.5 --jobs 4

The same command again goes on where it was stopped. docs/bench.md tells more.
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(bench)


def bench(
    dataset: Dataset = "kitti",
    data: Data = KITTI_ROOT,
    seqs: Annotated[str, typer.Option(help="Sequences, 00-05 or 00,demo for example.")] = "00-05",
    perturb: Annotated[
        str,
        typer.Option(
            help="Perturbations as of [b]vslam run[/b]; a comma separates them, + joins laws."
        ),
    ] = "none,brightness",
    detectors: Annotated[str, typer.Option(help="Loop detectors, with commas.")] = "none,bow",
    weights: Weights = None,
    runs: Annotated[int, typer.Option(min=1, help="Seeds of each random perturbation.")] = 3,
    max_frames: Annotated[
        int | None, typer.Option(min=1, help="Stop each run after so many frames.")
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, help="Runs at a time; give 1 for frames per second that count.")
    ] = 1,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="Threads of each run.", show_default="cores for each job, up to 4"
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler, tcp://HOST:8786, whose workers run the cells."),
    ] = None,
    config: Thresholds = None,
    out: Annotated[Path, typer.Option(help="Folder of the benchmark.")] = Path("bench"),
    quiet: Annotated[bool, typer.Option("--quiet", help="No table.")] = False,
) -> None:
    """Run sequences under perturbations with loop detectors, and report on all of them."""
    chosen = names_in(detectors)
    from vslam.bench import execute
    from vslam.bench.estimate import check_disk, duration, estimate, size
    from vslam.bench.grid import make_grid, parse_perturbations, parse_sequences
    from vslam.bench.table import GridProgress, shown_live
    from vslam.cli.progress import announce
    from vslam.config import Config, load_config
    from vslam.loopclosure.registry import parse_weights, require_detector
    from vslam.machine import available_cores

    files = parse_weights(weights or [], chosen)
    for name in chosen or [""]:
        require_detector(name, files.get(name), option="--detectors")
    sequences, laws = parse_sequences(seqs), parse_perturbations(perturb)
    thresholds = Config() if config is None else load_config(config)
    options = execute.RunOptions(
        data=data.absolute() if dataset != "synthetic" else None,
        config=thresholds.model_dump_json(indent=2) + "\n",  # as a run writes it
        threads=threads or max(1, min(available_cores() // jobs, 4)),
        scratch=None if scheduler else execute.scratch_folder(out.absolute()),
    )
    cells = make_grid(dataset, sequences, laws, chosen, runs, max_frames, files)
    out = out.absolute()
    frames, identity = open_all(dataset, data.absolute(), sequences, max_frames, shown=not quiet)
    execute.prepare(out, identity)
    finished = execute.finished_cells(cells, out, options.config)
    progress = GridProgress(cells, finished, frames, out, jobs)
    missing = progress.missing
    needed = estimate(missing, progress.reports, frames, jobs)
    check_disk(needed, out)
    announce(
        f"{len(cells)} cells, {len(missing)} to do: about {duration(needed.seconds)} with "
        f"{jobs} at a time ({needed.basis}), {size(needed.kept)} in {out} and "
        f"{size(needed.scratch)} while it runs",
        shown=not quiet,
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
        write_overview_of([out], [], out, quiet=quiet)
    counts = (
        f"{len(progress.reports)} of {len(cells)} cells finished, {len(progress.failed)} failed"
    )
    if not quiet:
        again = "; the same command goes on" if stopped or progress.failed else ""
        typer.echo(f"{'stopped: ' if stopped else ''}{counts}{again}")
    if stopped or progress.failed:
        raise typer.Exit(1)


def open_all(
    dataset: str, root: Path, sequences: list[str], max_frames: int | None, *, shown: bool
) -> tuple[dict[str, int], str]:
    """Open every sequence, so that what is missing is said before the first run and not after the
    last: frames of each, and what tells this data from other data.

    Rendered ones are rendered here: two runs cannot render one sequence at a time.
    """
    from vslam.cli.progress import render_bar
    from vslam.datasets import open_sequence

    frames = {}
    for name in sequences:
        with render_bar(shown=shown) as on_render:
            found = open_sequence(dataset, root, name, max_frames=max_frames, on_render=on_render)
        frames[name] = len(found)
    if dataset != "synthetic":
        return frames, str(root)
    from vslam.datasets.synthetic import Variation, store

    return frames, f"rendered towns {store.folder_name(Variation())}"


def outcomes_of(
    cells: list[Cell],
    options: RunOptions,
    jobs: int,
    scheduler: str | None,
    out: Path,
    *,
    shown: bool,
) -> Generator[CellOutcome, None, None]:
    """Run cells here or on a cluster and publish them."""
    if scheduler is not None:
        from vslam.bench.cluster import run_on_cluster

        return run_on_cluster(cells, options, scheduler, out)
    from vslam.bench.execute import run_here
    from vslam.cli.progress import announce
    from vslam.machine import available_cores
    from vslam.run.warmup import compile_kernels, is_cold

    if cells and is_cold():  # once, not once in each run
        announce("first run: compiling the kernels, less than a minute ...", shown=shown)
        compile_kernels(processes=min(available_cores(), 2))
    return run_here(cells, options, jobs, out)
