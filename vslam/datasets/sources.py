"""Opens all kinds of sources: data sets, folders of images, videos, bags and live cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from vslam.calibration.files import NEEDED_CALIBRATION, read_calibration
from vslam.calibration.models import Calibration
from vslam.datasets import open_sequence
from vslam.datasets.auto_calibration import calibrate_source, single_camera
from vslam.datasets.detection import detect_dataset
from vslam.datasets.frames import RawSource, Source, selected
from vslam.datasets.image_files import depth_scale_of, list_images
from vslam.datasets.imu import Imu
from vslam.datasets.imu_csv import IMU_FILE, read_imu_csv
from vslam.datasets.kitti_raw import is_kitti_raw
from vslam.datasets.masks import with_masks
from vslam.datasets.rectified import rectified
from vslam.support.errors import InputError
from vslam.types.source_options import AUTO, DEPTH_CAMERAS, SOURCES, SourceOptions

_APPLIES_TO = {
    "right": ("images",),
    "depth": ("images",),
    "fps": ("images", "video"),
    "side_by_side": ("video", "camera"),
    "topics": ("bag",),
    "imu_topics": ("bag",),
    "depth_scale": ("tum", "images", "bag"),
}
_NOT_MONOCULAR = ("right", "depth", "depth_scale")


def open_source(
    options: SourceOptions, on_render: Callable[[int, int], None] | None = None
) -> Source:
    """Open a data set, or the images of any camera. Images that are not rectified are rectified.

    Args:
        on_render: called after each rendered frame, with the number of frames rendered so far and
            the total number.

    Raises:
        InputError: an option does not apply to this source, the source does not have the images of
            ``sensor``, the calibration is missing or does not fit the images, or the reader rejects
            the data.
    """
    o = options
    dataset = o.dataset or detect_dataset(o.data)
    if o.calib == AUTO:
        o = single_camera(dataset, o)
    _check_options(dataset, o)
    source: Source
    if dataset in SOURCES:
        source = _open_images(dataset, o)
    else:
        source = open_sequence(
            dataset, Path(o.data), o.seq, start=o.start, every=o.every, max_frames=o.max_frames,
            monocular=o.sensor == "mono", calib=o.calib, depth_scale=o.depth_scale,
            on_render=on_render,
        )  # fmt: skip
    if o.sensor not in (None, source.camera.sensor):
        raise InputError(
            f"--sensor {o.sensor}: {source.name} has the sensor {source.camera.sensor}; leave the "
            "option out, or use mono."
        )
    if not o.imu:
        source = replace(source, imu=None)
    if o.mask is None:
        return source
    return with_masks(source, o.mask, start=o.start, every=o.every)


def _open_images(dataset: str, options: SourceOptions) -> Source:
    o = options
    monocular = o.sensor == "mono"
    if dataset == "images":
        from vslam.datasets.image_folders import open_images

        found = open_images(
            Path(o.data), o.right, depth=o.depth, fps=o.fps, start=o.start, every=o.every,
            max_frames=o.max_frames, sensor=o.sensor,
        )  # fmt: skip
        if o.calib == AUTO:
            return _calibrated(replace(found.source(), imu=_imu_beside(Path(o.data))), o.data)
        calibration = _calibration(dataset, o, found.size)
        scale = depth_scale_of(o.depth_scale, calibration.depth_scale)
        return rectified(replace(found.source(scale), imu=_imu_beside(Path(o.data))), calibration)
    raw, own = _open_stream(dataset, o, monocular)
    if o.calib == AUTO:
        return _calibrated(raw, o.data)
    return rectified(raw, _calibration(dataset, o, raw.sizes[0], own))


def _calibrated(raw: RawSource, data: str) -> Source:
    """Rectify the images of one camera, which is calibrated from its motion."""
    found = calibrate_source(raw, data)
    source = rectified(raw, Calibration(found.camera, source=f"{data}: --calib auto"))
    notes = f"--calib auto: {found}.", *(f"--calib auto: {text}" for text in found.warnings())
    return replace(source, warnings=(*source.warnings, *notes))


def open_raw(options: SourceOptions) -> RawSource:
    """Open unrectified images to calibrate their cameras. The times of the images are not used.

    If ``sensor`` is None, a video or live camera is monocular unless ``side_by_side`` is set. A
    folder that directly contains images is monocular unless ``right`` is given.

    Raises:
        InputError: an option does not apply to this source, the source does not have unrectified
            images of one camera or of a stereo pair, or the reader rejects the data.
    """
    o = options
    dataset = o.dataset or detect_dataset(o.data)
    _check_options(dataset, o)
    if dataset == "images":
        from vslam.datasets.image_folders import open_images

        alone = o.right is None and bool(list_images(Path(o.data)))
        return open_images(
            Path(o.data), o.right, fps=o.fps or 1.0, start=o.start, every=o.every,
            max_frames=o.max_frames, sensor=o.sensor or ("mono" if alone else "stereo"),
        ).source()  # fmt: skip
    if dataset == "euroc":
        from vslam.datasets.euroc import open_raw_euroc

        return open_raw_euroc(
            o.data, o.seq, start=o.start, every=o.every, max_frames=o.max_frames,
            monocular=o.sensor == "mono",
        )  # fmt: skip
    if dataset not in SOURCES:
        raise InputError(
            f"{o.data}: {dataset} is already calibrated; give a video, a bag, folders of images or "
            "EuRoC's layout with images of a calibration board."
        )
    monocular = o.sensor == "mono" or (dataset != "bag" and not o.side_by_side)
    raw, _ = _open_stream(dataset, o, monocular)
    if raw.depth:
        raise InputError(f"{o.data}: the second images are depth; use --sensor mono.")
    return raw


def _open_stream(
    dataset: str, options: SourceOptions, monocular: bool
) -> tuple[RawSource, Callable[[], Calibration] | None]:
    """Return the source, and a function that reads the calibration that a bag or depth camera
    stores."""
    o = options
    raw: RawSource
    own: Callable[[], Calibration] | None = None
    if dataset == "video":
        from vslam.datasets.video import open_video

        raw = open_video(Path(o.data), fps=o.fps, side_by_side=o.side_by_side, monocular=monocular)
        raw = replace(raw, imu=_imu_beside(Path(o.data)))
    elif dataset == "bag":
        from vslam.datasets.bag import find_calibration, open_bag

        raw = bag = open_bag(
            Path(o.data), topics=_names(o.topics), sensor=o.sensor, depth_scale=o.depth_scale,
            imu_topics=_names(o.imu_topics),
        )  # fmt: skip
        own = partial(find_calibration, bag)
    elif dataset in DEPTH_CAMERAS:
        from vslam.datasets.depth_cameras import frames_of
        from vslam.datasets.oakd import open_oakd
        from vslam.datasets.realsense import open_realsense

        opened = open_oakd if dataset == "oakd" else open_realsense
        device = opened(o.data, "mono" if monocular else o.sensor)
        raw, own = frames_of(device), partial(getattr, device, "calibration")
    else:
        from vslam.datasets.video import open_camera

        raw = open_camera(o.data, side_by_side=o.side_by_side, monocular=monocular)
    return selected(raw, start=o.start, every=o.every, max_frames=o.max_frames), own


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _imu_beside(data: Path) -> Imu | None:
    """Return the IMU whose samples are in a CSV file beside a video, or in or beside a folder.

    For ``drive.mp4``, the file is ``drive.imu.csv`` or ``imu.csv``.
    """
    named = [data.with_suffix(".imu.csv")] if data.is_file() else [data / IMU_FILE]
    files = [*named, data.resolve().parent / IMU_FILE]
    file = next((file for file in files if file.is_file()), None)
    return None if file is None else Imu(str(file), partial(read_imu_csv, file))


def _check_options(dataset: str, options: SourceOptions) -> None:
    if options.seq and dataset in SOURCES:
        raise InputError(f"--seq {options.seq}: only for data sets, not {dataset}; leave it out.")
    for name, kinds in _APPLIES_TO.items():
        value = getattr(options, name)
        if value is None or value is False or value == "":
            continue
        option = f"--{name.replace('_', '-')}"
        if dataset not in kinds:
            raise InputError(
                f"{option}: only for --dataset {' or '.join(kinds)}, not {dataset}; leave it out."
            )
        if options.sensor == "mono" and name in _NOT_MONOCULAR:
            raise InputError(f"{option}: contradicts --sensor mono; leave one of them out.")
        if isinstance(value, float) and not 0.0 < value < float("inf"):
            raise InputError(f"{option} {value:g}: must be a positive number.")


def _calibration(
    dataset: str,
    options: SourceOptions,
    size: tuple[int, int],
    own: Callable[[], Calibration] | None = None,
) -> Calibration:
    if options.calib:
        return read_calibration(options.calib, size)
    if own is None:
        folder = Path(options.data).resolve()
        if dataset == "images" and (folder / "calib.txt").is_file():
            raise InputError(
                f"{options.data}: a sequence of KITTI; open it with --data {folder.parent.parent} "
                f"--seq {folder.name}, or give a calibration with --calib."
            )
        if dataset == "images" and is_kitti_raw(folder.parent.parent):
            raise InputError(
                f"{options.data}: images of a drive of KITTI raw; open the drive with --data "
                f"{folder.parent.parent}, or give a calibration with --calib."
            )
        raise InputError(f"--calib: no calibration; {NEEDED_CALIBRATION}.")
    return own()
