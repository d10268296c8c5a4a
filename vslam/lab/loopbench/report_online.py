"""The part of the report about the protocol ``online``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from vslam.lab.loopbench.schema import OnlineScore
from vslam.report.page import Section, Table

_VERIFIED = ("nothing", "orb", "learned", "both")
_ABOUT = (
    "Each image is compared with the images before the window. Recall: among the images with a "
    "true match there, the share with a right decision. In brackets: recall if unmarked matches "
    "near the place do not count as wrong."
)
_ABOUT_COUNTS = (
    "Numbers of decisions at the lowest threshold whose match is marked, near the place, or far."
)


def online_words(scores: Sequence[OnlineScore]) -> list[str]:
    """Sentences that name, for each drive and verification, the detector with the highest recall
    without a wrong match."""
    sentences = []
    for data in _in_order(s.data for s in scores):
        for by in ("nothing", "both"):
            of = [s for s in scores if (s.data, s.verified_by) == (data, by)]
            best = max(s.recall_at_100_precision for s in of)
            names = [s.detector for s in of if s.recall_at_100_precision == best]
            how = "unverified" if by == "nothing" else "verified by ORB or learned descriptors"
            sentences.append(
                f"{data}, {of[0].answerable} of {of[0].images} images with a true match, {how}: "
                f"highest recall at 100 % precision {best:.3f} ({', '.join(names)})."
            )
    return sentences


def online_tables(scores: Sequence[OnlineScore]) -> list[Section]:
    """Recall at 100 % precision, largest F1 and counts."""
    return [
        _table(scores, "Recall at 100 % precision",
               lambda s: f"{s.recall_at_100_precision:.3f} ({s.recall_at_100_precision_far:.3f})",
               _ABOUT),
        _table(scores, "Largest F1", lambda s: f"{s.max_f1:.3f} ({s.max_f1_far:.3f})", ""),
        _table(scores, "Decisions right / near / far",
               lambda s: f"{s.right} / {s.near} / {s.far}", _ABOUT_COUNTS),
    ]  # fmt: skip


def _table(
    scores: Sequence[OnlineScore], title: str, shown: Callable[[OnlineScore], str], note: str
) -> Section:
    names = _in_order(s.detector for s in scores)
    cells: dict[tuple[str, str, str], OnlineScore] = {
        (s.data, s.verified_by, s.detector): s for s in scores
    }
    rows = []
    for data in _in_order(s.data for s in scores):
        first = cells[data, "nothing", names[0]]
        about = (data, str(first.images), str(first.answerable), first.window)
        rows += [
            (*about, by, *(shown(cells[data, by, name]) for name in names)) for by in _VERIFIED
        ]
    head = ("drive", "images", "with a match", "window", "verified by", *names)
    table = Table(head, rows, ("drive", "window", "verified by"), note)
    return Section(title, [table])


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))
