"""Write Table 6 of the paper and its companions, for all networks of docs/research/rivals.md.

python tools/experiments/rivals/rivals_table.py --trained DIR --data SOURCE [--data SOURCE ...]
        [--page docs/research/rivals.md] [--section NAME] [--ways NAMES] [--retime]

DIR is the output of tools/training/train_rivals.py, SOURCE is a source of ``vslam loops bench``. As
in that command, descriptors are measured without verification, in four groups: networks trained on
the same images, networks trained for the same time, untrained detectors, and what vslam ships. The
measurements of each group are stored in a file in DIR/bench and not repeated, except for times with
--retime. DIR/bench also stores --data and digests of the weights, and is refused if they differ.
Tables replace the text between the marks in the page. A folder with the name of the page gets their
numbers as CSV, and precision-recall curves and validation AP by epoch as PNG. Another training has
its own section: marks with its name, and a subfolder.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style

from vslam.cli.progress import count_bar
from vslam.datasets.synthetic import store
from vslam.errors import InputError
from vslam.lab.loopbench.conditions import parse_conditions
from vslam.lab.loopbench.cost import cost
from vslam.lab.loopbench.curves import draw_curves
from vslam.lab.loopbench.detectors import DetectorSet
from vslam.lab.loopbench.kept import digest, keep_conditions
from vslam.lab.loopbench.measure import measure
from vslam.lab.loopbench.registry import comparable_scorer
from vslam.lab.loopbench.schema import LoopsJson, Score
from vslam.lab.loopbench.sets import open_set
from vslam.loopclosure.siamese.inference import OnnxNetwork, open_network
from vslam.loopclosure.siamese.weights import NETWORKS, TO_THE_LETTER, find_weights
from vslam.loopclosure.vocabulary import load
from vslam.machine import versions
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    LOW,
    RED,
    STYLE,
    VIOLET,
    new_figure,
    save,
)
from vslam.report.page import Figure
from vslam.report.render import markdown_table
from vslam.report.summary import this_machine

CONDITIONS = ("light", "viewpoint", "occlusion")
KEYFRAMES = "5000"
WAYS = {
    "images": "Same number of images shown",
    "minutes": "Same time of a core",
    "untrained": "Hand-crafted, without training",
    "shipped": "Trained differently, so not comparable with the others: what vslam ships",
}
SHIPPED = ("bow", "capsule", "capsule-pruned")
UNTRAINED = ("lsgd",)
ABSENT = {"FLCNN": "no definition found"}  # of Table 6
NOTES = {
    "images": "`pcanet` is outside the equal budget, `capsule-pruned` continues from `capsule`.",
    "untrained": "These scores are not probabilities, so there is no accuracy at p = 0.5.",
    "shipped": "Of the parameters of `bow`, 0.10 M are weights of words; its time per image "
    "excludes the extraction of ORB features, which tracking needs anyway.",
}
NOTES["minutes"] = NOTES["images"]
PAIR = ("capsule", "capsule-pruned")
_REPEATS = 200
_COLORS = (BLUE, RED, GREEN, AMBER, VIOLET, GREY)
_DASHES = ("-", "--")  # for the first six networks, and the rest
Row = tuple[str, ...]


def main(words: list[str] | None = None) -> None:
    """Parse the command line, measure what is missing and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trained", type=Path, required=True, help="folder with rivals.csv")
    parser.add_argument("--data", action="append", required=True, help="images to test on")
    parser.add_argument("--page", type=Path, default=Path("docs/research/rivals.md"))
    parser.add_argument("--section", default="tables", help="of the page, to be written")
    parser.add_argument("--ways", default=",".join(WAYS), help="what the section shows")
    parser.add_argument("--retime", action="store_true", help="measure all times again")
    args = parser.parse_args(words)

    training, bench = read_training(args.trained / "rivals.csv"), args.trained / "bench"
    ways = args.ways.split(",")
    if unknown := [way for way in ways if way not in WAYS]:
        sys.exit(f"--ways: {unknown[0]} is none of {', '.join(WAYS)}.")
    text = args.page.read_text()
    marks = (f"<!-- {args.section} -->", f"<!-- end of {args.section} -->")
    if any(mark not in text for mark in marks):
        sys.exit(f"{args.page}: has no marks {marks[0]} and {marks[1]}; add them where tables go.")
    detectors = {way: weights_of(way, training, args.trained) for way in ways}
    try:
        keep_conditions(bench / "conditions.json", conditions(detectors, args.data))
    except InputError as error:
        sys.exit(str(error))
    reports = {
        way: report(bench / f"{way}.json", files, args.data, args.retime)
        for way, files in detectors.items()
    }
    pruned = pruning(bench / "pruning.json", detectors, args.retime)
    folder = args.page.with_suffix("")
    if args.section != "tables":
        folder = folder / args.section
    folder.mkdir(parents=True, exist_ok=True)
    figures = draw_curves(reports["images"]) if "images" in reports else []
    if (args.trained / "progress.csv").exists():
        progress = read_training(args.trained / "progress.csv")
        figures.append(draw_progress(progress))
        write_csv(folder / "progress.csv", table_of(progress))
    images = []
    for figure in figures:
        file = folder / f"{figure.name}.png"
        file.write_bytes(figure.image)
        images.append(f"![{figure.caption}]({file.relative_to(args.page.parent)})")
    write_csv(folder / "table6.csv", table_6(reports, digits=4))
    write_csv(folder / "conditions.csv", every_score(reports))
    write_csv(folder / "training.csv", table_of(training))
    before, _, rest = text.partition(marks[0])
    after = rest.partition(marks[1])[2]
    found = tables(reports, training, pruned, images)
    args.page.write_text(f"{before}{marks[0]}\n\n{found}\n{marks[1]}{after}")


