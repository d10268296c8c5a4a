"""Creates the page about one run, which shows the numbers of ``report.json``."""

from __future__ import annotations

from collections.abc import Collection
from html import escape

from vslam.config import thresholds_in_words
from vslam.evaluation.loops import MIN_LENGTH_M
from vslam.loopclosure.registry import about
from vslam.report.loop_tables import loop_sections, seen_note
from vslam.report.page import (
    Alert,
    Bullets,
    Code,
    Figure,
    Markup,
    Page,
    Pairs,
    Part,
    Row,
    Section,
    Table,
    Tile,
    Tiles,
    number,
)
from vslam.report.schema import ReportJson
from vslam.support.errors import counted

_ALIGNMENTS = {
    "se3": "SE3 alignment, no scale",
    "sim3": "Sim3 alignment",
    "none": "not aligned",
}
_MANY_LOST = 0.1  # as a share of the frames
_MOST_STRETCHES = 3  # frames with a scale of their own
_COMPARED = (
    ("lost", "lost_frames", "{}"),
    ("ATE", "ate_rmse_m", "{:.3f} m"),
    ("causal ATE", "causal_ate_rmse_m", "{:.3f} m"),
    ("RPE", "rpe_m", "{:.4f} m"),
    ("RPE rotation", "rpe_deg", "{:.4f}°"),
    ("t_rel", "t_rel_percent", "{:.3f} %"),
    ("loops closed", "loops_closed", "{}"),
    ("loops found", "loops_found", "{}"),
    ("missed", "loops_missed", "{}"),
    ("wrong", "loops_wrong", "{}"),
    ("time", "seconds", "{:.1f} s"),
)
_ABOUT_COMPARED = (
    "All detectors saw the same frames. The time is the wall time of tracking and mapping. It is "
    "longer than in separate runs, because the detectors share the cores. It excludes reading "
    "images and extracting features, which is done once for all detectors. To compare costs, time "
    "separate runs."
)


def headlines(report: ReportJson) -> list[Tile]:
    """Create the summary of a run. Lost frames come first, because the ATE means little if many
    frames were lost."""
    lost = report.lost_frames
    share = f"{100.0 * lost / report.frames:.1f} % of" if lost else "of"
    alignment = _ALIGNMENTS[report.alignment] if report.alignment else ""
    spread = ""
    if report.ate_mean_m is not None:
        largest = _number(report.ate_max_m, "m")
        spread = f"mean {_number(report.ate_mean_m, 'm')}, maximum {largest}"
    evaluated = "; ".join(filter(None, (alignment, spread, report.evaluation_remark)))
    rotation = _number(report.rpe_deg, "°")
    return [
        Tile(
            "Lost frames",
            str(lost),
            f"{share} {report.frames}{_before_map(report)}; {_carried(report)}{_later(report)}"
            f"{report.weak_frames} weak, {report.skipped_frames} skipped, "
            f"{report.left_out_frames} left out",
            "bad" if lost else "good",
        ),
        *_in_map(report),
        *_on_earth(report),
        *_scale(report),
        Tile("ATE RMSE", _number(report.ate_rmse_m, "m"), evaluated),
        Tile("Causal ATE", _number(report.causal_ate_rmse_m, "m"), "poses at the time of tracking"),
        Tile("RPE", _number(report.rpe_m, "m"), f"per frame; rotation {rotation}"),
        Tile("t_rel", _number(report.t_rel_percent, "%"), "KITTI drift over 100-800 m"),
        Tile("r_rel", _number(report.r_rel_deg_per_100m, "°"), "per 100 m"),
        Tile(
            "Speed",
            f"{report.fps:.1f} fps",
            counted(report.threads, "thread") + _together(report),
        ),
        *_latency(report),
        Tile(
            "CPU",
            f"{report.cpu_ms_per_frame:.1f} ms",
            f"per frame, all threads{_together(report)}; start-up {report.startup_s:.1f} s",
        ),
        Tile("Memory", f"{report.peak_memory_mb:.0f} MB", f"peak{_together(report)}"),
        Tile("Map", f"{report.landmarks:,}", _map_note(report)),
        _loops(report),
    ]


def _scale(report: ReportJson) -> list[Tile]:
    if report.sensor != "mono" or report.metric_since_s is not None:
        return []
    own = [gap for gap in report.gaps if gap.scale != 1.0]
    note = "unknown to a single camera"
    if own:
        stretches = ", ".join(f"{gap.first} to {gap.last}" for gap in own[:_MOST_STRETCHES])
        more = ", ..." * (len(own) > _MOST_STRETCHES)
        note += f"; frames {stretches}{more} have scales of their own"
    return [Tile("Scale", "arbitrary", note)]


