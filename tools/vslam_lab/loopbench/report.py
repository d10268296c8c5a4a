"""Writes the report of a comparison of loop detectors as Markdown, HTML and JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import numpy as np

from vslam.report.page import Bullets, Page, Pairs, Section, Table
from vslam.report.render import page_files, write_files
from vslam.support.errors import counted
from vslam_lab.loopbench.curves import draw_curves
from vslam_lab.loopbench.measure import LENGTH, MIN_CONFIRMED, MIN_MATCHES, TOP
from vslam_lab.loopbench.schema import LoopsJson, OnlineScore, Score

_Scored = TypeVar("_Scored", bound=Score | OnlineScore)

MEAN = "mean of all"
_ABOUT_AP = (
    "Average precision (AP) without verification, over all pairs of a query and a gallery image "
    "whose relation is known. The last columns give the AP of a detector minus that of the first "
    "one, with a 95 % bootstrap interval over the queries. A * marks intervals that exclude 0."
)
_ABOUT_TOP = (
    "Average precision over the K most similar gallery images of each query, for the lowest and "
    "the highest K, and its mean over all K. If the place of a query is not in the gallery, all of "
    "its K images are wrong. If a query has several true matches, up to K of them must be found."
)
_ABOUT_RECALL = "The highest recall without a wrong pair, and the precision at a recall of 70 %."
_ABOUT_VERIFIED = (
    "The first number is the share of queries whose most similar gallery image shows the same "
    "place. Only queries whose place is in the gallery count. The next numbers are the shares for "
    "which this image is also verified by ORB, by learned descriptors, or by at least one of them. "
    f"ORB verifies a pair of images if at least {MIN_MATCHES} matches fit one epipolar geometry. "
    "The learned test counts the coarse matches that fit one homography, and multiplies their "
    "number by the share of the fine matches that fit one homography. It verifies a pair if the "
    f"product is at least {MIN_CONFIRMED}."
)
_ABOUT_SEQUENCES = (
    "The share of queries whose most similar gallery image shows the same place. The first number "
    "uses the scores of single images. The second number uses the scores of sequences of "
    f"{LENGTH} queries (SeqSLAM), which need images in driving order."
)
_ABOUT_WRONG = "The number of queries whose most similar image is verified but shows another place."
_ABOUT_ACCURACY = (
    "Balanced accuracy at a threshold on the probability p that the detector computes. It is the "
    "mean of two shares: the true pairs and the false pairs that are classified correctly."
)
_ABOUT_ACCEPTED = (
    "Precision and recall of the pairs with p of at least 0.9. If there are no such pairs, the "
    "precision is 1."
)
_ABOUT_COST = (
    "All values are medians. Each detector runs in its own process with one thread. The time for "
    "an image does not include the ORB features, which tracking extracts anyway. The parameters of "
    "bow are the weights of its words."
)

_ABOUT_ONLINE = (
    "Each image is compared with the images before the window. Recall is the share of images with "
    "a right decision among those with a true match before the window. The recall in brackets does "
    "not count unmarked matches near the place as wrong."
)
_ABOUT_DECISIONS = (
    "The numbers of decisions at the lowest threshold. The match of a decision is marked as the "
    "same place (right), is near the place but not marked (near), or shows another place (far)."
)


def write_report(report: LoopsJson, out: Path) -> None:
    """Write ``loops.json``, ``loops.md`` and ``loops.html`` into the folder ``out``.

    Raises:
        ResultsError: a file cannot be written.
    """
    write_files(out, {"loops.json": report.to_json(), **page_files(loops_page(report), "loops")})


def loops_page(report: LoopsJson) -> Page:
    """Make the page of a comparison of loop detectors."""
    return Page(
        title(report),
        (f"vslam {report.versions.get('vslam', '')}", f"{report.created:%Y-%m-%d %H:%M %Z}"),
        (
            Section("Summary", [Bullets(words(report))]),
            Section("", draw_curves(report), wide=False),
            *tables(report),
            Section("Provenance", [Pairs(_provenance(report))]),
        ),
    )


def title(report: LoopsJson) -> str:
    """Return a title that names the compared loop detectors."""
    return f"Loop detectors: {', '.join(_detectors(report))}"


def words(report: LoopsJson) -> list[str]:
    """Return sentences that summarise a comparison of loop detectors.

    The sentences compare each detector with the first detector, under each condition (change of the
    query images). They also name the best detector on each drive.
    """
    sentences = _online_words(report.online)
    for first, second in dict.fromkeys((g.first, g.second) for g in report.gains):
        for condition in _conditions(report):
            gains = [g for g in report.gains
                     if (g.first, g.second, g.condition) == (first, second, condition)]  # fmt: skip
            better = [g.data for g in gains if g.low > 0]
            worse = [g.data for g in gains if g.high < 0]
            mean = float(np.mean([g.difference for g in gains]))
            verdicts = [f"better on {', '.join(better)}"] if better else []
            verdicts += [f"worse on {', '.join(worse)}"] if worse else []
            verdict = "; ".join(verdicts) or "no significant difference on any set"
            sentences.append(
                f"{condition}: AP of {second} minus that of {first} is {mean:+.3f}, the mean of "
                f"{counted(len(gains), 'set')}; {verdict}."
            )
    return sentences


def tables(report: LoopsJson) -> list[Section]:
    if not report.cells:
        return _online_tables(report.online)
    names = _detectors(report)
    gains = (f"{second} - {first}" for first, second in _compared(report))
    head = ("images", "condition", *names, *gains)
    found = [
        Section("Average precision", [Table(head, _ap_rows(report), head[:2], _ABOUT_AP)]),
        *(_retrieval_table(report, *one) for one in _TABLES),
    ]
    if report.costs:
        heads = [f"query of {n} (ms)" for n in report.costs[0].query_ms]
        rows = [
            (c.detector, f"{c.load_s:.2f}", f"{c.image_ms:.1f}",
             *(f"{ms:.2f}" for ms in c.query_ms.values()), f"{c.parameters / 1e6:.2f}",
             f"{c.memory_mb:.0f}")
            for c in report.costs
        ]  # fmt: skip
        head = ("detector", "load (s)", "image (ms)", *heads, "parameters (M)", "memory (MB)")
        found.append(Section("Cost", [Table(head, rows, ("detector",), _ABOUT_COST)]))
    return found


def _accepted(score: Score) -> str:
    return "-" if score.accepted is None else _listed(score.accepted)


def _sequence(score: Score) -> str:
    return _listed((score.first_right, score.sequence_right))


def _top(score: Score) -> str:
    return _listed(top_figures(score).values()) or "-"


def top_figures(score: Score) -> dict[str, float]:
    """Return the average precision over the top K candidates, for the lowest and the highest K, and
    its mean over K; empty for older files."""
    ap = score.top_average_precision
    return {"top_1": ap[0], f"top_{len(ap)}": ap[-1], "top_mean": float(np.mean(ap))} if ap else {}


def _operating_points(score: Score) -> str:
    names = ("recall_at_100_precision", "precision_at_70_recall")
    return _listed(score.figures[name] for name in names)


def _verified(score: Score) -> str:
    return _listed((score.first_right, *(v.right for v in score.verified.values())))


def _listed(values: Iterable[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.3f}" for value in values)


# Title, text of a cell, and note of each table that has one column for each detector.
_TABLES: list[tuple[str, Callable[[Score], str], str]] = [
    (f"Average precision over the top K candidates, K = 1, {TOP}, mean", _top, _ABOUT_TOP),
    ("Recall at 100 % precision, precision at 70 % recall", _operating_points, _ABOUT_RECALL),
    ("Best image right, and also verified by ORB, by learned descriptors, by either", _verified,
     _ABOUT_VERIFIED),
    ("Best image right, by single images, by sequences", _sequence, _ABOUT_SEQUENCES),
    ("Wrong images verified by ORB, by learned descriptors, by either",
     lambda score: ", ".join(str(v.wrong) for v in score.verified.values()), _ABOUT_WRONG),
    ("Largest F1", lambda score: f"{score.figures['max_f1']:.3f}", ""),
    ("Accuracy at p = 0.5, 0.9", lambda score: _listed(score.accuracy.values()), _ABOUT_ACCURACY),
    ("Precision, recall at p = 0.9", _accepted, _ABOUT_ACCEPTED),
]  # fmt: skip


def _compared(report: LoopsJson) -> list[tuple[str, str]]:
    return list(dict.fromkeys((g.first, g.second) for g in report.gains))


def _ap_rows(report: LoopsJson) -> list[tuple[str, ...]]:
    ap = {(c.data, c.condition, c.detector): c.figures["average_precision"] for c in report.cells}
    gain = {(g.data, g.condition, g.second): g for g in report.gains}
    rows: list[tuple[str, ...]] = []
    for condition in _conditions(report):
        sets = [d for d in _data(report) if any(key[:2] == (d, condition) for key in ap)]
        for data in sets:
            row = [f"{ap[data, condition, name]:.3f}" for name in _detectors(report)]
            for _, second in _compared(report):
                g = gain[data, condition, second]
                star = "*" if g.low > 0 or g.high < 0 else ""
                row.append(f"{g.difference:+.3f} ({g.low:+.3f}, {g.high:+.3f}){star}")
            rows.append((data, condition, *row))
        means = [float(np.mean([ap[d, condition, name] for d in sets]))
                 for name in _detectors(report)]  # fmt: skip
        row = [f"{mean:.3f}" for mean in means]
        row += [f"{mean - means[0]:+.3f}" for mean in means[1:]]
        rows.append((MEAN, condition, *row))
    return rows


def _retrieval_table(
    report: LoopsJson, title: str, shown: Callable[[Score], str], note: str
) -> Section:
    scores = [c for one in _conditions(report) for c in report.cells if c.condition == one]
    head = ("images", "condition")
    table = _by_detector(scores, head, lambda c: (c.data, c.condition), shown)
    return Section(title, [Table(*table, head, note)])


def _online_tables(scores: Iterable[OnlineScore]) -> list[Section]:
    head = ("drive", "images", "with a match", "window", "verified by")
    texts = ("drive", "window", "verified by")

    def about(s: OnlineScore) -> tuple[str, ...]:
        return s.data, str(s.images), str(s.answerable), s.window, s.verified_by

    shown: list[tuple[str, Callable[[OnlineScore], str], str]] = [
        ("Recall at 100 % precision",
         lambda s: f"{s.recall_at_100_precision:.3f} ({s.recall_at_100_precision_far:.3f})",
         _ABOUT_ONLINE),
        ("Largest F1", lambda s: f"{s.max_f1:.3f} ({s.max_f1_far:.3f})", ""),
        ("Decisions right / near / far", lambda s: f"{s.right} / {s.near} / {s.far}",
         _ABOUT_DECISIONS),
    ]  # fmt: skip
    return [
        Section(title, [Table(*_by_detector(scores, head, about, cell), texts, note)])
        for title, cell, note in shown
    ]


def _by_detector(
    scores: Iterable[_Scored],
    head: tuple[str, ...],
    about: Callable[[_Scored], tuple[str, ...]],
    shown: Callable[[_Scored], str],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and the rows of a table that has one column for each loop detector.

    Args:
        head: titles of the first columns.
        about: function that returns the entries of the first columns for a result.
        shown: function that returns the entry in the column of the detector for a result.
    """
    rows: dict[tuple[str, ...], dict[str, str]] = {}
    for score in scores:
        rows.setdefault(about(score), {})[score.detector] = shown(score)
    names = list(dict.fromkeys(name for cells in rows.values() for name in cells))
    return (*head, *names), [(*key, *(cells[n] for n in names)) for key, cells in rows.items()]