def read_training(path: Path) -> list[dict[str, str]]:
    """Rows of rivals.csv."""
    with path.open() as file:
        return list(csv.DictReader(file))


def table_of(rows: list[dict[str, str]]) -> list[Row]:
    """Head and rows."""
    return [tuple(rows[0]), *(tuple(row.values()) for row in rows)]


def draw_progress(progress: list[dict[str, str]]) -> Figure:
    """Plot validation AP over the number of images, for the networks trained on the same images."""
    rows = [row for row in progress if row["way"] == "images" and row["network"] not in PAIR[1:]]
    with style.context(STYLE, after_reset=True):
        figure, axes = new_figure("Validation after each epoch", "images shown", "AP", LOW)
        for number, name in enumerate(dict.fromkeys(row["network"] for row in rows)):
            mine = [row for row in rows if row["network"] == name]
            axes.plot(
                [int(row["images_shown"]) for row in mine],
                [float(row["validation_ap"]) for row in mine],
                _DASHES[number // len(_COLORS)], color=_COLORS[number % len(_COLORS)], label=name,
            )  # fmt: skip
        axes.set_ylim(0, 1)
        axes.legend(loc="lower right", ncols=2)
        return save("progress", "Average precision in validation after each epoch.", figure)


def weights_of(way: str, training: list[dict[str, str]], folder: Path) -> dict[str, Path | None]:
    """Detectors of a group and their files, None for shipped ones. PCANet is in both groups."""
    if way in ("shipped", "untrained"):
        return dict.fromkeys(SHIPPED if way == "shipped" else UNTRAINED)
    files: dict[str, Path | None] = {
        row["network"]: folder / row["weights"]
        for row in training
        if row["way"] == way or row["network"] == "pcanet"
    }
    return {name: files[name] for name in NETWORKS if name in files}


def conditions(detectors: dict[str, dict[str, Path | None]], data: list[str]) -> dict[str, Any]:
    """The conditions of the measurements: images, and the weights of all existing networks."""
    files = {
        f"weights of {way}/{name}": digest(find_weights(name, path))
        for way, named in detectors.items() for name, path in named.items() if name in NETWORKS
    }  # fmt: skip
    return {"--data": data, **files}


def report(
    path: Path, detectors: dict[str, Path | None], data: list[str], retime: bool
) -> LoopsJson:
    """The measurements of the detectors in a file, after measuring and adding missing ones."""
    here = this_machine()
    empty = LoopsJson(
        seed=0, cells=[], gains=[], costs=[], machine=f"{here.cpu}, {here.cores} cores",
        versions=versions(), created=datetime.now(UTC),
    )  # fmt: skip
    known = LoopsJson.model_validate_json(path.read_bytes()) if path.exists() else empty
    costs = {one.detector: one for one in known.costs}
    missing = {name: file for name, file in detectors.items() if name not in costs}
    cells = known.cells + (measured(missing, data) if missing else [])
    again = detectors if retime else missing
    costs |= {name: cost(name, file) for name, file in again.items()}
    added = {"cells": cells, "costs": [costs[name] for name in detectors]}
    path.parent.mkdir(exist_ok=True)
    path.write_text(known.model_copy(update=added).model_dump_json(indent=1) + "\n")
    return known.model_copy(update=added)


def measured(detectors: dict[str, Path | None], data: list[str]) -> list[Score]:
    """All detectors on all sets, under all conditions at full strength."""
    vocabulary = load()
    scorers = [comparable_scorer(name, file, vocabulary) for name, file in detectors.items()]
    features = vocabulary if "bow" in detectors else None
    cells = []
    for spec in data:
        for test_set in open_set(spec, store.cache_folder(), threads=1, progress_bar=count_bar):
            compared = DetectorSet(scorers, features, 1)
            for condition in parse_conditions(",".join(CONDITIONS), "1"):
                cells += measure(test_set, condition, compared, 0, descriptors_only=True)[0]
    return cells


def pruning(
    path: Path, detectors: dict[str, dict[str, Path | None]], retime: bool
) -> dict[str, list[float]]:
    """``timed_in_turn`` of ``PAIR`` in each group that has both; a file stores the results."""
    known = json.loads(path.read_text()) if path.exists() and not retime else {}
    for way, files in detectors.items():
        if way not in known and set(PAIR) <= set(files):
            known[way] = timed_in_turn([open_network(name, files[name]) for name in PAIR])
    path.write_text(json.dumps(known, indent=1) + "\n")
    return known


def timed_in_turn(networks: list[OnnxNetwork]) -> list[float]:
    """Median milliseconds per image of two networks, and the median ratio of the second's time to
    the first's. They take turns, so that the load of the machine affects both."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, network.size, np.uint8) for network in networks]
    taken = np.empty((_REPEATS, 2))
    for repeat in range(_REPEATS):
        for k, (network, image) in enumerate(zip(networks, images, strict=True)):
            began = time.perf_counter()
            network.embed(image)
            taken[repeat, k] = time.perf_counter() - began
    found = (*(1e3 * np.median(taken, axis=0)), np.median(taken[:, 1] / taken[:, 0]))
    return [round(float(one), 3) for one in found]


def tables(
    reports: dict[str, LoopsJson],
    training: list[dict[str, str]],
    pruned: dict[str, list[float]],
    images: list[str],
) -> str:
    """All tables in Markdown; ``images`` are lines that show the curves of the first group."""
    lines: list[str] = []
    head, *rows = table_6(reports, digits=3)
    lost_head, *lost = condition_table(reports)
    for way in reports:
        title = WAYS[way]
        mine = [row[1:] for row in rows if row[0] == way]
        if way in ("images", "minutes"):
            rivals = [
                name for name in NETWORKS if name != TO_THE_LETTER
            ]  # has a training of its own
            without = dict.fromkeys(rivals, "not trained") | ABSENT
            known = {row[0] for row in mine}
            mine += [
                (name, why, *["-"] * (len(head) - 3))
                for name, why in without.items() if name not in known
            ]  # fmt: skip
        lines += [f"### {title}", "", *markdown_table(head[1:], mine), "", NOTES[way], ""]
        mine = [row[1:] for row in lost if row[0] == way]
        lines += ["Accuracy, precision at 70 % recall, AP:", ""]
        lines += [*markdown_table(lost_head[1:], mine), ""]
        if way == "images":
            lines += [line for image in images for line in (image, "")]
    lines += ["### Time of the network alone", "", *markdown_table(*pruning_table(pruned)), ""]
    lines += [
        f"Medians over {_REPEATS} alternating turns; *less time*: median saving per turn.",
        "",
    ]
    lines += ["### Training", "", *markdown_table(*training_table(training)), ""]
    return "\n".join(lines)


def table_6(reports: dict[str, LoopsJson], digits: int) -> list[Row]:
    """Head and rows: unchanged images, means of the sets."""
    head = ("way", "network", "accuracy", "precision at 70 % recall", "AP", "image (ms)",
            f"query of {KEYFRAMES} (ms)", "parameters (M)")  # fmt: skip
    rows = [head]
    for way, report in reports.items():
        for one in report.costs:
            figures = [
                mean(report, one.detector, "none", value)
                for value in (accuracy, precision_at_70, average_precision)
            ]
            rows.append((
                way, one.detector, *(rounded(figure, digits) for figure in figures),
                f"{one.image_ms:.1f}", f"{one.query_ms[KEYFRAMES]:.1f}",
                f"{one.parameters / 1e6:.2f}",
            ))  # fmt: skip
    return rows


def condition_table(reports: dict[str, LoopsJson]) -> list[Row]:
    """Head and rows: figures under each condition, means of the sets."""
    conditions = ("none", *(f"{kind}:1" for kind in CONDITIONS))
    rows: list[Row] = [("way", "network", *("none", *CONDITIONS))]
    for way, report in reports.items():
        for one in report.costs:
            cells = [
                ", ".join(rounded(mean(report, one.detector, condition, value), 3)
                          for value in (accuracy, precision_at_70, average_precision))
                for condition in conditions
            ]  # fmt: skip
            rows.append((way, one.detector, *cells))
    return rows


def training_table(training: list[dict[str, str]]) -> tuple[Row, list[Row]]:
    """Head and rows: the progress of each network; a pruned one includes its first training."""
    head = ("equal", "network", "images shown", "core minutes", "loss, first and last epoch",
            "validation AP, last two epochs")  # fmt: skip
    rows = []
    whole = {row["way"]: row for row in training if row["network"] == "capsule"}
    for row in training:
        learned = row["network"] == "pcanet"
        parts = [row, whole[row["way"]]] if row["network"] == "capsule-pruned" else [row]
        rows.append((
            "nothing" if learned else row["way"], row["network"],
            f"{sum(int(part['images_shown']) for part in parts):,}",
            f"{sum(float(part['core_seconds']) for part in parts) / 60:.2f}",
            "-" if learned else f"{float(row['first_loss']):.2f}, {float(row['last_loss']):.2f}",
            ", ".join(f"{float(row[key]):.3f}" for key in ("ap_before_last", "ap_last")),
        ))  # fmt: skip
    return head, rows


def pruning_table(pruned: dict[str, list[float]]) -> tuple[Row, list[Row]]:
    """Head and rows: what pruning saves."""
    rows = [
        (WAYS[way].rpartition(": ")[2], f"{whole:.2f}", f"{less:.2f}",
         f"{100 * (1 - share):.0f} %")
        for way, (whole, less, share) in pruned.items()
    ]  # fmt: skip
    return ("training", *(f"{name} (ms)" for name in PAIR), "less time"), rows


def every_score(reports: dict[str, LoopsJson]) -> list[Row]:
    """Head and rows of conditions.csv: nothing is averaged."""
    rows: list[Row] = [
        ("way", "network", "images", "condition", "accuracy", "precision_at_70_recall",
         "average_precision", "first_right")
    ]  # fmt: skip
    for way, report in reports.items():
        rows += [
            (way, cell.detector, cell.data, cell.condition,
             *(rounded(value(cell), 4) for value in
               (accuracy, precision_at_70, average_precision)), f"{cell.first_right:.4f}")
            for cell in report.cells
        ]  # fmt: skip
    return rows


def accuracy(score: Score) -> float | None:
    """Balanced accuracy at p = 0.5; None for the bag of words."""
    return score.accuracy["0.5"]


def precision_at_70(score: Score) -> float | None:
    return score.figures["precision_at_70_recall"]


def average_precision(score: Score) -> float | None:
    return score.figures["average_precision"]


def mean(
    report: LoopsJson, detector: str, condition: str, value: Callable[[Score], float | None]
) -> float | None:
    """Mean over the sets of images; None where a set has no value."""
    found = [value(cell) for cell in report.cells
             if (cell.detector, cell.condition) == (detector, condition)]  # fmt: skip
    known = [one for one in found if one is not None]
    return statistics.mean(known) if known and len(known) == len(found) else None


def rounded(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def write_csv(path: Path, rows: Iterable[Sequence[str]]) -> None:
    """Write head and rows."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
