"""What a check says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "fault", "unknown"]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: what was looked at.
        verdict: ``unknown`` where the images do not tell.
        measured: what was found, with units.
        fix: what to do; empty where all is well.
    """

    check: str
    verdict: Verdict
    measured: str
    fix: str = ""


def judge(check: str, wrong: bool, measured: str, fix: str) -> Finding:
    """``good`` or ``fault``; the fix is for faults only."""
    return Finding(check, "fault", measured, fix) if wrong else Finding(check, "good", measured)
