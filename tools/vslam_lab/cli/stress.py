"""The command ``vslam stress``, which tests how strong each perturbation can be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vslam.cli.options import (
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
    open_given,
    option,
    reads_source,
    sequences,
)
from vslam.support.errors import InputError, did_you_mean
from vslam.support.options import METHOD, OUTPUT
from vslam_lab.cli.cells import choose_systems, open_cells

if TYPE_CHECKING:
    from vslam.datasets.frames import Source
    from vslam.types.source_options import SourceOptions

_EXAMPLES = """
[b]Examples[/b]
  vslam stress --data ~/kitti --seqs 00 --laws fog,rain,night --jobs 2
  vslam stress --dataset synthetic --seqs demo --detectors bow,capsule,both
  vslam stress --seqs 00 --systems vslam,orbslam3 --vocabulary voc.txt
  vslam stress --seqs 00 --preset kitti-c --detectors bow,both

To resume a stress test that was stopped, repeat the command (docs/howto/stress.md).
"""
_FAILURE = "Failure"  # name of a panel of --help


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@reads_source(without=("seq", "start", "every", "mask"))
def stress(
    given: SourceOptions,
    seqs: Annotated[str | None, sequences("00")] = None,
    laws: Annotated[
        str,
        option(
            METHOD,
            "NAMES",
            "Perturbations to test, without strengths. [b]vslam perturb --list[/b] shows all.",
        ),
    ] = "all",
    detectors: Annotated[
        str, option(METHOD, "NAMES", "Loop detectors of vslam, separated by commas.")
    ] = "both",
    systems: SystemNames = "vslam",
    system: OtherSystems = None,
    orbslam3_python: OrbSlam3Python = None,
    vocabulary: OrbSlam3Vocabulary = None,
    preset: Annotated[
        Literal["kitti-c"] | None,
        option(
            METHOD,
            "kitti-c",
            "Test the five severities of the published benchmark KITTI-C, instead of --laws.",
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        option(
            METHOD,
            "NAME",
            "With --preset: the detector or system with which the others are compared.",
            unset="the first",
        ),
    ] = None,
    seeds: Seeds = 3,
    steps: Annotated[
        int, option(METHOD, "N", "Number of bisection steps in each search.", min=1, max=10)
    ] = 5,
    max_lost: Annotated[
        float,
        option(
            _FAILURE,
            "PERCENT",
            "A run fails if it loses more than this share of its frames.",
            min=0.0,
        ),
    ] = 5.0,
    ate_factor: Annotated[
        float,
        option(
            _FAILURE,
            "NUMBER",
            "A run fails if its ATE is more than NUMBER times the ATE of the unperturbed run.",
            min=1.0,
        ),
    ] = 3.0,
    ate_least: Annotated[
        float, option(_FAILURE, "METRES", "An ATE up to this value is never a failure.", min=0.0)
    ] = 0.25,
    config: Thresholds = None,
    jobs: Jobs = 1,
    threads: ThreadsOfRun = None,
    scheduler: Scheduler = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("stress"),
    quiet: Quiet = False,
) -> None:
    """For each perturbation, find the strength at which a run fails."""
    from vslam.cli.tables import show_sections
    from vslam.datasets.frames import first_frames
    from vslam_lab.bench import execute
    from vslam_lab.stress.criterion import Criterion
    from vslam_lab.stress.plan import Plan, parse_laws
    from vslam_lab.stress.report import boundary_sections, write_report
    from vslam_lab.stress.run import Results, run_all
    from vslam_lab.stress.summary import summarise

    chosen = choose_systems(detectors, [], systems, system or [], orbslam3_python, vocabulary)
    names = chosen.names
    if baseline is not None and baseline not in names:
        raise InputError(
            f"--baseline {baseline}: is not tested{did_you_mean(baseline, names)}; choose from "
            f"{', '.join(names)}."
        )
    wanted = parse_laws(laws)
    setup = open_cells(given, seqs, chosen, config, threads, jobs, scheduler, out, shown=not quiet)
    out = setup.out
    fitting, notes = _fitting(wanted, setup.sequences) if preset is None else ([], [])
    plan = Plan(
        setup.grid(["none"], 1), tuple(fitting), seeds, steps, baseline or names[0],
        Criterion(max_lost, ate_factor, ate_least), tuple(chosen.others), preset,
    )  # fmt: skip
    setup.prepare()
    searches, results = plan.searches(), Results(out, setup.options.config)
    setup.console.announce(plan.criterion.words)
    stopped = False
    try:
        run_all(
            plan.clean, searches, plan.preset_cells(), results, plan.criterion, setup.run,
            setup.console.announce,
        )  # fmt: skip
    except KeyboardInterrupt:
        stopped = True
    finally:
        execute.tidy(out)
    report = summarise(plan, searches, results, notes)
    write_report(out, report, {n: first_frames(one) for n, one in setup.sequences.items()})
    if not quiet:
        show_sections(boundary_sections(report))
        ended = f"finished {len(report.boundaries)} of {len(searches)} searches"
        typer.echo(f"{out / 'report.html'}: {ended}")
    if stopped or len(report.boundaries) < len(searches):
        raise typer.Exit(1)


@app.command("foreign", hidden=True, context_settings={"allow_extra_args": True})
@reads_source(without=("source", "start", "every", "mask"))
def foreign(
    context: typer.Context,
    given: SourceOptions,
    name: str,
    template: str,
    word: str,
    perturb: Annotated[str, typer.Option()],
    detector: Annotated[str, typer.Option()],
    seed: Annotated[int, typer.Option()],
    threads: Annotated[int, typer.Option()],
    config: Annotated[Path, typer.Option()],
    out: Annotated[Path, typer.Option()],
    no_record: Annotated[bool, typer.Option("--no-record")] = False,
    no_report: Annotated[bool, typer.Option("--no-report")] = False,
    quiet: Annotated[bool, typer.Option("--quiet")] = False,
) -> None:
    """Run another system on a sequence, and write its report. ``vslam bench`` and ``vslam stress``
    call this command."""
    from vslam.cli.console import Console
    from vslam.config import load_config
    from vslam.datasets.perturbation import parse_perturbation
    from vslam.report.folder import create_run_folder
    from vslam.run.options import RunOptions
    from vslam_lab.stress.external import run_external

    options = RunOptions(
        **given.model_dump(), perturb=perturb, seed=seed, threads=threads, detector=name,
        thresholds=load_config(config),
    )  # fmt: skip
    source = open_given(given, Console(shown=False))
    perturbation = parse_perturbation(perturb, seed)
    settings = options.model_copy(update={"perturb": perturbation.name})
    folder = create_run_folder(out, source.dataset, source.name, perturbation.name, name)
    run_external(source, perturbation, settings, template, folder)


def _fitting(laws: list[str], opened: Mapping[str, Source]) -> tuple[list[str], list[str]]:
    """Return the perturbations that can be applied to every sequence, and a note about each of the
    others."""
    from vslam.datasets.perturbation import laws_for

    notes: dict[str, None] = {}
    for sequence in opened.values():
        fit, unfit = laws_for(sequence)
        notes |= {why: None for law, why in unfit.items() if law in laws}
        laws = [law for law in laws if law in fit]
    if not laws:
        raise InputError(f"--laws: none can be applied to this data. {next(iter(notes))}")
    return laws, [f"left out: {why}" for why in notes]
