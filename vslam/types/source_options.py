"""The options that select a source of frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict

from vslam.support import plugins
from vslam.support.options import INPUT, Option

DATASETS = ("kitti", "kitti_raw", "euroc", "tum", "synthetic")  # plug-ins may add others
DEPTH_CAMERAS = ("realsense", "oakd")
LIVE = ("camera", *DEPTH_CAMERAS)
SOURCES = ("images", "video", "bag", *LIVE)
AUTO = (Path("auto"),)
"""The calibration files if the camera is to be calibrated from the images of the source."""


def source_names() -> tuple[str, ...]:
    """Return the names of all kinds of data, also of those that plug-ins read."""
    others = (one for one in plugins.find_plugins(plugins.READERS) if one not in DATASETS)
    return (*DATASETS, *others, *SOURCES)


class SourceOptions(BaseModel):
    """Options that select a source of frames and tell how to read it.

    Attributes:
        data: folder, file, device number or URL. For a depth camera, it is the serial number; if
            the serial number is empty, the first camera that is found is used. ``data`` is ignored
            for rendered towns.
        dataset: one of `DATASETS` or of `SOURCES`, or the name of a data set that a plug-in reads.
            None detects the data set from ``data``.
        seq: name of the sequence of a data set, see `vslam.datasets.open_sequence`.
        calib: calibration files, see `vslam.calibration.files.read_calibration`, or `AUTO`.
        right: folder of the right images.
        depth: folder of the depth images.
        fps: frames per second. If it is given, the time stamps of the source are not used.
        side_by_side: whether each frame contains the left and the right image side by side.
        topics: for a bag, the topic of the left images, or two topics separated by a comma. The
            second topic contains the right images or the depth images.
        imu_topics: for a bag, the topic of the IMU, or those of its gyroscope and accelerometer,
            separated by a comma.
        imu: whether to use the IMU of the source.
        depth_scale: depth image units per metre.
        sensor: ``stereo``, ``rgbd`` or ``mono``. With ``mono``, only the left images are read. None
            reads all images of the source.
        mask: mask for all left images, or folder with a mask for each left image, see
            `vslam.datasets.masks.with_masks`.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: Annotated[
        str,
        Option(
            INPUT,
            "DATA",
            "Data set, folder of images, video, bag, or the number or URL of a camera "
            "(docs/howto/sources.md).",
            unset="$KITTI_ROOT, else data/kitti",
            given_as=str,
        ),
    ] = ""
    dataset: Annotated[
        str | None,
        Option(
            INPUT,
            "KIND",
            "Kind of data: {choices}.",
            unset="detected from the files",
            choices=source_names,
        ),
    ] = None
    seq: Annotated[
        str | None,
        Option(INPUT, "NAME", "Sequence of a data set.", unset="00; not needed for EuRoC and TUM"),
    ] = None
    calib: Annotated[
        tuple[Path, ...],
        Option(
            INPUT,
            "FILE",
            "Calibration file (docs/howto/cameras.md). If each camera has its own file, give the "
            "option twice, the left camera first. [b]auto[/b] calibrates one camera from its own "
            "images (docs/howto/calibrate.md).",
            given_as=list[Path],
        ),
    ] = ()
    right: Annotated[
        Path | None,
        Option(INPUT, "FOLDER", "Right images. [b]--data[/b] gives the left images."),
    ] = None
    depth: Annotated[
        Path | None,
        Option(INPUT, "FOLDER", "Depth images. [b]--data[/b] gives the grey or colour images."),
    ] = None
    fps: Annotated[
        float | None, Option(INPUT, "NUMBER", "Frames per second, for data without timestamps.")
    ] = None
    side_by_side: Annotated[
        bool, Option(INPUT, "", "Each image contains both views side by side.")
    ] = False
    topics: Annotated[
        str,
        Option(
            INPUT,
            "LEFT,RIGHT",
            "Image topics of a bag: LEFT,RIGHT for stereo, one topic for mono, COLOUR,DEPTH for "
            "RGB-D.",
        ),
    ] = ""
    imu_topics: Annotated[str, Option(INPUT, "TOPIC", "IMU topic of a bag, or GYRO,ACCEL.")] = ""
    imu: Annotated[bool, Option(INPUT, "", "Whether to use the IMU.", name="--imu/--no-imu")] = True
    depth_scale: Annotated[
        float | None,
        Option(
            INPUT,
            "NUMBER",
            "Value of a pixel at a depth of one metre.",
            unset="from the calibration, data set or encoding",
        ),
    ] = None
    sensor: Annotated[
        str | None,
        Option(
            INPUT,
            "stereo|mono|rgbd",
            "Images to use. [b]mono[/b] uses only the left images, and its scale is arbitrary.",
            unset="all images of the data",
            choices=lambda: ("stereo", "mono", "rgbd"),
        ),
    ] = None
    mask: Annotated[
        Path | None,
        Option(
            INPUT,
            "FILE|FOLDER",
            "Mask image that is black where the left images must not be used, or a folder with "
            "a mask for each image (docs/howto/masks.md).",
        ),
    ] = None
    start: Annotated[int, Option(INPUT, "N", "First frame.", min=0)] = 0
    every: Annotated[int, Option(INPUT, "N", "Use only every N-th frame.", min=1)] = 1
    max_frames: Annotated[
        int | None, Option(INPUT, "N", "Stop after N frames.", min=1, unset="all")
    ] = None
