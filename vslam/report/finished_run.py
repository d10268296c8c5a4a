"""Reads a finished run from its folder: the report, the map and the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from vslam.datasets.frames import Source, TimedFrame, frames_at
from vslam.datasets.sources import open_source
from vslam.maps.storage import load_map
from vslam.report.schema import ReportJson
from vslam.run.options import read_options
from vslam.support.errors import InputError
from vslam.types.camera import Camera, same_camera
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.source_options import LIVE

_SAME_TIME_S = 1e-6
_WITHOUT_IMAGES = "export g2o, euroc or ply --no-colours, which need no images"


@dataclass(frozen=True)
class FinishedRun:
    """The content of the folder of a finished run.

    Attributes:
        map: the map without culled keyframes.
        loops: the closed loops, with the relative poses that were measured when the loops were
            verified.
    """

    folder: Path
    report: ReportJson
    map: Map
    camera: Camera
    loops: tuple[LoopEdge, ...] = ()


def read_run(folder: Path | str) -> FinishedRun:
    """Read the report and the map of a run.

    Raises:
        InputError: the folder is not the folder of a run, or its map is missing, empty or from
            another version of vslam.
    """
    folder = Path(folder)
    if not (folder / "map.npz").is_file():
        raise InputError(f"{folder}: no map.npz here; give the folder of a run, like runs/latest.")
    stored = load_map(folder / "map.npz")
    if not stored.map.n_keyframes:
        raise InputError(f"{folder / 'map.npz'}: the map is empty; give a run that has one.")
    return FinishedRun(
        folder, ReportJson.read(folder / "report.json"), stored.map, stored.camera, stored.loops
    )


def open_images(
    run: FinishedRun,
    data: str | None = None,
    on_render: Callable[[int, int], None] | None = None,
) -> Source:
    """Open the images of a run again, with the options in its ``run.json``.

    Args:
        data: the new location of the data if the data have been moved.
        on_render: function that is called while a synthetic sequence is rendered. Its arguments are
            the number of frames rendered so far and the total number.

    Raises:
        InputError: the images are missing, they belong to a different camera, they came from a live
            camera, or the map was made from several drives.
    """
    if set(run.map.sessions) != {run.map.scalars.session}:  # the report covers only the last drive
        raise InputError(
            f"{run.folder}: the map was made from several drives, whose images cannot be opened "
            f"together; {_WITHOUT_IMAGES}."
        )
    options = read_options(run.folder)
    if run.report.dataset in LIVE:
        raise InputError(
            f"{run.folder}: images of a live camera are not stored; {_WITHOUT_IMAGES}."
        )
    moved = {"dataset": run.report.dataset, "mask": None} | ({} if data is None else {"data": data})
    source = open_source(options.model_copy(update=moved), on_render)
    if not same_camera(run.camera, source.camera):
        raise _other_images(run)
    return source


def keyframe_frames(run: FinishedRun, source: Source) -> Iterator[TimedFrame]:
    """Yield the frames that became keyframes of a run, in the order of the keyframes in the map.

    Raises:
        InputError: the timestamps of the images differ from the timestamps of the run.
    """
    frames = frames_at(source, run.map.frames.tolist())
    for frame, time in zip_longest(frames, run.map.timestamps.tolist()):
        if frame is None or abs(frame.timestamp - time) > _SAME_TIME_S:
            raise _other_images(run)
        yield frame


def _other_images(run: FinishedRun) -> InputError:
    return InputError(
        f"{run.report.dataset} {run.report.sequence}: the times or the camera differ from those of "
        f"{run.folder}; use --data to give the data that the run was made on."
    )
