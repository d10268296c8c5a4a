"""The commands ``vslam loops ...``: loop detectors compared on images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import typer

from vslam.cli.options import (
    INPUT,
    METHOD,
    OUTPUT,
    AllThreads,
    Quiet,
    Seed,
    Weights,
    names_in,
    option,
)
from vslam.errors import InputError, counted

if TYPE_CHECKING:
    from vslam.lab.loopbench.conditions import Condition
    from vslam.lab.loopbench.online import Window
    from vslam.lab.loopbench.schema import Gain, OnlineScore, Score
    from vslam.lab.loopbench.sets import ProgressBar
    from vslam.loopclosure.vocabulary import Vocabulary

_EXAMPLES = """
[b]Examples[/b]
  vslam loops bench --detectors bow,capsule
  vslam loops bench --data "kitti:~/kitti\\[seq=00,truth=kitti00.mat]"
  vslam loops bench --detectors bow,capsule --weights capsule=capsule.onnx
  vslam loops bench --protocol online --detectors bow,capsule
"""
DATA = ("town:demo[seed=101]", "town:05[seed=102]", "town:demo[seed=103,aliased=1]")
DRIVES = ("drive:05[seed=102]", "drive:demo[seed=103,aliased=1,every=5]")
PERTURB, STRENGTHS = "none,light,clipping,viewpoint,occlusion,noise,blur,change,all", "0.5,1"
WINDOW = "20s"
app = typer.Typer(name="loops", help="Compare loop detectors.", no_args_is_help=True)


@app.command("bench", epilog=_EXAMPLES)
def bench(
    protocol: Annotated[
        Literal["retrieval", "online"],
        option(
            METHOD,
            "retrieval|online",
            "[b]retrieval[/b] searches a gallery for every query; [b]online[/b] decides once "
            "per image of a drive, searching the images before it.",
        ),
    ] = "retrieval",
    data: Annotated[
        list[str] | None,
        option(
            INPUT,
            "SOURCE",
            "Images: rendered places, [b]town:ROUTE\\[seed=101,aliased=1,places=150][/b], "
            "or a source of [b]vslam train[/b]. With online: a rendered drive, "
            "[b]drive:ROUTE\\[seed=101,aliased=1,change=0.5,every=10][/b], kitti:DIR or "
            "fabmap:DIR. Repeat for more.",
            unset="three towns, or two drives",
        ),
    ] = None,
    detectors: Annotated[
        str,
        option(METHOD, "NAMES", "Loop detectors, separated by commas; the first is the baseline."),
    ] = "bow,capsule,capsule-pruned",
    weights: Weights = None,
    perturb: Annotated[
        str,
        option(
            METHOD,
            "NAMES",
            "Changes of the query images: light, clipping, viewpoint, occlusion, noise, blur, "
            "change (rendered towns only), all.",
        ),
    ] = PERTURB,
    strengths: Annotated[
        str,
        option(METHOD, "NUMBERS", "Strengths of these changes, from 0 to 1, separated by commas."),
    ] = STRENGTHS,
    window: Annotated[
        str,
        option(
            METHOD,
            "AGE",
            "With online: search images that are at least this much older than the query, in "
            "seconds (20s) or images (200).",
        ),
    ] = WINDOW,
    seed: Seed = 0,
    threads: AllThreads = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("loops-bench"),
    quiet: Quiet = False,
) -> None:
    """Measure precision and recall of loop detectors on images of places or drives."""
    from vslam.lab.loopbench.conditions import parse_conditions
    from vslam.lab.loopbench.detectors import require_comparable
    from vslam.lab.loopbench.online import parse_window
    from vslam.loopclosure.registry import parse_weights

    names = names_in(detectors)
    files = parse_weights(weights or [], names)
    for name in names or [""]:
        require_comparable(name, files.get(name))
    conditions, youngest = parse_conditions(perturb, strengths), parse_window(window)
    if protocol == "online" and (perturb, strengths, seed) != (PERTURB, STRENGTHS, 0):
        raise InputError(
            "--perturb, --strengths, --seed: only for --protocol retrieval; leave them out with "
            "online."
        )
    if protocol == "retrieval" and window != WINDOW:
        raise InputError("--window: only for --protocol online; add that or leave it out.")

    _require_writable(out)
    from vslam.cli.console import Console
    from vslam.loopclosure.vocabulary import SHIPPED
    from vslam.loopclosure.vocabulary_text import read_vocabulary
    from vslam.machine import available_cores

    asked = _Asked(
        names,
        files,
        read_vocabulary(files.get("bow", SHIPPED)),
        seed,
        threads or available_cores(),
        Console(shown=not quiet).count_bar,
    )
    write = partial(_write, out, seed)
    # The report is written after every set, so that a command that is stopped keeps its results.
    if protocol == "online":
        done = _on_drives(asked, data or DRIVES, youngest, write)
    else:
        done = _on_sets(asked, data or DATA, conditions, write, quiet=quiet)
    if not quiet:
        typer.echo(f"{out / 'loops.html'}: {counted(len(names), 'detector')} on {done}")


class _Asked(NamedTuple):
    """What both protocols need."""

    names: list[str]
    files: dict[str, Path]
    vocabulary: Vocabulary
    seed: int
    threads: int
    progress_bar: ProgressBar


def _on_drives(
    asked: _Asked, data: Sequence[str], window: Window, write: Callable[..., None]
) -> str:
    """Measure in the online protocol of the literature; returns what was measured on."""
    from vslam.datasets.synthetic import store
    from vslam.lab.loopbench.detectors import open_scorer
    from vslam.lab.loopbench.drives import open_drives
    from vslam.lab.loopbench.measure_online import measure_drive

    scorers = [open_scorer(one, asked.files.get(one), asked.vocabulary) for one in asked.names]
    threads, bar = asked.threads, asked.progress_bar
    drives = [
        drive
        for spec in data
        for drive in open_drives(spec, store.cache_folder(), threads=threads, progress_bar=bar)
    ]
    scores: list[OnlineScore] = []
    for drive in drives:
        scores += measure_drive(drive, scorers, window, asked.vocabulary, threads=threads)
        write(online=scores)
    return counted(len(drives), "drive")


def _on_sets(
    asked: _Asked,
    data: Sequence[str],
    conditions: list[Condition],
    write: Callable[..., None],
    *,
    quiet: bool,
) -> str:
    """Measure queries against galleries; returns what was measured on."""
    from vslam.cli.console import Console
    from vslam.datasets.synthetic import store
    from vslam.lab.loopbench.cost import cost
    from vslam.lab.loopbench.detectors import DetectorSet, open_scorer
    from vslam.lab.loopbench.measure import measure
    from vslam.lab.loopbench.sets import open_set

    scorers = [open_scorer(one, asked.files.get(one), asked.vocabulary) for one in asked.names]
    threads, bar = asked.threads, asked.progress_bar
    sets = [
        found
        for spec in data
        for found in open_set(spec, store.cache_folder(), threads=threads, progress_bar=bar)
    ]
    Console(shown=not quiet).announce("time and memory of each detector ...")
    costs = [cost(name, asked.files.get(name)) for name in asked.names]
    scores: list[Score] = []
    gains: list[Gain] = []
    for test_set in sets:
        compared = DetectorSet(scorers, asked.vocabulary, threads)
        with bar(test_set.title, len(conditions)) as advance:
            for condition in conditions:
                more = measure(test_set, condition, compared, asked.seed)
                scores, gains = scores + more[0], gains + more[1]
                advance()
        write(cells=scores, gains=gains, costs=costs)
    return f"{counted(len(sets), 'set')} of images"


def _require_writable(out: Path) -> None:
    """Refuse an output folder that cannot be written, before the work begins."""
    try:
        there = next(path for path in (out, *out.absolute().parents) if path.exists())
        with TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); name another folder with --out."
        ) from error


def _write(out: Path, seed: int, **found: object) -> None:
    """Write the report of what was found so far."""
    from vslam.lab.loopbench.report import write_report
    from vslam.lab.loopbench.schema import LoopsJson
    from vslam.machine import versions
    from vslam.report.summary import this_machine

    here = this_machine()
    report = {
        "cells": [],
        "gains": [],
        "costs": [],
        **found,
        "seed": seed,
        "machine": f"{here.cpu}, {counted(here.cores, 'core')}",
        "versions": versions(),
        "created": datetime.now(UTC),
    }
    write_report(LoopsJson.model_validate(report), out)
