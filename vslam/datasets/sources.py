"""All that a run can be given: data sets, and folders, videos, bags and live cameras."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import dataclass
from pathlib import Path

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration
from vslam.datasets import DATASETS, open_plugin_source, open_sequence
from vslam.datasets.rectified import rectified
from vslam.datasets.rectified_stream import rectified_stream
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import RawStream, Stream
from vslam.errors import InputError

SOURCES = ("images", "video", "bag", "camera")


@dataclass(frozen=True)
class SourceOptions:
    """What some kinds of sources need to be told.

    Attributes:
        calibration: files, see `vslam.calibration.files.read_calibration`.
        right: folder of the right images.
        depth: folder of the depth images.
        fps: frames a second, in place of time stamps.
        side_by_side: each frame holds the left image and, right of it, the right one.
        topics: of the left images in a bag, and of the right ones or the depth.
        depth_scale: what depth images count in a metre.
    """

    calibration: Several[Path] = ()
    right: Path | None = None
    depth: Path | None = None
    fps: float | None = None
    side_by_side: bool = False
    topics: tuple[str, ...] = ()
    depth_scale: float | None = None


_FOR = {
    "right": ("images",),
    "depth": ("images",),
    "fps": ("images", "video"),
    "side_by_side": ("video", "camera"),
    "topics": ("bag",),
    "depth_scale": ("tum", "images", "bag"),
}
_NOT_MONOCULAR = ("right", "depth", "depth_scale")


def open_source(
    dataset: str,
    data: str,
    name: str | None,
    options: SourceOptions,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    sensor: str | None = None,
    on_render: Callable[[int, int], None] | None = None,
) -> Sequence | Stream:
    """Open a data set, or images of any camera, which are rectified by the user's calibration.

    Args:
        dataset: one of `SOURCES`, or as `vslam.datasets.open_sequence` takes it.
        data: folder or file, number of a device, or URL.
        name: of the sequence of a data set, None as for `vslam.datasets.open_sequence`.
        sensor: that the source must be of; ``mono`` reads left images alone, None all there are.
        on_render: see `vslam.datasets.open_sequence`.

    Raises:
        InputError: an option that this source has no use for, another sensor, no calibration or
            one of other images, or as the reader says.
    """
    monocular = sensor == "mono"
    _check_options(dataset, name, options, monocular)
    source: Sequence | Stream
    if dataset in SOURCES:
        source = _open_images(dataset, data, options, start, every, max_frames, sensor)
    elif dataset not in DATASETS:
        source = open_plugin_source(
            dataset, Path(data), name, start=start, every=every, max_frames=max_frames,
            monocular=monocular, calib=options.calibration,
        )  # fmt: skip
    else:
        source = open_sequence(
            dataset, Path(data), name, start=start, every=every, max_frames=max_frames,
            monocular=monocular, calib=options.calibration, depth_scale=options.depth_scale,
            on_render=on_render,
        )  # fmt: skip
    if sensor not in (None, source.camera.sensor):
        raise InputError(
            f"--sensor {sensor}: {source.name} is of sensor {source.camera.sensor}; leave it out, "
            "or take mono."
        )
    return source


def _open_images(
    dataset: str,
    data: str,
    options: SourceOptions,
    start: int,
    every: int,
    max_frames: int | None,
    sensor: str | None,
) -> Sequence | Stream:
    if dataset == "images":
        from vslam.datasets.image_folders import open_images

        found = open_images(
            Path(data), options.right, depth=options.depth, fps=options.fps, start=start,
            every=every, max_frames=max_frames, sensor=sensor,
        )  # fmt: skip
        calibration = _calibration(dataset, data, options, found.size)
        if not found.depth:
            return rectified(found.images(), calibration)
        raw = found.with_depth(options.depth_scale or calibration.depth_scale)
        return rectified(raw, calibration, depth=True)
    stream: RawStream
    own: Calibration | None = None
    monocular, depth = sensor == "mono", False
    if dataset == "video":
        from vslam.datasets.video import open_video

        stream = open_video(
            Path(data), fps=options.fps, side_by_side=options.side_by_side, monocular=monocular
        )
    elif dataset == "bag":
        from vslam.datasets.bag import find_calibration, open_bag

        stream = bag = open_bag(
            Path(data), topics=options.topics, sensor=sensor, depth_scale=options.depth_scale
        )
        own, depth = None if options.calibration else find_calibration(bag), bag.depth
    else:
        from vslam.datasets.live_camera import open_camera

        stream = open_camera(data, side_by_side=options.side_by_side, monocular=monocular)
    return rectified_stream(
        stream,
        _calibration(dataset, data, options, stream.sizes[0], own),
        start=start,
        every=every,
        max_frames=max_frames,
        depth=depth,
    )


def _check_options(
    dataset: str, sequence: str | None, options: SourceOptions, monocular: bool
) -> None:
    if sequence and dataset in SOURCES:
        raise InputError(f"--seq {sequence}: only for data sets, not {dataset}; leave it out.")
    for name, kinds in _FOR.items():
        if not getattr(options, name):
            continue
        option = f"--{name.replace('_', '-')}"
        if dataset not in kinds:
            raise InputError(
                f"{option}: only for --dataset {' or '.join(kinds)}, not {dataset}; leave it out."
            )
        if monocular and name in _NOT_MONOCULAR:
            raise InputError(f"{option}: of no use with --sensor mono; leave one of them out.")


def _calibration(
    dataset: str,
    data: str,
    options: SourceOptions,
    size: tuple[int, int],
    own: Calibration | None = None,
) -> Calibration:
    if options.calibration:
        return read_calibration(options.calibration, size)
    if own is None:
        folder = Path(data).resolve()
        if dataset == "images" and (folder / "calib.txt").is_file():
            raise InputError(
                f"{data}: a sequence of KITTI; name the folder that holds 'sequences' and the "
                f"sequence in it, --data {folder.parent.parent} --seq {folder.name}, or a "
                "calibration with --calib."
            )
        where = " (nor camera_info in the bag)" if dataset == "bag" else ""
        raise InputError(
            f"--calib: no calibration{where}; name a file with the cameras' focal lengths, "
            "centres, distortion and, of two cameras, baseline, as docs/howto/cameras.md describes."
        )
    return own
