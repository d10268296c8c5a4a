"""Rectifies the images of a source when they are decoded."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Calibration
from vslam.calibration.rectification import Rectification, rectify
from vslam.datasets.frames import Images, RawSource, Size, Source, TimedFrame, decoded
from vslam.datasets.image_files import with_depth
from vslam.datasets.imu import Imu
from vslam.support.errors import InputError
from vslam.types.camera import DepthImage, Image, ImageMap

# Names of what an encoder has cut off, by the numbers of missing columns and rows.
_MISSING = {(1, 0): "column", (0, 1): "row", (1, 1): "column and row"}


def rectified(raw: RawSource, calibration: Calibration) -> Source:
    """Make a source whose images are rectified when they are read.

    Images that are already rectified stay unchanged.

    Raises:
        InputError: the images do not have the calibrated size, the calibration of the right camera
            is missing, or `vslam.calibration.rectification.rectify` rejects the calibration.
    """
    if raw.depth:  # depth is registered to the left image
        alone = _rectification_for(calibration, raw.sizes[:1])
        rectification = replace(alone, camera=with_depth(alone.camera, calibration))
    else:
        rectification = _rectification_for(calibration, raw.sizes)
    frame = partial(_rectified_frame, rectification)
    T_wc = raw.ground_truth
    if T_wc is not None:  # rectification rotates the left camera, and its poses with it
        T_wc = T_wc.copy()
        T_wc[:, :3, :3] = T_wc[:, :3, :3] @ rectification.R_left_rectified
    return Source(
        dataset=raw.dataset,
        name=raw.name,
        camera=rectification.camera,
        stored=tuple(map(frame, raw.stored)),
        play=None if raw.seekable else lambda: map(frame, raw.frames()),
        n_expected=raw.n_expected,
        live=raw.live,
        ground_truth=T_wc,
        pairing=raw.pairing,
        timing=raw.timing,
        warnings=raw.warnings,
        calibration=calibration,
        rectify_mask=rectification.left_depth,
        imu=None if raw.imu is None else _rectified_imu(raw.imu, calibration, rectification),
    )


def _rectified_imu(imu: Imu, calibration: Calibration, rectification: Rectification) -> Imu:
    """Calibrate the IMU of a source for its rectified left camera.

    What the calibration file says about the IMU replaces what the source says.
    """
    own = calibration.imu or imu.calibration
    noise = calibration.imu_noise or imu.noise or (None if own is None else own.noise)
    if own is None:
        return replace(imu, noise=noise)
    T_left_rectified = np.eye(4)
    T_left_rectified[:3, :3] = rectification.R_left_rectified
    T_imu_camera = own.T_imu_camera @ T_left_rectified
    one = replace(own, T_imu_camera=T_imu_camera, noise=noise or own.noise)
    return replace(imu, calibration=one, noise=noise)


def _rectification_for(calibration: Calibration, sizes: Several[Size]) -> Rectification:
    if len(sizes) == 1 and calibration.right is not None:
        calibration = calibration.left_alone()
    if len(sizes) == 2 and calibration.right is None:
        raise InputError(
            f"{calibration.source}: the calibration of the right camera is missing; give the "
            "calibration of both, or run on the left camera alone with --sensor mono."
        )
    models = [model for model in (calibration.left, calibration.right) if model is not None]
    for model, (width, height) in zip(models, sizes, strict=True):
        if (model.width, model.height) != (width, height):
            missing = model.width - width, model.height - height
            fix = "take the calibration of these images"
            if missing in _MISSING:
                fix = (
                    f"an encoder seems to have cut off the last {_MISSING[missing]}; write this "
                    "size into the calibration and keep its other numbers"
                )
            elif (2 * model.width, model.height) == (width, height):
                fix = "use --side-by-side if each image holds both images of a stereo pair"
            raise InputError(
                f"{calibration.source}: made for {model.width}x{model.height} pixels but the "
                f"images have {width}x{height}; {fix}."
            )
    return rectify(calibration)


def _rectified_frame(rectification: Rectification, frame: TimedFrame) -> TimedFrame:
    file = frame.file if rectification.identity else None
    colour = None
    if frame.colour is not None:
        colour = partial(_read_one, frame.colour, rectification.left)
    sides = None
    if frame.sides is not None:
        left, second = frame.sides
        sides = (
            partial(_read_one, left, rectification.left),
            partial(_read_second, second, rectification),
        )
    read = partial(_read, rectification, frame)
    return replace(frame, read=read, sides=sides, file=file, colour=colour)


def _read(rectification: Rectification, frame: TimedFrame, image_map: ImageMap) -> Images:
    left, second = frame.read(image_map)
    sides: list[Callable[[], Image | DepthImage]] = [partial(rectification.left, left)]
    if second is not None:
        sides.append(partial(_second, second, rectification))
    return decoded(sides, image_map)


def _read_second(
    read: Callable[[], Image | DepthImage], rectification: Rectification
) -> Image | DepthImage:
    return _second(read(), rectification)


def _second(image: Image | DepthImage, rectification: Rectification) -> Image | DepthImage:
    if rectification.camera.depth:
        return rectification.left_depth(image)
    return rectification.right(np.asarray(image, np.uint8))


def _read_one(
    read: Callable[[], NDArray[np.uint8]], rectify: Callable[[NDArray[np.uint8]], NDArray[Any]]
) -> NDArray[np.uint8]:
    return np.asarray(rectify(read()), np.uint8)
