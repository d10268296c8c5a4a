"""``report.md`` and ``report.html``: the same numbers in the same order, lost frames first."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vslam.evaluation.loops import LoopLimits
from vslam.loopclosure.registry import about
from vslam.report.detector_table import detector_table
from vslam.report.loop_tables import loop_tables
from vslam.report.page import Table, markdown_table, render_page
from vslam.report.schema import ReportJson
from vslam.report.seen_loops import SeenLoop, seen_note

if TYPE_CHECKING:
    from vslam.report.figures import ReportFigure

_ALIGNMENTS = {
    "se3": "SE3 alignment, no scale",
    "sim3": "Sim3 alignment, since the scale is arbitrary",
    "none": "not aligned",
}
_MANY_LOST = 0.1  # share of the frames


@dataclass(frozen=True)
class Headline:
    """One number of the summary; ``tone`` is ``good``, ``bad`` or empty."""

    label: str
    value: str
    note: str = ""
    tone: str = ""


def headlines(report: ReportJson) -> list[Headline]:
    """The summary. Lost frames come first: an ATE says little of a run that was lost for half."""
    lost = report.lost_frames
    share = f"{100.0 * lost / report.frames:.1f} % of" if lost else "of"
    alignment = _ALIGNMENTS[report.alignment] if report.alignment else ""
    evaluated = "; ".join(filter(None, (alignment, report.evaluation_remark)))
    rotation = _number(report.rpe_deg, "°")
    return [
        Headline(
            "Lost frames",
            str(lost),
            f"{share} {report.frames}; {report.weak_frames} weak, {report.skipped_frames} skipped",
            "bad" if lost else "good",
        ),
        *_in_map(report),
        Headline("ATE RMSE", _number(report.ate_rmse_m, "m"), evaluated),
        Headline(
            "Causal ATE", _number(report.causal_ate_rmse_m, "m"), "poses as given at the time"
        ),
        Headline("RPE", _number(report.rpe_m, "m"), f"a frame; rotation {rotation}"),
        Headline("t_rel", _number(report.t_rel_percent, "%"), "KITTI drift over 100-800 m"),
        Headline("r_rel", _number(report.r_rel_deg_per_100m, "°"), "every 100 m"),
        Headline(
            "Speed",
            f"{report.fps:.1f} fps",
            f"{report.threads} thread{'s' * (report.threads != 1)}{_together(report)}",
        ),
        *_latency(report),
        Headline(
            "CPU",
            f"{report.cpu_ms_per_frame:.1f} ms",
            f"a frame, of all threads{_together(report)}; start-up {report.startup_s:.1f} s",
        ),
        Headline("Memory", f"{report.peak_memory_mb:.0f} MB", f"at its peak{_together(report)}"),
        Headline("Map", f"{report.landmarks:,}", _map_note(report)),
        _loops(report),
    ]


def _together(report: ReportJson) -> str:
    """What is said of speed and memory where several detectors were run."""
    return f", all {len(report.detectors)} detectors together" if report.detectors else ""


def advice(report: ReportJson) -> str:
    """What to look at after a run that lost many frames; empty after others."""
    if report.lost_frames <= _MANY_LOST * report.frames:
        return ""
    return "Many frames were lost: vslam doctor checks images, calibration and time stamps."


def _in_map(report: ReportJson) -> list[Headline]:
    if (found := report.in_map) is None:
        return []
    fix = "no fix" if found.first_fix_s is None else f"first fix after {found.first_fix_s:.2f} s"
    times = f"found {found.found} of the {found.sought} times it was looked for"
    error = _number(found.error_m, "m")
    weak = f", {found.weak_percent:.1f} % by few inliers" if found.weak_percent else ""
    note = f"of the frames{weak}; {fix}, {times}"
    return [
        Headline("In the map", f"{found.in_map_percent:.1f} %", note),
        Headline("Error in the map", error, "RMSE of these frames, with the map's own alignment"),
    ]


def _latency(report: ReportJson) -> list[Headline]:
    """In real time the machine decides what becomes of a frame: that is said with a tone."""
    if report.latency_ms is None:
        return []
    ms, dropped = report.latency_ms, report.dropped_frames
    note = f"median from image to pose; p95 {ms.p95:.0f}, p99 {ms.p99:.0f}; {dropped} dropped"
    return [Headline("Latency", f"{ms.median:.0f} ms", note, "bad" if dropped else "good")]


def _map_note(report: ReportJson) -> str:
    submaps = f", {report.submaps} sub-maps" if report.submaps > 1 else ""
    return f"landmarks, {report.keyframes:,} keyframes{submaps}"


def _loops(report: ReportJson) -> Headline:
    notes = []
    if report.revisit_stretches is not None:
        notes += [
            _revisits(report),
            f"{report.loops_missed} missed",
            f"{report.loops_wrong} wrong",
        ]
    if report.detector == "none":
        return Headline("Loops", "off", "no detector; " + ", ".join(notes[:1]) if notes else "")
    notes.append(f"{report.loops_rejected} candidates rejected")
    tone = "bad" if report.loops_wrong else ""
    return Headline("Loops", f"{report.loops_closed} closed", ", ".join(notes), tone)


def _revisits(report: ReportJson) -> str:
    """How many stretches were found again; a right loop on one that is too short to count is not
    left without a word."""
    if report.revisit_stretches:
        return f"{report.loops_found} of {report.revisit_stretches} revisits found"
    none = f"no revisit of {LoopLimits().min_length_m:.0f} m or more to be found"
    right = sum(loop.accepted and loop.right is True for loop in report.loops)
    return f"{none} ({right} right on shorter ones)" if right else none


def render_markdown(
    report: ReportJson, seen: Collection[SeenLoop] = (), recordings: Collection[str] = ()
) -> str:
    """Markdown whose tables are aligned, to be read in a terminal; the pictures of the loops
    ``seen`` are files in the folder ``figures``, ``recordings`` are files in its own."""
    lines = [f"# vslam: {report.dataset} {report.sequence}", ""]
    if report.interrupted:
        lines += [f"**Interrupted: {report.interrupted}.** Numbers are of the frames done.", ""]
    lines += markdown_table(("", "", ""), [(h.label, h.value, h.note) for h in headlines(report)])
    for warning in report.warnings:
        lines += ["", f"**Warning: {warning}**"]
    lines += ["", advice(report)] if advice(report) else []
    lines += _table(detector_table(report))
    if seen:
        lines += ["", "## Loops seen", "", seen_note(report, seen)]
        for loop in seen:
            lines += ["", f"![{loop.name}](figures/{loop.name})", "", loop.caption]
    if report.skipped_messages:
        lines += ["", "## Skipped frames", "", *(f"- {text}" for text in report.skipped_messages)]
    if report.evo_command:
        lines += ["", "## Reproduce the ATE", "", f"    {report.evo_command}"]
    if report.stage_ms:
        lines += ["", "## Time per stage (ms)", ""]
        lines += markdown_table(("stage", "mean", "median", "p95", "p99"), stage_rows(report))
    for table in loop_tables(report):
        lines += _table(table)
    lines += ["", "## Run", "", *markdown_table(("", ""), option_rows(report))]
    lines += ["", "## Machine", "", *markdown_table(("", ""), machine_rows(report))]
    if recordings:
        lines += ["", "## Recording", "", *(f"    rerun {name}" for name in recordings)]
    return "\n".join([*lines, ""])


def _table(table: Table) -> list[str]:
    """Lines of a table with its title and its note; of the note alone where there are no rows."""
    lines = ["", f"## {table.title}", ""] if table.rows or table.note else []
    lines += [*markdown_table(table.head, table.rows), ""] if table.rows else []
    return [*lines, table.note] if table.note else lines[:-1]


def render_html(
    report: ReportJson,
    config: str,
    figures: Collection[ReportFigure],
    explorer: dict[str, Any] | None = None,
    seen: Collection[SeenLoop] = (),
    recordings: Collection[str] = (),
) -> str:
    """One self-contained page: style, figures and numbers are inside, nothing is loaded.

    Args:
        report: the numbers.
        config: text of ``config.json``, shown as it is.
        figures: drawn by :func:`vslam.report.figures.draw_figures`.
        explorer: made by :func:`vslam.report.explorer.explorer_data`.
        seen: drawn by :func:`vslam.report.seen_loops.seen_loops`.
        recordings: names of those beside the page.
    """
    return render_page(
        "report.html.jinja",
        report=report,
        headlines=headlines(report),
        advice=advice(report),
        stages=stage_rows(report),
        seen=seen,
        seen_note=seen_note(report, seen),
        recordings=recordings,
        detector_table=detector_table(report),
        about_detector=about(report.detector),
        loop_tables=loop_tables(report),
        options=option_rows(report),
        machine=machine_rows(report),
        config=config,
        figures=figures,
        explorer=explorer,
        explorer_program=files("vslam.report").joinpath("explorer.js").read_text("utf-8"),
    )


def stage_rows(report: ReportJson) -> list[tuple[str, ...]]:
    """Stage, mean, median, 95th and 99th percentile in milliseconds."""
    return [
        (name, f"{ms.mean:.2f}", f"{ms.median:.2f}", f"{ms.p95:.2f}", f"{ms.p99:.2f}")
        for name, ms in report.stage_ms.items()
    ]


def option_rows(report: ReportJson) -> list[tuple[str, str]]:
    """The options of the run, as they would be typed."""
    names = ("dataset", "sequence", "perturb", "detector", "sensor", "seed", "threads", "start")
    options = [(name, str(getattr(report, name))) for name in (*names, "every")]
    limit = "all" if report.max_frames is None else str(report.max_frames)
    weights = [("weights", str(report.weights))] if report.weights else []
    if report.local_weights:
        weights += [("local-weights", str(report.local_weights))]
    realtime = [("realtime", "yes")] if report.realtime else []
    compare = [("compare", ", ".join(report.compare))] if report.compare else []
    calib = [("calib", str(path)) for path in report.calib]
    return [*options, ("max-frames", limit), *weights, *realtime, *calib, *compare]


def machine_rows(report: ReportJson) -> list[tuple[str, str]]:
    """Where and with what the run was made."""
    machine = report.machine
    packages = {name: text for name, text in report.versions.items() if name != "python"}
    return [
        ("CPU", f"{machine.cpu}, {machine.cores} cores"),
        ("platform", machine.platform),
        ("Python", machine.python),
        ("packages", ", ".join(f"{name} {text}" for name, text in packages.items())),
        ("created", f"{report.created:%Y-%m-%d %H:%M:%S %Z}"),
    ]


def _number(value: float | None, unit: str) -> str:
    if value is None:
        return "n/a"
    decimals = 1 if value >= 100 else 2 if value >= 10 else 3 if value >= 0.1 else 4
    return f"{value:.{decimals}f}{unit if unit == '°' else ' ' + unit}"