def _carried(report: ReportJson) -> str:
    return f"{count} carried by the IMU, " if (count := report.inertial_frames) else ""


def _later(report: ReportJson) -> str:
    return f"{count} found after the map began, " if (count := report.later_frames) else ""


def _before_map(report: ReportJson) -> str:
    if not (count := report.lost_before_map):
        return ""
    why = ": a monocular map needs the camera to move sideways first" * (report.sensor == "mono")
    return f", {count} of them before the map began{why}"


def _together(report: ReportJson) -> str:
    """Return a remark that speed and memory were measured for several detectors together, or "" for
    a single detector."""
    return f", {len(report.detectors)} detectors together" if report.detectors else ""


def advice(report: ReportJson) -> str:
    """Return advice to the user if many frames were lost, or else ""."""
    if report.lost_frames <= _MANY_LOST * report.frames:
        return ""
    return "Many frames were lost; vslam doctor checks images, calibration and timestamps."


def _in_map(report: ReportJson) -> list[Tile]:
    if (found := report.in_map) is None:
        return []
    weak = f", {found.weak_percent:.1f} % with few inliers" if found.weak_percent else ""
    note = f"of the frames{weak}; found in {found.found} of {counted(found.sought, 'attempt')}"
    if found.first_fix_s is not None:
        note += f", first after {found.first_fix_s:.2f} s"
    error = _number(found.error_m, "m")
    return [
        Tile("In the map", f"{found.in_map_percent:.1f} %", note),
        Tile("Error in the map", error, "RMSE of these frames, after the alignment of the map"),
    ]


def _on_earth(report: ReportJson) -> list[Tile]:
    if (found := report.gps_track) is None:
        return []
    residual = f"{_number(found.residual_m, 'm')} from the trajectory (RMS)"
    used = f"{found.fixes - found.refused} fixes"
    return [Tile("GPS", used, f"{found.refused} refused; {residual}")]


def _latency(report: ReportJson) -> list[Tile]:
    if report.latency_ms is None:
        return []
    ms, dropped = report.latency_ms, report.dropped_frames
    note = f"median from image to pose; p95 {ms.p95:.0f}, p99 {ms.p99:.0f}; {dropped} dropped"
    return [Tile("Latency", f"{ms.median:.0f} ms", note, "bad" if dropped else "good")]


def _map_note(report: ReportJson) -> str:
    submaps = f", {report.submaps} sub-maps" if report.submaps > 1 else ""
    since = report.metric_since_s
    metric = "" if since is None else f", metric by the IMU since {since:.1f} s"
    return f"landmarks, {counted(report.keyframes, 'keyframe')}{submaps}{metric}"


def _loops(report: ReportJson) -> Tile:
    notes = []
    if report.revisit_stretches is not None:
        missed = [f"{report.loops_missed} missed"] if report.revisit_stretches else []
        notes += [_revisits(report), *missed, f"{report.loops_wrong} wrong"]
    if report.detector == "none":
        return Tile("Loops", "off", "no detector; " + ", ".join(notes[:1]) if notes else "")
    notes.append(f"{counted(report.loops_rejected, 'candidate')} rejected")
    tone = "bad" if report.loops_wrong else ""
    return Tile("Loops", f"{report.loops_closed} closed", ", ".join(notes), tone)


def _revisits(report: ReportJson) -> str:
    """Return the number of revisits that were found by loops, as text.

    Only stretches of at least ``MIN_LENGTH_M`` count as revisits. If the drive has no such stretch,
    the text gives the number of correct loops on shorter stretches.
    """
    if report.revisit_stretches:
        return f"{report.loops_found} of {counted(report.revisit_stretches, 'revisit')} found"
    none = f"the drive revisits no stretch of {MIN_LENGTH_M:.0f} m or more"
    right = sum(loop.accepted and loop.right is True for loop in report.loops)
    return f"{none} ({right} right on shorter ones)" if right else none


