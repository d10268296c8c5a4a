"""The folder of a finished run, read again: its map, its images and its pose graph."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from vslam.backend.pose_graph import PoseGraph, essential_graph
from vslam.camera import Camera, same_camera
from vslam.config import Config, load_config
from vslam.datasets.frames import Source, TimedFrame, frames_at
from vslam.datasets.sources import LIVE, open_source
from vslam.errors import InputError
from vslam.loops import LoopEdge
from vslam.map import Map
from vslam.maps.storage import load_map
from vslam.report.schema import ReportJson
from vslam.run.options import read_options

_SAME_TIME_S = 1e-6
_WITHOUT_IMAGES = "export g2o, euroc or ply --no-colours, which need none"


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
    run: FinishedRun,
    data: str | None = None,
    on_render: Callable[[int, int], None] | None = None,
) -> Source:
    """Open the images of a run again, as its ``run.json`` says.

    Args:
        data: where they are now, if that is another place.
        on_render: as in :func:`vslam.datasets.open_sequence`.

    Raises:
        InputError: the images are not there, not by the run's camera, or of a live camera.
    """
    if set(run.map.sessions) != {run.map.scalars.session}:  # the report is of the last drive
        raise InputError(
            f"{run.folder}: the map is of several drives, whose images cannot be opened together; "
            f"{_WITHOUT_IMAGES}."
        )
    options = read_options(run.folder)
    if run.report.dataset in LIVE:
        raise InputError(
            f"{run.folder}: what a camera has shown cannot be seen again; {_WITHOUT_IMAGES}."
        )
    moved = {"dataset": run.report.dataset, "mask": None} | ({} if data is None else {"data": data})
    source = open_source(options.model_copy(update=moved), on_render)
    if not same_camera(run.camera, source.camera):
        raise _other_images(run)
    return source


def keyframe_frames(run: FinishedRun, source: Source) -> Iterator[TimedFrame]:
    """The frames of a run's keyframes, in the order of its map.

    Raises:
        InputError: the times are not those of the run.
    """
    frames = frames_at(source, run.map.frames.tolist())
    n = 0
    for frame, time in zip(frames, run.map.timestamps.tolist(), strict=False):
        if abs(frame.timestamp - time) > _SAME_TIME_S:
            raise _other_images(run)
        yield frame
        n += 1
    if n < len(run.map.frames):
        raise _other_images(run)


def _other_images(run: FinishedRun) -> InputError:
    return InputError(
        f"{run.report.dataset} {run.report.sequence}: times or camera are not those of "
        f"{run.folder}; name the data that the run was made on with --data."
    )


def pose_graph(run: FinishedRun) -> PoseGraph:
    """The essential graph of a run's final map with its loops as they were measured, with the
    weights of the run.

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
