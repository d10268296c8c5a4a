"""The table of detectors that were run on the same frames (``--compare``)."""

from __future__ import annotations

from vslam.loopclosure.registry import about
from vslam.report.page import Row, Section, Table, number
from vslam.report.schema import ReportJson

_FIGURES = (
    ("lost", "lost_frames", "{}"),
    ("ATE", "ate_rmse_m", "{:.3f} m"),
    ("causal ATE", "causal_ate_rmse_m", "{:.3f} m"),
    ("RPE", "rpe_m", "{:.4f} m"),
    ("t_rel", "t_rel_percent", "{:.3f} %"),
    ("loops closed", "loops_closed", "{}"),
    ("loops found", "loops_found", "{}"),
    ("missed", "loops_missed", "{}"),
    ("wrong", "loops_wrong", "{}"),
    ("time", "seconds", "{:.1f} s"),
)
_NOTE = (
    "All detectors saw the same frames. The time is that of tracking and mapping: images are read "
    "and features are extracted once for all detectors. It is wall time on cores that the "
    "detectors share; to compare costs, time separate runs."
)


def detector_section(report: ReportJson) -> Section:
    """A row for each detector, the run's own first; empty where there was no comparison.

    Figures that no detector has are left out. The loops closed are counted only where there is no
    ground truth that tells which revisits were found.
    """
    detectors = report.detectors
    if not detectors:
        return Section("Detectors", [left_out(report)])
    known = {
        name for _, name, _ in _FIGURES if any(getattr(one, name) is not None for one in detectors)
    }
    if "loops_found" in known:
        known.remove("loops_closed")
    figures = [figure for figure in _FIGURES if figure[1] in known]
    ended = ("ended early",) if any(one.interrupted for one in detectors) else ()
    head = ("detector", *(title for title, _, _ in figures), *ended)
    rows: list[Row] = [
        (
            one.detector,
            *(number(getattr(one, name), form) for _, name, form in figures),
            *(one.interrupted or "no" for _ in ended),
        )
        for one in detectors
    ]
    names = "; ".join(f"{one.detector}: {about(one.detector)}" for one in detectors)
    return Section("Detectors", [Table(head, rows, ("detector", *ended), f"{names}. {_NOTE}")])


def left_out(report: ReportJson) -> str:
    """Why there is no comparison although one was requested; empty otherwise."""
    if report.detectors or not report.compare:
        return ""
    return (
        f"The comparison with {', '.join(report.compare)} was left out: the run was resumed, and "
        "only the map of its own detector had been saved."
    )