def detector_section(report: ReportJson) -> Section:
    """Create a section that compares the detectors of a run with ``--compare``. The section is
    empty for a run without ``--compare``.

    Columns without any value are left out. The number of closed loops is shown only if there is no
    ground truth that shows which revisits were found.
    """
    detectors = report.detectors
    if not detectors:
        return Section("Detectors", [_why_comparison_is_missing(report)])
    known = {
        name for _, name, _ in _COMPARED if any(getattr(one, name) is not None for one in detectors)
    }
    if "loops_found" in known:
        known.remove("loops_closed")
    columns = [column for column in _COMPARED if column[1] in known]
    ended = ("ended early",) if any(one.interrupted for one in detectors) else ()
    head = ("detector", *(title for title, _, _ in columns), *ended)
    rows: list[Row] = [
        (
            one.detector,
            *(number(getattr(one, name), form) for _, name, form in columns),
            *(one.interrupted or "no" for _ in ended),
        )
        for one in detectors
    ]
    names = "; ".join(f"{one.detector}: {about(one.detector)}" for one in detectors)
    return Section(
        "Detectors", [Table(head, rows, ("detector", *ended), f"{names}. {_ABOUT_COMPARED}")]
    )


def _why_comparison_is_missing(report: ReportJson) -> str:
    if report.detectors or not report.compare:
        return ""
    return (
        f"The comparison with {', '.join(report.compare)} was left out: the run was resumed, but "
        "only the map of its own detector had been saved."
    )


def run_page(
    report: ReportJson,
    figures: Collection[Figure] = (),
    seen: Collection[Figure] = (),
    recordings: Collection[str] = (),
    explorer: Collection[Section] = (),
    config: str = "",
) -> Page:
    """Create the page about a run.

    Args:
        report: the content of ``report.json``.
        figures: the figures of the report, from :func:`vslam.report.figures.draw_figures`.
        seen: pictures of closed loops, from :func:`vslam.report.loop_tables.seen_loops`.
        recordings: names of the recordings in the folder of the page.
        explorer: the section with the interactive explorer, from
            :func:`vslam.report.explorer.explorer`.
        config: text of ``config.json``, for the HTML page.
    """
    alerts = [Alert(f"Warning: {warning}") for warning in report.warnings]
    if report.interrupted:
        done = counted(report.frames, "frame")
        interrupted = f"Interrupted: {report.interrupted}."
        alerts.insert(0, Alert(interrupted, f"The results cover the {done} before that."))
    alerts += [Alert("", advice(report))] if advice(report) else []
    stages = Table(("stage", "mean", "median", "p95", "p99"), stage_rows(report), ("stage",))
    pictures: list[Part] = [seen_note(report, seen), *seen] if seen else []
    replay = Code("\n".join(f"rerun {name}" for name in recordings))
    evo = Code(report.evo_command or "")
    changed = thresholds_in_words(report.thresholds)
    return Page(
        f"{report.dataset} {report.sequence}",
        (
            f"vslam {report.versions.get('vslam', '')}",
            report.sensor,
            f"detector {report.detector} ({about(report.detector)})",
            f"perturb {report.perturb}",
            f"seed {report.seed}",
            *([f"thresholds {changed}"] if changed else []),
            f"{report.created:%Y-%m-%d %H:%M %Z}",
        ),
        (
            Section("", (*alerts, Tiles(headlines(report)))),
            detector_section(report),
            Section("Pictures of closed loops", pictures),
            Section(
                f"Skipped frames: {report.skipped_frames}",
                [Bullets(report.skipped_messages)],
                folded=True,
            ),
            _imu(report),
            _gps(report),
            *explorer,
            Section("", [*figures], wide=False),
            Section("Time per stage (ms)", [stages], wide=False),
            *loop_sections(report),
            Section(
                "Reproduce the ATE",
                ["In the folder in which vslam was run:", evo] if report.evo_command else [],
                wide=False,
            ),
            Section(
                "Replay",
                ["In the folder of this report:", replay] if recordings else [],
                wide=False,
            ),
            Section("Run", [Pairs(option_rows(report))], wide=False),
            Section("Machine", [Pairs(machine_rows(report))], wide=False),
            Section("Configuration", [Markup(f"<pre>{escape(config)}</pre>")], folded=True),
        ),
    )


