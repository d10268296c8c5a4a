"""The folder of a finished run, read again: its map, its images and its pose graph."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vslam.backend.pose_graph import PoseGraph, essential_graph
from vslam.camera import Camera, same_camera
from vslam.config import Config, load_config
from vslam.datasets import known_datasets, open_sequence
from vslam.datasets.sequence import Sequence
from vslam.errors import InputError
from vslam.loops import LoopEdge
from vslam.map import Map
from vslam.maps.storage import load_map
from vslam.report.schema import ReportJson


@dataclass(frozen=True)
class FinishedRun:
    """What the folder of a run holds; ``map`` has the living keyframes only.

    ``loops`` are those that were closed, with the relative poses that they measured.
    """

    folder: Path
    report: ReportJson
    map: Map
    camera: Camera
    loops: tuple[LoopEdge, ...] = ()


def read_run(folder: Path | str) -> FinishedRun:
    """Read the report and the map of a run.

    Raises:
        InputError: no folder of a run, a run without a map, or of another version of vslam.
    """
    folder = Path(folder)
    if not (folder / "map.npz").is_file():
        raise InputError(f"{folder}: no map.npz here; name the folder of a run, like runs/latest.")
    stored = load_map(folder / "map.npz")
    if not stored.map.n_keyframes:
        raise InputError(f"{folder / 'map.npz'}: the map is empty; name a run that has one.")
    return FinishedRun(folder, read_report(folder), stored.map, stored.camera, stored.loops)


def read_report(folder: Path | str) -> ReportJson:
    """Read ``report.json`` of a run.

    Raises:
        InputError: it is missing, damaged or of another version.
    """
    return ReportJson.read(Path(folder) / "report.json")


def open_images(
    run: FinishedRun, root: Path, on_render: Callable[[int, int], None] | None = None
) -> Sequence:
    """Open the sequence of a run as far as its last keyframe; ``map.frames`` count its frames.

    Args:
        root: of the data set; runs do not say where their images were. Where the run was made with
            ``--calib``, its calibration files are read again.
        on_render: as in :func:`vslam.datasets.open_sequence`.

    Raises:
        InputError: the images are not there, not those of the run, or of no data set.
    """
    report = run.report
    if set(run.map.sessions) != {run.map.scalars.session}:  # the report is of the last drive
        raise InputError(
            f"{run.folder}: the map is of several drives, whose images cannot be opened together; "
            "export g2o, euroc or ply --no-colours, which need none."
        )
    if report.dataset not in known_datasets():
        raise InputError(
            f"{run.folder}: images of {report.dataset} cannot be opened again, only those of "
            f"{', '.join(known_datasets())}; export g2o, euroc or ply --no-colours, which need "
            "none."
        )
    sequence = open_sequence(
        report.dataset,
        root,
        report.sequence,
        start=report.start,
        every=report.every,
        max_frames=int(run.map.frames.max()) + 1,
        monocular=report.sensor == "mono",
        calib=report.calib,
        on_render=on_render,
    )
    same = len(sequence) > run.map.frames.max() and np.allclose(
        sequence.timestamps[run.map.frames], run.map.timestamps, rtol=0.0, atol=1e-6
    )
    if not same or not same_camera(run.camera, sequence.camera):
        raise InputError(
            f"{report.dataset} {report.sequence}: times or camera are not those of {run.folder}; "
            "name the data that the run was made on with --data."
        )
    return sequence


def pose_graph(run: FinishedRun) -> PoseGraph:
    """The essential graph of a run's final map with its loops as they were measured, weighed as by
    the run.

    Raises:
        InputError: the run's thresholds cannot be read.
    """
    config = load_config(run.folder / "config.json")
    return graph_of_map(run.map, run.loops, config)


def graph_of_map(map_: Map, loops: Collection[LoopEdge], config: Config) -> PoseGraph:
    """The essential graph of a map that is finished."""
    return essential_graph(
        map_,
        loops,
        config.pose_graph,
        weak=map_.restarts,
        unpredicted=map_.unpredicted_restarts,
        driven=True,
    )
