"""Results of checks, which are shown in the terminal and on the HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from vslam.report.page import Alert, Section, Table

Verdict = Literal["good", "fault", "unknown"]
_HEAD = ("check", "verdict", "measured")


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: name of the check.
        verdict: ``good``, ``fault``, or ``unknown`` if the images do not allow a verdict.
        measured: the measurement, with units.
        fix: advice on how to remove the fault. It is empty if there is no fault.
    """

    check: str
    verdict: Verdict
    measured: str
    fix: str = ""


def judge(check: str, wrong: bool, measured: str, fix: str) -> Finding:
    """Create the finding of a check: a fault with the advice ``fix`` if ``wrong``."""
    return Finding(check, "fault", measured, fix) if wrong else Finding(check, "good", measured)


def lines(findings: Iterable[Finding]) -> Iterator[str]:
    """Format findings as lines for the terminal."""
    for finding in findings:
        yield f"{finding.verdict:<8} {finding.check:<16} {finding.measured}"
        if finding.fix:
            yield f"{'':<25} fix: {finding.fix}"


def sections(findings: Sequence[Finding]) -> list[Section]:
    """Format findings as sections of a page. Faults and their fixes come first."""
    faults = [
        Alert(f"{f.check.capitalize()}: {f.measured}.", f.fix and f"Fix: {f.fix}.")
        for f in findings
        if f.verdict == "fault"
    ]
    rows = [(f.check, f.verdict, f.measured) for f in findings if f.verdict != "fault"]
    title = "Other checks" if faults else "All checks"
    return [Section("", faults), Section(title, [Table(_HEAD, rows, _HEAD)])]
