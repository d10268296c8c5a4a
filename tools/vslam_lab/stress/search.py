"""Finds the strength of a perturbation at which runs fail, using bisection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vslam.datasets.perturbation import LawKind

Verdict = str
"""Why a run failed; empty if it did not fail."""


@dataclass(frozen=True)
class Boundary:
    """The strength of a perturbation at which a system fails.

    Attributes:
        holds_to: greatest strength at which the run did not fail, according to the bisection. None
            if the runs at all tested strengths failed.
        fails_at: smallest strength at which the run failed, according to the bisection. None if no
            run failed.
        reason: reason for the failure at ``fails_at``.
        also_failed: strengths below ``holds_to`` at which a run also failed.
    """

    holds_to: float | None
    fails_at: float | None
    reason: Verdict
    also_failed: tuple[float, ...] = ()


def strength_at(kind: LawKind, position: float) -> float:
    """Return the strength at a position from 0 (weakest) to 1 (greatest strength).

    The strength is rounded to three significant digits.
    """
    weak, strong = kind.weakest, kind.strongest
    if kind.logarithmic:
        value = weak * (strong / weak) ** position
    else:
        value = weak + (strong - weak) * position
    return float(f"{value:.3g}")


def bracket(failed: Mapping[float, bool], steps: int) -> tuple[float, float, float | None]:
    """Return the interval in which a system begins to fail, and the next position to test.

    Args:
        failed: for each tested position, whether the run failed. A position is a strength on a
            scale from 0 (weakest) to 1 (greatest).
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
    """Return the position that the bisection tests next; None at the end of the search.

    A position is a strength on a scale from 0 (weakest) to 1 (greatest). The greatest strength is
    tested first. If the run fails, the interval is bisected ``steps`` times.

    Bisection assumes that a system that passes a test also passes tests with a smaller strength.
    The last test of a search checks this assumption, at half of the greatest position at which the
    system did not fail.
    """
    if 1.0 not in failed:
        return 1.0
    holds, _, middle = bracket(failed, steps)
    if middle is not None:
        return middle
    probe = 0.5 * holds
    return probe if holds > 0.0 and probe not in failed else None


def boundary(verdicts: Mapping[float, Verdict], kind: LawKind, steps: int) -> Boundary:
    """Return the strength at which a system fails.

    Args:
        verdicts: for each tested position, why the run failed; an empty text if it did not fail. A
            position is a strength on a scale from 0 (weakest) to 1 (greatest).
        kind: the perturbation.
        steps: number of bisections.
    """
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
