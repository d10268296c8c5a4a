"""The command ``vslam stress``: the strength of each law at which a run fails."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Collection, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vslam.cli.bench import absolute, cell_options, identity_of, open_all, outcomes_of
from vslam.cli.options import (
    METHOD,
    OUTPUT,
    Jobs,
    Quiet,
    Scheduler,
    Seeds,
    ThreadsOfRun,
    Thresholds,
    kind_of_source,
    names_in,
    open_given,
    option,
    reads_source,
    sequences,
)
from vslam.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from vslam.datasets.frames import Source
    from vslam.datasets.sources import SourceOptions
    from vslam.lab.bench.execute import CellOutcome
    from vslam.lab.bench.grid import Cell

_EXAMPLES = """
[b]Examples[/b]
  vslam stress --data ~/kitti --seqs 00 --laws fog,rain,night --jobs 2
  vslam stress --dataset synthetic --seqs demo --detectors bow,capsule,both
  vslam stress --seqs 00 --systems vslam,orbslam3 --vocabulary voc.txt
  vslam stress --seqs 00 --preset kitti-c --detectors bow,both

The same command continues a stress test that was stopped (docs/howto/stress.md).
"""
_ORBSLAM3 = "orbslam3"
_FAILURE = "Failure"  # a panel of --help


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command(epilog=_EXAMPLES)(stress)
    app.command("foreign", hidden=True, context_settings={"allow_extra_args": True})(foreign)


@reads_source(without=("seq", "start", "every", "mask"))
def stress(
    given: SourceOptions,
    seqs: Annotated[str | None, sequences("00")] = None,
    laws: Annotated[
        str,
        option(
            METHOD,
            "NAMES",
            "Perturbations to test, without strengths ([b]vslam perturb --list[/b]).",
        ),
    ] = "all",
    detectors: Annotated[
        str, option(METHOD, "NAMES", "Loop detectors of vslam, separated by commas.")
    ] = "both",
    systems: Annotated[
        str,
        option(
            METHOD, "NAMES", "Systems to test: [b]vslam[/b], [b]orbslam3[/b] and those of --system."
        ),
    ] = "vslam",
    system: Annotated[
        list[str] | None,
        option(
            METHOD,
            "NAME=COMMAND",
            "Another system: a command that reads {folder}, in KITTI's format, and writes "
            "{out} (docs/howto/stress.md).",
        ),
    ] = None,
    orbslam3_python: Annotated[
        Path | None,
        option(METHOD, "FILE", "Python interpreter that has pyorbslam3.", unset="this one"),
    ] = None,
    vocabulary: Annotated[
        Path | None, option(METHOD, "FILE", "Vocabulary of ORB-SLAM3, in DBoW2's text format.")
    ] = None,
    preset: Annotated[
        Literal["kitti-c"] | None,
        option(
            METHOD,
            "kitti-c",
            "Test the fixed severities of a published benchmark in place of --laws.",
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        option(
            METHOD,
            "NAME",
            "Detector or system whose errors are the unit of the errors with --preset.",
            unset="the first",
        ),
    ] = None,
    seeds: Seeds = 3,
    steps: Annotated[
        int, option(METHOD, "N", "Bisection steps of each search.", min=1, max=10)
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
            "A run fails if its ATE exceeds that of the clean run by this factor.",
            min=1.0,
        ),
    ] = 3.0,
    ate_least: Annotated[
        float, option(_FAILURE, "METRES", "An ATE below this one is never a failure.", min=0.0)
    ] = 0.25,
    config: Thresholds = None,
    jobs: Jobs = 1,
    threads: ThreadsOfRun = None,
    scheduler: Scheduler = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("stress"),
    quiet: Quiet = False,
) -> None:
    """Find the strength of each perturbation at which a run fails."""
    from vslam.cli.console import console
    from vslam.cli.tables import show_sections
    from vslam.datasets.frames import first_frames
    from vslam.lab.bench import execute
    from vslam.lab.bench.grid import thresholds_digest
    from vslam.lab.stress.criterion import Criterion
    from vslam.lab.stress.plan import Plan, parse_laws
    from vslam.lab.stress.report import boundary_sections, write_report
    from vslam.lab.stress.run import Results, run_all
    from vslam.lab.stress.summary import summarise
    from vslam.loopclosure.registry import require_detector

    others = _others(names_in(systems), system or [], orbslam3_python, vocabulary)
    chosen = names_in(detectors) if "vslam" in names_in(systems) else []
    for name in chosen:
        require_detector(name, None, option="--detectors")
    names = [*chosen, *others]
    if clash := [name for name in chosen if name in others]:
        raise InputError(f"--system {clash[0]}: a detector of this test has that name; rename it.")
    if not names:
        raise InputError("--systems: names no system; name vslam, orbslam3 or one of --system.")
    if baseline is not None and baseline not in names:
        raise InputError(
            f"--baseline {baseline}: not tested{did_you_mean(baseline, names)}; choose from "
            f"{', '.join(names)}."
        )
    if given.sensor == "mono" and others:
        raise InputError("--sensor mono: only vslam supports it; other systems need both cameras.")
    out = out.absolute()
    kind = kind_of_source(given)
    given = absolute(given)
    opened = open_all(kind, given, seqs, shown=not quiet)
    if others and not all(source.seekable for source in opened.values()):
        raise InputError(
            f"--systems {next(iter(others))}: other systems read KITTI's format, which vslam can "
            "write only from data sets and folders of images; extract the images, or test vslam "
            "alone."
        )
    options = replace(
        cell_options(kind, given, config, threads, jobs, scheduler, out),
        others={name: _program(name, command) for name, command in others.items()},
    )
    fitting, notes = _fitting(parse_laws(laws), opened) if preset is None else ([], [])
    plan = Plan(
        kind, tuple(opened), tuple(fitting), tuple(names), seeds, steps, given.max_frames,
        baseline or names[0], Criterion(max_lost, ate_factor, ate_least), tuple(others), preset,
        given.sensor, tuple(map(str, given.calib)), thresholds_digest(options.config),
    )  # fmt: skip
    execute.prepare(out, identity_of(kind, given))
    searches, results = plan.searches(), Results(out, options.config)

    def run(cells: Collection[Cell]) -> Generator[CellOutcome, None, None]:
        return outcomes_of(list(cells), options, jobs, scheduler, out, shown=not quiet)

    announce = console(shown=not quiet).announce
    announce(plan.criterion.words)
    stopped = False
    try:
        run_all(
            plan.clean_cells(), searches, plan.preset_cells(), results, plan.criterion, run,
            announce,
        )  # fmt: skip
    except KeyboardInterrupt:
        stopped = True
    finally:
        execute.tidy(out)
    report = summarise(plan, searches, results, notes)
    write_report(out, report, {name: first_frames(source) for name, source in opened.items()})
    if not quiet:
        show_sections(boundary_sections(report))
        ended = f"finished {len(report.boundaries)} of {len(searches)} searches"
        typer.echo(f"{out / 'report.html'}: {ended}")
    if stopped or len(report.boundaries) < len(searches):
        raise typer.Exit(1)


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
    """Run another system on a sequence and write a run's report; used by [b]vslam stress[/b]."""
    from vslam.cli.console import console
    from vslam.config import load_config
    from vslam.datasets.perturbation import parse_perturbation
    from vslam.lab.stress.external import run_external
    from vslam.report.folder import create_run_folder
    from vslam.run.options import RunOptions

    options = RunOptions(
        **given.model_dump(), perturb=perturb, seed=seed, threads=threads, detector=name,
        thresholds=load_config(config),
    )  # fmt: skip
    source = open_given(given, console(shown=False))
    perturbation = parse_perturbation(perturb, seed)
    settings = options.model_copy(update={"perturb": perturbation.name})
    folder = create_run_folder(out, source.dataset, source.name, perturbation.name, name)
    run_external(source, perturbation, settings, template, folder)


