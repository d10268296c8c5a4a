"""The commands ``vslam loops ...``: loop detectors compared on images."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import Weights, names_in
from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam loops bench --detectors bow,capsule

  vslam loops bench --data "kitti:~/kitti\\[seq=00,frames=0-249+1500-1699,truth=kitti00.mat]"

  vslam loops bench --detectors capsule,alexnet --weights alexnet=training/alexnet.onnx
"""
DATA = ("town:demo[seed=101]", "town:05[seed=102]", "town:demo[seed=103,aliased=1]")
commands = typer.Typer(help="Compare loop detectors.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.add_typer(commands, name="loops")


@commands.callback()
def _group() -> None:
    """Keep the name of the command: a group of one command would lose it."""


@commands.command("bench", epilog=_EXAMPLES)
def bench(
    data: Annotated[
        list[str] | None,
        typer.Option(
            help="Images: [b]town:ROUTE\\[seed=101,aliased=1,places=150][/b], rendered, or a "
            "source as of [b]vslam train[/b]; again for more.",
            show_default="three towns",
        ),
    ] = None,
    detectors: Annotated[
        str, typer.Option(help="With commas; the first is what others are compared with.")
    ] = "bow,capsule,capsule-pruned",
    weights: Weights = None,
    perturb: Annotated[
        str,
        typer.Option(
            help="What is done to the query images: light, clipping, viewpoint, occlusion, "
            "noise, blur, change (rendered towns only), all; with commas."
        ),
    ] = "none,light,clipping,viewpoint,occlusion,noise,blur,change,all",
    strengths: Annotated[str, typer.Option(help="From 0 to 1, with commas.")] = "0.5,1",
    seed: Annotated[int, typer.Option(min=0, help="Of what is drawn.")] = 0,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads.", show_default="cores")] = (
        None
    ),
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("loops-bench"),
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Precision and recall of loop detectors under changes of light, view and town."""
    from vslam.loopbench.conditions import parse_conditions
    from vslam.loopclosure.registry import parse_weights, require_detector

    names = names_in(detectors)
    files = parse_weights(weights or [], names)
    for name in names or [""]:
        if name == "none":
            raise InputError("--detectors none: finds nothing; leave it out.")
        if name == "both":
            raise InputError("--detectors both: has no score of its own; name bow,capsule.")
        require_detector(name, files.get(name), "--detectors")
    conditions = parse_conditions(perturb, strengths)

    from vslam.cli.progress import announce, count_bar
    from vslam.datasets.synthetic import store
    from vslam.loopbench.cost import cost
    from vslam.loopbench.detectors import DetectorSet, open_scorer
    from vslam.loopbench.measure import measure
    from vslam.loopbench.report import write_report
    from vslam.loopbench.schema import Gain, LoopsJson, Score
    from vslam.loopbench.sets import open_set
    from vslam.loopclosure.vocabulary import load
    from vslam.machine import available_cores, versions
    from vslam.report.summary import this_machine

    threads = threads or available_cores()
    here = this_machine()
    machine = f"{here.cpu}, {here.cores} cores"
    vocabulary = load()
    bar = partial(count_bar, shown=not quiet)
    scorers = [open_scorer(name, files.get(name), vocabulary) for name in names]
    sets = [
        found
        for spec in data or DATA
        for found in open_set(spec, store.cache_folder(), threads=threads, progress_bar=bar)
    ]
    announce("time and memory of each detector ...", shown=not quiet)
    costs = [cost(name, files.get(name)) for name in names]
    scores: list[Score] = []
    gains: list[Gain] = []
    for test_set in sets:
        compared = DetectorSet(scorers, vocabulary, threads)
        with bar(test_set.title, len(conditions)) as advance:
            for condition in conditions:
                more = measure(test_set, condition, compared, seed)
                scores, gains = scores + more[0], gains + more[1]
                advance()
        # After every set, so that a run that is stopped has told what it found.
        report = LoopsJson(
            seed=seed, cells=scores, gains=gains, costs=costs, machine=machine,
            versions=versions(), created=datetime.now(UTC),
        )  # fmt: skip
        write_report(report, out)
    if not quiet:
        typer.echo(f"{out / 'loops.html'}: {len(names)} detectors on {len(sets)} sets of images")