def _imu(report: ReportJson) -> Section:
    if (found := report.imu) is None:
        return Section("IMU", ())
    rows = []
    if found.gravity_since_s is not None and report.gravity is not None:
        direction = ", ".join(f"{value:.2f}" for value in report.gravity)
        sigma = _number(found.gravity_sigma_deg, "°")
        rows += [
            ("gravity known", f"since {found.gravity_since_s:.2f} s"),
            ("gravity in the world", f"({direction}) m/s²; standard deviation {sigma}"),
        ]
    else:
        rows.append(("gravity known", "never"))
    if report.metric_since_s is not None:
        rows.append(("scale known", f"since {report.metric_since_s:.2f} s"))
    for name, unit, bias, sigmas in (
        ("gyroscope bias", "rad/s", found.gyro_bias, found.gyro_bias_sigma),
        ("accelerometer bias", "m/s²", found.accel_bias, found.accel_bias_sigma),
    ):
        if bias is not None and sigmas is not None:
            values = ", ".join(f"{b:.4f} ± {s:.4f}" for b, s in zip(bias, sigmas, strict=True))
            rows.append((name, f"{values} {unit}"))
    rows.append(("time offset, as calibrated", f"{1e3 * found.time_offset_s:.1f} ms"))
    carried = counted(report.inertial_frames, "frame")
    if report.inertial_frames:
        seconds = f"{found.carried_s:.2f} s, the longest stretch {found.longest_s:.2f} s"
        carried += f", {seconds}"
    rows.append(("carried by the IMU alone", carried))
    if found.carried_nees is not None:
        errors = f"{_number(found.carried_error_m, 'm')}, {_number(found.carried_error_deg, '°')}"
        rows += [
            ("largest error of a carried pose", errors),
            ("NEES of carried poses", f"{found.carried_nees:.2f} (1 if the covariances are right)"),
        ]
    parts: list[Part] = [found.refused, Pairs(rows)]
    return Section("IMU", parts[:1] if found.refused and found.gravity_since_s is None else parts)


def _gps(report: ReportJson) -> Section:
    if (found := report.gps_track) is None:
        return Section("GPS", ())
    latitude, longitude, altitude = found.datum
    right, down, ahead = found.antenna
    rows = [
        ("origin", f"{latitude:.7f}°, {longitude:.7f}°, {altitude:.1f} m"),
        (
            "antenna",
            f"{right:.2f} m right of, {down:.2f} m below, {ahead:.2f} m ahead of the camera",
        ),
        ("fixes of tracked frames", f"{found.fixes}, {found.refused} of them refused"),
        ("distance of the fixes used (RMS)", _number(found.residual_m, "m")),
        ("scale of the map", f"{found.metres_per_unit:.4g} m per unit"),
    ]
    if found.ate_rmse_m is not None:
        without = f"{_number(report.ate_rmse_m, 'm')} without ({report.alignment})"
        rows.append(("ATE RMSE", f"{_number(found.ate_rmse_m, 'm')} with GPS (se3), {without}"))
    note = (
        "The drive is too straight for GPS to determine the rotation about its direction; the "
        "camera is assumed to be upright."
    )
    parts: list[Part] = [Pairs(rows)]
    return Section("GPS", parts if found.level else [*parts, note])


def stage_rows(report: ReportJson) -> list[Row]:
    """Return the name of each stage, and its mean, median, 95th and 99th percentile in
    milliseconds."""
    return [
        (name, f"{ms.mean:.2f}", f"{ms.median:.2f}", f"{ms.p95:.2f}", f"{ms.p99:.2f}")
        for name, ms in report.stage_ms.items()
    ]


def option_rows(report: ReportJson) -> list[tuple[str, str]]:
    """Return the options of the run, under their names on the command line."""
    names = ("dataset", "sequence", "perturb", "detector", "sensor", "seed", "threads", "start")
    options = [(name, str(getattr(report, name))) for name in (*names, "every")]
    limit = "all" if report.max_frames is None else str(report.max_frames)
    weights = [("weights", str(report.weights))] if report.weights else []
    if report.local_weights:
        weights += [("local-weights", str(report.local_weights))]
    changed = [f"{name}={value}" for name, value in report.thresholds.items()]
    thresholds = [("thresholds", ", ".join(changed))] if changed else []
    realtime = [("realtime", "yes")] if report.realtime else []
    compare = [("compare", ", ".join(report.compare))] if report.compare else []
    files = [("calib", str(path)) for path in report.calib]
    if report.gps:
        files.append(("gps", str(report.gps)))
    if report.mask:
        files.append(("mask", str(report.mask)))
    return [*options, ("max-frames", limit), *thresholds, *weights, *realtime, *files, *compare]


def machine_rows(report: ReportJson) -> list[tuple[str, str]]:
    machine = report.machine
    packages = {name: text for name, text in report.versions.items() if name != "python"}
    return [
        ("CPU", str(machine)),
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
