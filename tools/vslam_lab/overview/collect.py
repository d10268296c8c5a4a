"""Finds finished runs of vslam and of other SLAM systems on the disk, and reads their results."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vslam.config import changed_thresholds, with_preset
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.report.schema import DetectorFigures, ReportJson
from vslam.run.outcome import alignment_of
from vslam.support.errors import InputError, counted
from vslam.support.untrusted import require_utf8
from vslam.types.trajectory import Trajectory, read_trajectory
from vslam_lab.overview.schema import MEASURES, Drive, OverviewJson, RunEntry

MONOCULAR = ", mono"  # suffix of the name of a monocular system
# Options of a run that change its results but are not part of its `Drive`.
_OPTIONS = ("weights", "local_weights", "realtime", "map", "localize", "mask")


@dataclass(frozen=True)
class Found:
    """The finished runs, and notes on the runs that were left out.

    Attributes:
        estimate: for each run, the file with the estimated trajectory. The key is
            ``RunEntry.source``.
        truth: for each pair of data set and sequence, the folder of a run that contains the ground
            truth.
    """

    runs: list[RunEntry]
    notes: list[str]
    estimate: dict[str, Path] = field(default_factory=dict)
    truth: dict[tuple[str, str], Path] = field(default_factory=dict)


def collect(folders: Collection[Path], trajectories: Collection[str]) -> Found:
    """Read every run below ``folders``, and evaluate the trajectories of other SLAM systems.

    Interrupted runs are left out, as are reports that this version cannot read. The result has a
    note for each run that was left out.

    Args:
        trajectories: trajectories of other systems on the sequences of the runs, each as a text
            ``NAME[@SEQUENCE[@PERTURB]]=FILE``.

    Raises:
        InputError: a folder is missing, no folder contains a finished run, a trajectory cannot be
            read, or more than one sequence could belong to a trajectory.
    """
    found = Found([], [])
    for folder in run_folders(folders):
        require_utf8(folder)
        report = _read(folder, found.notes)
        if report is None:
            continue
        try:
            entry = _entry(report, folder)
        except InputError as error:
            found.notes.append(f"left out: {folder}: {error}")
            continue
        found.runs.append(entry)
        found.estimate[entry.source] = folder / "trajectory.tum"
        for other in report.detectors[1:]:
            if other.interrupted:
                found.notes.append(f"left out: {other.detector} in {folder} ({other.interrupted})")
                continue
            compared = _compared_entry(entry, report, other, folder)
            found.runs.append(compared)
            found.estimate[compared.source] = Path(compared.source)
        if (folder / "ground_truth_kitti.txt").is_file():
            found.truth.setdefault((entry.drive.dataset, entry.drive.place), folder)
    if not found.runs:
        raise InputError(
            f"{', '.join(map(str, folders))}: no finished run here; give folders that 'vslam run' "
            "or 'vslam bench' wrote."
        )
    _name_by_settings(found)
    for text in trajectories:
        _add_external(text, found)
    return found


def read_aligned(found: Found, run: RunEntry) -> tuple[Trajectory, Trajectory | None]:
    """Read the trajectory of a run, aligned to the ground truth, and the ground truth itself.

    If there is no ground truth, the trajectory is not aligned, and the second result is None.

    Raises:
        InputError: a file is missing or malformed.
    """
    truth = _truth(found, run.drive)
    times = truth.timestamps if truth is not None else None
    estimate = read_trajectory(found.estimate[run.source], times)
    if truth is None:
        return estimate, None
    try:
        evaluation = evaluate_trajectory(estimate, truth, run.alignment)
    except InputError:  # too short to align
        return estimate, None
    # These timestamps are wrong if some frames are missing in the estimate. This does not matter,
    # because only positions are drawn.
    return Trajectory(estimate.timestamps[: evaluation.frames], evaluation.T_wc_aligned), truth


def run_folders(folders: Collection[Path]) -> list[Path]:
    """Find the folders that contain a ``report.json``, at any depth. Hidden folders are skipped.

    Raises:
        InputError: a folder does not exist.
    """
    found: dict[Path, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; give folders of runs.")
        for path in sorted(folder.rglob("report.json")):
            if not any(part.startswith(".") for part in path.relative_to(folder).parts):
                found.setdefault(path.parent.resolve(), path.parent)
    return list(found.values())


def _read(folder: Path, notes: list[str]) -> ReportJson | None:
    path = folder / "report.json"
    try:
        report = ReportJson.read(path)
    except InputError as error:
        if not _is_overview(path):
            notes.append(f"left out: {error}")
        return None
    if report.interrupted:
        notes.append(f"left out: {folder} was interrupted ({report.interrupted})")
        return None
    return report


def _is_overview(path: Path) -> bool:
    """Return whether a ``report.json`` is a report of many runs and not of a single run."""
    try:
        OverviewJson.read(path)
    except InputError:
        return False
    return True


def _compared_entry(
    entry: RunEntry, report: ReportJson, other: DetectorFigures, folder: Path
) -> RunEntry:
    """Make the entry of a detector that was added to a run with ``--compare``."""
    return entry.model_copy(
        update={
            "system": other.detector + entry.system.removeprefix(report.detector),
            "settings": {k: v for k, v in entry.settings.items() if k != "weights"},
            "measures": {name: getattr(other, name, None) for name, *_ in MEASURES},
            "source": str(folder / f"trajectory_{other.detector}.tum"),
        }
    )


def _entry(report: ReportJson, folder: Path) -> RunEntry:
    parts = [f"frames from {report.start}"] if report.start else []
    parts += [f"every {report.every}"] if report.every > 1 else []
    if report.max_frames:  # the sequence may be shorter
        parts.append(f"{min(report.max_frames, report.frames)} frames")
    sequence, town = report.sequence, None
    laws: list[str] = []
    if report.dataset == "synthetic":
        from vslam_lab.towns import parse_drive  # imports the renderer

        # Changes of a rendered town count as perturbations. For example, 05+change:0.5 is a drive
        # on the route 05.
        town = parse_drive(sequence)[1].seed
        sequence, *parts_of_town = sequence.split("+")
        laws = [part for part in parts_of_town if not part.startswith("seed:")]
    if report.perturb != "none":
        laws.append(report.perturb)
    return RunEntry(
        drive=Drive(
            dataset=report.dataset,
            sequence=sequence,
            excerpt=", ".join(parts),
            perturb=",".join(laws) or "none",
        ),
        system=report.detector + (MONOCULAR if report.sensor == "mono" else ""),
        settings=_settings(report, folder),
        seed=report.seed,
        town=town,
        alignment=alignment_of(report.sensor),
        frames=report.frames,
        # With --compare, fps is the speed of all detectors together.
        measures={
            name: None if name == "fps" and report.detectors else getattr(report, name)
            for name, *_ in MEASURES
        },
        source=str(folder),
        machine=f"{report.machine}, {counted(report.threads, 'thread')}",
    )


def _settings(report: ReportJson, folder: Path) -> dict[str, Any]:
    """Return the thresholds and options that differ from the defaults, and the method's version.

    If the folder has no ``run.json``, it contains a run of another SLAM system. Such a run has no
    settings.
    """
    if not (folder / "run.json").exists():
        return {}
    path = folder / "config.json"
    try:
        changed = changed_thresholds(json.loads(path.read_bytes())) if path.exists() else {}
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{path.name} is damaged") from error
    options = {name: getattr(report, name) for name in _OPTIONS}
    options["calib"] = " ".join(map(str, report.calib))
    options["method"] = report.versions.get("method")
    return with_preset(changed) | {name: str(value) for name, value in options.items() if value}


def _name_by_settings(found: Found) -> None:
    """Append the settings to the names of the systems, except settings that all runs share. Runs of
    other SLAM systems have no settings, and do not count here."""
    settings = [run.settings for run in found.runs if run.settings] or [{}]
    shared = {
        name: value
        for name, value in settings[0].items()
        if all(one.get(name) == value for one in settings)
    }
    if told := [f"{name}={value}" for name, value in shared.items() if name != "method"]:
        found.notes.append(f"all runs have {', '.join(told)}")
    for k, run in enumerate(found.runs):
        own = ", ".join(f"{n}={v}" for n, v in run.settings.items() if n not in shared)
        if own:
            name = run.system.removesuffix(MONOCULAR)
            system = f"{name} ({own}){run.system.removeprefix(name)}"
            found.runs[k] = run.model_copy(update={"system": system})


def without_settings(system: str) -> str:
    """Return the name of a system without the settings that follow it in brackets."""
    return re.sub(r" \(.*\)", "", system)


def _add_external(text: str, found: Found) -> None:
    name, separator, file = text.partition("=")
    system, *where = name.split("@")
    if not (separator and system and file) or len(where) > 2:
        raise InputError(
            f"--trajectory {text}: write NAME=FILE or, to name the sequence and perturbation, "
            "NAME@SEQUENCE@PERTURB=FILE."
        )
    perturb = where[1] if len(where) == 2 else "none"
    places = {
        (run.drive.dataset, run.drive.sequence, run.drive.excerpt): None
        for run in found.runs
        if not where or run.drive.sequence == where[0]
    }
    if len(places) != 1:
        known = ", ".join(dict.fromkeys(run.drive.sequence for run in found.runs))
        if places and where:
            raise InputError(
                f"--trajectory {text}: the runs cover different excerpts of {where[0]}; name "
                "folders with one excerpt only."
            )
        raise InputError(
            f"--trajectory {text}: its sequence is not clear; write {system}@SEQUENCE=FILE with "
            f"one of {known}."
        )
    dataset, sequence, excerpt = next(iter(places))
    drive = Drive(dataset=dataset, sequence=sequence, excerpt=excerpt, perturb=perturb)
    truth = _truth(found, drive)
    if truth is None:
        raise InputError(f"--trajectory {text}: no run on {sequence} has a ground truth.")
    path = Path(file)
    alignment = _alignment_of_external(system, drive, found)
    evaluation = evaluate_trajectory(read_trajectory(path, truth.timestamps), truth, alignment)
    if evaluation.frames < len(truth):
        found.notes.append(
            f"{system} has poses for {evaluation.frames} of {len(truth)} frames of {drive.place}, "
            f"{perturb}: its errors cover only these frames; the errors of vslam cover all frames"
        )
    measures: dict[str, float | None] = {
        measure: getattr(evaluation, measure, None) for measure, *_ in MEASURES
    }
    source = f"{system}: {path}"
    found.runs.append(
        RunEntry(
            drive=drive,
            system=system,
            seed=None,
            alignment=alignment,
            frames=evaluation.frames,
            measures=measures,
            source=source,
            machine=None,
        )
    )
    found.estimate[source] = path


def _alignment_of_external(system: str, drive: Drive, found: Found) -> str:
    """Return the alignment (se3 or sim3) with which another system's trajectory is evaluated.

    It is the alignment of vslam's runs on the same sequence. If some of these runs are monocular
    and others are not, a name that ends in ``, mono`` gives sim3.
    """
    there = {run.alignment for run in found.runs if run.drive.place == drive.place}
    if len(there) == 1:
        return there.pop()
    return alignment_of("mono" if system.endswith(MONOCULAR) else "stereo")


def _truth(found: Found, drive: Drive) -> Trajectory | None:
    folder = found.truth.get((drive.dataset, drive.place))
    if folder is None:
        return None
    times = read_trajectory(folder / "trajectory.tum").timestamps
    return read_trajectory(folder / "ground_truth_kitti.txt", times)
