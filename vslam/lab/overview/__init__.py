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
        baseline: system that the others are set against; None for the simplest.

    Raises:
        InputError: no finished run, a trajectory that cannot be read or placed, or no run of the
            baseline.
        ResultsError: a file cannot be written.
    """
    from vslam.errors import ResultsError
    from vslam.lab.overview.collect import collect
    from vslam.lab.overview.figures import draw_overview
    from vslam.lab.overview.render import render_csv, render_html, render_markdown
    from vslam.lab.overview.summary import summarize

    found = collect(runs, trajectories)
    report = summarize(found, baseline)
    figures = draw_overview(report, found)
    report = report.model_copy(update={"notes": found.notes})  # with those of the drawing
    try:
        out.mkdir(parents=True, exist_ok=True)
        json = report.model_dump_json(indent=2) + "\n"
        (out / "report.json").write_text(json, encoding="utf-8")
        (out / "table.csv").write_text(render_csv(report), encoding="utf-8")
        (out / "report.md").write_text(render_markdown(report), encoding="utf-8")
        (out / "report.html").write_text(render_html(report, figures), encoding="utf-8")
    except OSError as error:
        raise ResultsError(
            f"{out}: the report cannot be written ({error.strerror}); name another folder."
        ) from error
    return report
