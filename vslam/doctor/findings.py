"""The result of a check."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "fault", "unknown"]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: name of the check.
        verdict: ``unknown`` if the images are not conclusive.
        measured: the measurement, with units.
        fix: what to do; empty unless there is a fault.
    """

    check: str
    verdict: Verdict
    measured: str
    fix: str = ""


def judge(check: str, wrong: bool, measured: str, fix: str) -> Finding:
    """A ``fault`` with its fix, or ``good``."""
    return Finding(check, "fault", measured, fix) if wrong else Finding(check, "good", measured)


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """What a terminal shows of findings."""
    for finding in findings:
        yield f"{finding.verdict:<8} {finding.check:<16} {finding.measured}"
        if finding.fix:
            yield f"{'':<25} fix: {finding.fix}"
