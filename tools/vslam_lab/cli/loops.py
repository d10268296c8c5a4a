"""The commands ``vslam loops ...``, which compare loop detectors on images."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vslam.cli.options import (
    AllThreads,
    Detectors,
    Quiet,
    Seed,
    Weights,
    names_in,
    option,
    require_writable,
)
from vslam.support.errors import InputError, counted
from vslam.support.options import INPUT, METHOD, OUTPUT

if TYPE_CHECKING:
    from vslam_lab.loopbench.schema import Gain, OnlineScore, Score

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
            "[b]retrieval[/b] searches a gallery of images for each query image. [b]online[/b] "
            "compares each image of a drive with the earlier images and decides at once.",
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
            "fabmap:DIR. Repeat the option for several sources.",
            unset="three towns, or two drives",
        ),
    ] = None,
    detectors: Detectors = "bow,capsule,capsule-pruned",
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
        option(METHOD, "NUMBERS", "Strengths of the changes, from 0 to 1, separated by commas."),
    ] = STRENGTHS,
    window: Annotated[
        str,
        option(
            METHOD,
            "AGE",
            "With online: the time (20s) or number of images (200) before the query that is not "
            "searched.",
        ),
    ] = WINDOW,
    seed: Seed = 0,
    threads: AllThreads = None,
    out: Annotated[Path, option(OUTPUT, "FOLDER", "Folder to write to.")] = Path("loops-bench"),
    quiet: Quiet = False,
) -> None:
    """Measure precision and recall of loop detectors on images of places or drives."""
    from vslam.loopclosure.registry import parse_weights
    from vslam_lab.loopbench.conditions import parse_conditions
    from vslam_lab.loopbench.detectors import require_comparable
    from vslam_lab.loopbench.online import parse_window

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
        raise InputError("--window: only for --protocol online; add it, or leave out --window.")

    require_writable(out)
    from vslam.cli.console import Console
    from vslam.loopclosure.vocabulary import SHIPPED
    from vslam.loopclosure.vocabulary_text import read_vocabulary
    from vslam.support.machine import available_cores
    from vslam_lab.loopbench.cost import cost
    from vslam_lab.loopbench.detectors import DetectorSet, open_scorer
    from vslam_lab.loopbench.drives import open_drives
    from vslam_lab.loopbench.measure import measure
    from vslam_lab.loopbench.measure_online import measure_drive
    from vslam_lab.loopbench.sets import open_set
    from vslam_lab.towns import store

    vocabulary = read_vocabulary(files.get("bow", SHIPPED))
    scorers = [open_scorer(name, files.get(name), vocabulary) for name in names]
    threads, console = threads or available_cores(), Console(shown=not quiet)
    cache, bar = store.cache_folder(), console.count_bar
    # The report is written after every set. If the command is stopped, little work is lost.
    if protocol == "online":
        drives = [
            drive
            for spec in data or DRIVES
            for drive in open_drives(spec, cache, threads=threads, progress_bar=bar)
        ]
        online: list[OnlineScore] = []
        for drive in drives:
            online += measure_drive(drive, scorers, youngest, vocabulary, threads=threads)
            _write(out, seed, online=online)
        done = counted(len(drives), "drive")
    else:
        sets = [
            found
            for spec in data or DATA
            for found in open_set(spec, cache, threads=threads, progress_bar=bar)
        ]
        console.announce("time and memory of each detector ...")
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
            _write(out, seed, cells=scores, gains=gains, costs=costs)
        done = f"{counted(len(sets), 'set')} of images"
    if not quiet:
        typer.echo(f"{out / 'loops.html'}: {counted(len(names), 'detector')} on {done}")


def _write(out: Path, seed: int, **found: object) -> None:
    from vslam.report.summary import this_machine
    from vslam.support.machine import versions
    from vslam_lab.loopbench.report import write_report
    from vslam_lab.loopbench.schema import LoopsJson

    report = {
        **found,
        "seed": seed,
        "machine": str(this_machine()),
        "versions": versions(),
        "created": datetime.now(UTC),
    }
    write_report(LoopsJson.model_validate(report), out)