def _online_words(scores: Iterable[OnlineScore]) -> list[str]:
    """Name the detector with the highest recall at 100 % precision, for each drive."""
    sentences = []
    for data in dict.fromkeys(s.data for s in scores):
        for by in ("nothing", "both"):
            group = [s for s in scores if (s.data, s.verified_by) == (data, by)]
            best = max(s.recall_at_100_precision for s in group)
            names = [s.detector for s in group if s.recall_at_100_precision == best]
            how = "unverified" if by == "nothing" else "verified by ORB or learned descriptors"
            sentences.append(
                f"{data} ({group[0].answerable} of {group[0].images} images have a true match), "
                f"{how}: the highest recall at 100 % precision is {best:.3f} ({', '.join(names)})."
            )
    return sentences


def _detectors(report: LoopsJson) -> list[str]:
    names = [c.detector for c in report.cells] + [c.detector for c in report.online]
    return list(dict.fromkeys(names))


def _conditions(report: LoopsJson) -> list[str]:
    return list(dict.fromkeys(c.condition for c in report.cells))


def _data(report: LoopsJson) -> list[str]:
    return list(dict.fromkeys(c.data for c in report.cells))


def _provenance(report: LoopsJson) -> list[tuple[str, str]]:
    return [
        ("machine", report.machine),
        ("vslam", report.versions.get("vslam", "")),
        ("seed", str(report.seed)),
        ("created", f"{report.created:%Y-%m-%d %H:%M:%S %Z}"),
    ]
