"""Search for the strength at which runs fail, by bisection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vslam.datasets.perturbation import LawKind

Verdict = str
"""Why a run failed; empty if it did not fail."""


@dataclass(frozen=True)
class Boundary:
    """The strength at which a system fails under a law.

    Attributes:
        holds_to: greatest strength at which a run did not fail, according to the bisection. None if
            runs failed at every tested strength.
        fails_at: smallest strength at which a run failed, according to the bisection. None if no
            run failed.
        reason: reason for the failure at ``fails_at``.
        also_failed: strengths below ``holds_to`` at which a run also failed.
    """

    holds_to: float | None
    fails_at: float | None
    reason: Verdict
    also_failed: tuple[float, ...] = ()


def strength_at(kind: LawKind, position: float) -> float:
    """The strength at a position from 0 (weakest) to 1 (greatest), to three significant digits."""
    weak, strong = kind.weakest, kind.strongest
    if kind.logarithmic:
        value = weak * (strong / weak) ** position
    else:
        value = weak + (strong - weak) * position
    return float(f"{value:.3g}")


def bracket(failed: Mapping[float, bool], steps: int) -> tuple[float, float, float | None]:
    """The state of the bisection.

    Args:
        failed: for each tested position, whether the run failed.
        steps: number of bisections.

    Returns:
        The greatest position at which the system did not fail, the smallest position at which it
        failed, and the next position to test. The next position is None if the bisection has ended.
    """
    if not failed.get(1.0, True):
        return 1.0, 1.0, None
    holds, fails = 0.0, 1.0
    for _ in range(steps):
        middle = 0.5 * (holds + fails)
        if middle not in failed:
            return holds, fails, middle
        holds, fails = (holds, middle) if failed[middle] else (middle, fails)
    return holds, fails, None


def next_position(failed: Mapping[float, bool], steps: int) -> float | None:
    """The next position to test; None at the end of the search.

    The greatest strength is tested first. If the run fails, the interval is bisected ``steps``
    times. Bisection assumes that a system that does not fail at a strength does not fail at weaker
    strengths. The last test checks this assumption, at half of the greatest position at which the
    system did not fail. The arguments are those of `bracket`.
    """
    if 1.0 not in failed:
        return 1.0
    holds, _, middle = bracket(failed, steps)
    if middle is not None:
        return middle
    probe = 0.5 * holds
    return probe if holds > 0.0 and probe not in failed else None


def boundary(verdicts: Mapping[float, Verdict], kind: LawKind, steps: int) -> Boundary:
    """The boundary according to the verdicts of the finished tests, which are given by position."""
    holds, fails, _ = bracket({p: bool(v) for p, v in verdicts.items()}, steps)
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
