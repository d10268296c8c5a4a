"""Print results in a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from vslam.report.page import Pairs, Section

if TYPE_CHECKING:
    from vslam.report.schema import ReportJson

Rows = list[tuple[str, str]]
_LOOK_AT = (("report", "report.html"), ("recording", "recording*.rrd"))


def show_sections(sections: Iterable[Section]) -> None:
    """Print sections of a report on stdout. Long lines are wrapped only if stdout is a terminal."""
    from rich.console import Console

    from vslam.report.render import show

    show(sections, Console(width=None if sys.stdout.isatty() else 1000))


def print_rows(rows: Rows) -> None:
    show_sections([Section("", [Pairs(rows)])])


def print_summary(report: ReportJson, folder: Path) -> None:
    """Print the first sections of the report of a run, and the most important files in its
    folder."""
    from vslam.report.run_page import run_page
    from vslam.run.autosave import MAP

    page = run_page(report)
    summary, detectors, *_ = page.sections
    there = [(name, str(file)) for name, files in _LOOK_AT for file in sorted(folder.glob(files))]
    rows = [("folder", str(folder)), *there, *_how_to_compare(report)]
    if report.interrupted and (folder / MAP).exists():
        rows.append(("continue", f"vslam run --resume {folder}"))
    about = Section("", [" · ".join(page.about)])
    show_sections([about, summary, detectors, Section("", [Pairs(rows)])])


def _how_to_compare(report: ReportJson) -> Rows:
    """Return a hint on how to compare detectors. The hint is empty without ground truth, and if
    ``--compare`` was used or cannot be used."""
    refused = report.realtime or report.map is not None  # --compare would be refused
    if report.detectors or report.compare or report.alignment is None or refused:
        return []
    if report.detector in ("bow", "none"):
        return [("compare", "add --compare both to compare with the capsule network")]
    return [("compare", "add --compare bow to compare with the bag of words")]
