"""One report of many runs: medians, loop detectors compared, trajectories, strength curves."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.lab.overview.schema import OverviewJson

__all__ = ["write_overview"]


def write_overview(
    runs: Collection[Path],
    trajectories: Collection[str],
    out: Path,
    baseline: str | None = None,
) -> OverviewJson:
    """Gather finished runs and write ``report.{html,md,json}`` and ``table.csv`` into ``out``.

    Args:
        runs: folders of runs, or folders that hold such at any depth.
        trajectories: ``NAME[@SEQUENCE[@PERTURB]]=FILE``, of other systems.
        out: made if it is not there.
        baseline: the system that the others are compared with; None for the simplest.

    Raises:
        InputError: no finished run, a trajectory that cannot be read or placed, or no run of the
            baseline.
        ResultsError: a file cannot be written.
    """
    from vslam.lab.overview.collect import collect
    from vslam.lab.overview.figures import draw_overview
    from vslam.lab.overview.render import overview_page, render_csv
    from vslam.lab.overview.summary import summarize
    from vslam.report.render import html, markdown, write_files

    found = collect(runs, trajectories)
    report = summarize(found, baseline)
    figures = draw_overview(report, found)
    notes = list(dict.fromkeys((*report.notes, *found.notes)))  # drawing adds some
    report = report.model_copy(update={"notes": notes})
    page = overview_page(report, figures)
    files = {"report.json": report.to_json(), "table.csv": render_csv(report)}
    write_files(out, {**files, "report.md": markdown(page), "report.html": html(page)})
    return report
