"""The command ``vslam bench``."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import (
    Detectors,
    Jobs,
    OrbSlam3Python,
    OrbSlam3Vocabulary,
    OtherSystems,
    Quiet,
    Scheduler,
    Seeds,
    SystemNames,
    ThreadsOfRun,
    Thresholds,
    Weights,
    kind_of_source,
    option,
    reads_source,
    sequences,
)
from vslam.support.errors import counted
from vslam.support.options import METHOD, OUTPUT
from vslam_lab.cli.cells import choose_systems, open_cells
from vslam_lab.cli.report import write_overview_of

if TYPE_CHECKING:
    from vslam.types.source_options import SourceOptions

_UNKNOWN_LENGTH = 1000  # frames; a stream of unknown length is assumed to be this long
_FIRST_SEQUENCES = "00-05"
_EXAMPLES = """
[b]Examples[/b]
  vslam bench                        (KITTI 00-05 in $KITTI_ROOT)
  vslam bench --dataset synthetic    (the same routes in rendered towns)
  vslam bench --seqs 00,05-07 --perturb brightness:1.5+blur:0.5 --jobs 4
  vslam bench --dataset synthetic --seqs demo --detectors bow,capsule,both
  vslam bench --seqs 00 --systems vslam,orbslam3 --vocabulary voc.txt
  vslam bench --data drive.mp4 --side-by-side --calib stereo.yaml --seeds 1

To resume a benchmark that was stopped, repeat the command (docs/howto/bench.md).
"""


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@reads_source(without=("seq", "start", "every", "mask"))
def bench(
    given: SourceOptions,
    seqs: Annotated[str | None, sequences("00-05")] = None,
    perturb: Annotated[
        str,
        option(
            METHOD,
            "LIST",
            "Perturbations, separated by commas. + combines several, as in fog:60+blur:0.5 "
            "([b]vslam perturb --list[/b] shows all of them).",
        ),
    ] = "none,brightness",
    detectors: Detectors = "bow,both",
    weights: Weights = None,
    systems: SystemNames = "vslam",
    system: OtherSystems = None,
    orbslam3_python: OrbSlam3Python = None,
    vocabulary: OrbSlam3Vocabulary = None,
    seeds: Seeds = 3,
    config: Thresholds = None,
    jobs: Jobs = 1,
    threads: ThreadsOfRun = None,
    scheduler: Scheduler = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("bench"),
    quiet: Quiet = False,
) -> None:
    """Compare loop detectors and other systems on perturbed sequences."""
    from vslam_lab.bench import execute
    from vslam_lab.bench.estimate import check_disk, duration, estimate, size
    from vslam_lab.bench.grid import parse_perturbations
    from vslam_lab.bench.table import GridProgress, shown_live

    chosen = choose_systems(
        detectors, weights or [], systems, system or [], orbslam3_python, vocabulary
    )
    laws = parse_perturbations(perturb)
    if seqs is None and kind_of_source(given) in ("kitti", "synthetic"):
        seqs = _FIRST_SEQUENCES
    setup = open_cells(given, seqs, chosen, config, threads, jobs, scheduler, out, shown=not quiet)
    out, options = setup.out, setup.options
    frames = {name: one.n_expected or _UNKNOWN_LENGTH for name, one in setup.sequences.items()}
    cells = setup.grid(laws, seeds)
    setup.prepare()
    finished = execute.finished_cells(cells, out, options.config)
    progress = GridProgress(cells, finished, frames, out, jobs)
    missing = progress.missing
    needed = estimate(missing, progress.reports, frames, jobs)
    check_disk(needed, out)
    setup.console.announce(
        f"{counted(len(cells), 'run')}, {len(missing)} to do: about {duration(needed.seconds)} "
        f"with {jobs} at a time ({needed.basis}), {size(needed.kept)} in {out} and "
        f"{size(needed.scratch)} of temporary files"
    )
    stopped = False
    try:
        with (
            shown_live(progress, shown=not quiet) as say,
            closing(setup.run(missing)) as outcomes,
        ):
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
        baseline = next(name for name in chosen.names if name in done)  # the first may have failed
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
