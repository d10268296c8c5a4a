"""Bisection of the strength at which a run fails, from the outcomes of the runs made so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vslam.datasets.perturbation import LawKind

Verdict = str
"""Why a run failed, empty if it held."""


@dataclass(frozen=True)
class Boundary:
    """Where a system fails under a law, by the strengths tested.

    Attributes:
        holds_to: strongest strength below which no tested one failed by the bisection; None if
            only the images as they are hold.
        fails_at: weakest strength that failed by the bisection; None if the strongest one held.
        reason: of the failure there.
        also_failed: weaker strengths that failed although a stronger one held.
    """

    holds_to: float | None
    fails_at: float | None
    reason: Verdict
    also_failed: tuple[float, ...] = ()


def strength_at(kind: LawKind, position: float) -> float:
    """Strength at a position from 0, weakest, to 1, strongest; three significant digits."""
    weak, strong = kind.weakest, kind.strongest
    if kind.logarithmic:
        value = weak * (strong / weak) ** position
    else:
        value = weak + (strong - weak) * position
    return float(f"{value:.3g}")


def next_position(failed: Mapping[float, bool], steps: int) -> float | None:
    """Where to test next, None when all is known.

    The strongest first; where that fails, the middle of what is open, ``steps`` times; at last
    half of what holds: bisection believes that what holds at one strength holds at all weaker ones.

    Args:
        failed: by position, what was tested.
        steps: halvings.
    """
    if 1.0 not in failed:
        return 1.0
    if not failed[1.0]:
        return None if 0.5 in failed else 0.5
    holds, fails = 0.0, 1.0
    for _ in range(steps):
        middle = 0.5 * (holds + fails)
        if middle not in failed:
            return middle
        holds, fails = (holds, middle) if failed[middle] else (middle, fails)
    probe = 0.5 * holds
    return probe if holds > 0.0 and probe not in failed else None


def boundary(verdicts: Mapping[float, Verdict], kind: LawKind, steps: int) -> Boundary:
    """The boundary by finished tests.

    Args:
        verdicts: by position.
        kind: the law.
        steps: as in :func:`next_position`.
    """
    holds, fails = 0.0, 1.0
    if not verdicts[1.0]:
        holds = 1.0
    else:
        for _ in range(steps):
            middle = 0.5 * (holds + fails)
            holds, fails = (holds, middle) if verdicts[middle] else (middle, fails)
    weaker = tuple(
        strength_at(kind, position)
        for position, verdict in sorted(verdicts.items())
        if verdict and position < holds
    )
    return Boundary(
        holds_to=strength_at(kind, holds) if holds > 0.0 else None,
        fails_at=strength_at(kind, fails) if holds < 1.0 else None,
        reason=verdicts[fails] if holds < 1.0 else "",
        also_failed=weaker,
    )