def _others(
    systems: list[str], given: list[str], python: Path | None, vocabulary: Path | None
) -> dict[str, str]:
    """Command templates of the other systems."""
    from vslam.lab.stress import orbslam3
    from vslam.lab.stress.external import check_template

    templates: dict[str, str] = {}
    for text in given:
        name, separator, command = text.partition("=")
        if not (name and separator):
            raise InputError(f"--system {text}: write NAME=COMMAND.")
        check_template(name, command)
        templates[name] = command
    if _ORBSLAM3 in systems and _ORBSLAM3 not in templates:
        if vocabulary is None or not vocabulary.is_file():
            raise InputError(
                "--systems orbslam3: name its vocabulary, DBoW2's text format, with --vocabulary."
            )
        interpreter = python or Path(sys.executable)
        if not interpreter.exists():
            raise InputError(f"--orbslam3-python {interpreter}: no such file; name an interpreter.")
        words = [interpreter.absolute(), Path(orbslam3.__file__), vocabulary.absolute()]
        templates[_ORBSLAM3] = f"{shlex.join(map(str, words))} {{folder}} {{out}}"
    for name in systems:
        if name != "vslam" and name not in templates:
            raise InputError(
                f"--systems {name}: unknown{did_you_mean(name, ('vslam', _ORBSLAM3, *templates))}; "
                f"name vslam, orbslam3, or give --system {name}=COMMAND."
            )
    return {name: templates[name] for name in [*systems, *templates] if name in templates}


def _program(name: str, template: str) -> tuple[str, ...]:
    return (sys.executable, "-m", "vslam.cli.child", "foreign", name, template)


def _fitting(laws: list[str], opened: Mapping[str, Source]) -> tuple[list[str], list[str]]:
    """The laws that every sequence has the data for, and a note on each of the others."""
    from vslam.datasets.perturbation import laws_for

    notes: dict[str, None] = {}
    for sequence in opened.values():
        fit, unfit = laws_for(sequence)
        notes |= {why: None for law, why in unfit.items() if law in laws}
        laws = [law for law in laws if law in fit]
    if not laws:
        raise InputError(f"--laws: none of them can be tested here. {next(iter(notes))}")
    return laws, [f"left out: {why}" for why in notes]
