"""Rectifies images: removes the distortion, and aligns the images of a stereo pair.

The x axis of the rectified pair is the baseline. Its viewing direction is as close as possible to
the mean viewing direction of the two cameras. If one camera is above the other, rectification
therefore turns the images by about 90 degrees (``Camera.quarter_turns``). The rectified images show
the largest rectangle that both original images cover. They have no black border, because features
on such a border would not move with the scene.

OpenCV's functions can leave black corners. ``cv2.stereoRectify`` estimates the rectangle from a 9x9
grid, and ``cv2.fisheye.stereoRectify`` estimates it from four points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Array, Calibration, CameraModel, project, unproject
from vslam.support.errors import InputError
from vslam.types.camera import Camera, Image

Pixels = TypeVar("Pixels", bound=NDArray[np.generic])

# Largest half field of view of a rectified image. At 60 degrees off the axis, a pinhole image is
# stretched four times as much as at its centre. A wider view would enlarge the border and shrink
# the centre even more.
_MAX_HALF_VIEW = np.tan(np.radians(60.0))
_FARTHEST_M = 20.0  # longest baseline
_SAME = 1e-5  # radians; at focal lengths below 2000 px, rows then agree to 0.02 px
_SAME_PX = 1e-3


@dataclass(frozen=True)
class Rectification:
    """The functions that rectify the images of one camera or of a pair. Several threads may call
    them.

    Attributes:
        camera: the rectified camera or pair.
        R_left_rectified: ``(3, 3)`` float64. It maps directions from the frame of the rectified
            left camera to the frame of the original left camera.
        left: function that rectifies a left image, ``(H, W)`` uint8 of the calibrated size, by
            bilinear interpolation. The result has the size of ``camera``, which is that of the left
            camera's images, turned if the images are turned.
        right: the same for a right image. If there is no right camera, it returns images unchanged.
        left_depth: function that rectifies a depth image of any type by nearest-neighbour
            interpolation. The result is valid only if rectification does not rotate the camera,
            because depth is measured along the camera's axis.
        identity: whether the functions return all images unchanged.
    """

    camera: Camera
    R_left_rectified: Array
    left: Callable[[Image], Image]
    right: Callable[[Image], Image]
    left_depth: Callable[[NDArray[Any]], NDArray[Any]]
    identity: bool


def rectify(calibration: Calibration) -> Rectification:
    """Compute the rectification of a camera or a stereo pair.

    Raises:
        InputError: one of the two cameras is in front of the other, the cameras look in different
            directions or are swapped, or a distortion cannot be inverted within the image.
    """
    left, right, source = calibration.left, calibration.right, calibration.source
    turns = 0
    if right is None or calibration.T_left_right is None:
        cameras, baseline, rectified = [(left, np.eye(3))], 0.0, left.undistorted
    else:
        R_left_right, centre = calibration.T_left_right[:3, :3], calibration.T_left_right[:3, 3]
        baseline = float(np.linalg.norm(centre))
        R_left_rectified, turns = _between(R_left_right, centre, source)
        cameras = [(left, R_left_rectified), (right, R_left_right.T @ R_left_rectified)]
        rectified = _is_rectified(left, right, R_left_right, centre)
    if rectified:
        numbers = (left.fx, left.fy), (left.cx, left.cy), baseline, (left.width, left.height)
        camera = replace(_camera(source, *numbers), right_delay=calibration.right_delay)
        return Rectification(camera, np.eye(3), unchanged, unchanged, unchanged, True)
    camera = _common_view(source, cameras, baseline, turns)
    maps = [_maps(model, R_own_rectified, camera) for model, R_own_rectified in cameras]
    return Rectification(
        replace(camera, right_delay=calibration.right_delay),
        R_left_rectified=cameras[0][1],
        left=_linear(maps[0]),
        right=_linear(maps[1]) if len(maps) == 2 else unchanged,
        left_depth=_nearest(maps[0]),
        identity=False,
    )


def unchanged(image: Pixels) -> Pixels:
    return image


def _camera(
    source: str,
    focal: tuple[float, float],
    centre: tuple[float, float],
    baseline: float,
    size: tuple[int, int],
) -> Camera:
    try:
        return Camera(*focal, *centre, baseline, *size)
    except ValueError as error:
        raise InputError(f"{source}: {error}; correct the calibration.") from error


def _is_rectified(
    left: CameraModel, right: CameraModel, R_left_right: Array, centre: Array
) -> bool:
    own, other = ([m.fx, m.fy, m.cx, m.cy, m.width, m.height] for m in (left, right))
    return bool(
        left.undistorted
        and right.undistorted
        and np.allclose(own, other, rtol=0.0, atol=_SAME_PX)
        and np.allclose(R_left_right, np.eye(3), rtol=0.0, atol=_SAME)
        and np.allclose(centre / np.linalg.norm(centre), [1.0, 0.0, 0.0], rtol=0.0, atol=_SAME)
    )


def _between(R_left_right: Array, centre: Array, source: str) -> tuple[Array, int]:
    """Compute ``R_left_rectified``, the rotation from the rectified to the original left camera,
    and the number of quarter turns in it (``Camera.quarter_turns``)."""
    import cv2

    turn = cv2.Rodrigues(R_left_right)[0].ravel()
    half = cv2.Rodrigues(turn / 2)[0]
    baseline = float(np.linalg.norm(centre))
    if baseline < 1e-6:
        raise InputError(
            f"{source}: the baseline is 0 m; give the translation between the cameras in metres."
        )
    if baseline > _FARTHEST_M:
        raise InputError(
            f"{source}: the cameras are {baseline:.4g} m apart, probably because the translation "
            "between them is in millimetres or centimetres; write it in metres (a calibration with "
            "a checkerboard has the unit in which the size of the squares was given)."
        )
    x = centre / baseline
    across, down, ahead = (x @ half).tolist()
    if abs(ahead) > np.sqrt(0.5) or np.linalg.norm(turn) > np.pi / 2:
        raise InputError(
            f"{source}: the cameras are one in front of the other or look in different directions "
            f"(turned by {np.degrees(np.linalg.norm(turn)):.0f} degrees, the right one at "
            f"{np.array2string(centre, precision=3, suppress_small=True)} m); check the "
            "transformation between them."
        )
    turns = 0 if abs(across) >= abs(down) else int(np.sign(down))
    if turns == 0 and across < 0:
        raise InputError(
            f"{source}: the right camera is {baseline:.3f} m to the left of the left one; swap the "
            "cameras, or invert the transformation between them."
        )
    y = np.cross(half[:, 2], x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)]), turns


def _common_view(
    source: str,
    cameras: list[tuple[CameraModel, Array]],
    baseline: float,
    turns: int,
) -> Camera:
    """Return the pinhole camera with the widest field of view that all original images cover. It
    has the image size of the left camera, after ``turns`` quarter turns."""
    bounds = np.array([_inner_rectangle(model, R, turns, source) for model, R in cameras])
    (x0, y0), (x1, y1) = bounds[:, 0].max(axis=0), bounds[:, 1].min(axis=0)
    if x0 >= x1 or y0 >= y1:
        raise InputError(
            f"{source}: the views of the cameras do not overlap; check the transformation between "
            "them."
        )
    width, height = cameras[0][0].width, cameras[0][0].height
    if turns:
        width, height = height, width
    focal = max((width - 1) / (x1 - x0), (height - 1) / (y1 - y0))
    cx = (width - 1) / 2 - focal * (x0 + x1) / 2
    cy = (height - 1) / 2 - focal * (y0 + y1) / 2
    focal, cx, cy = float(focal), float(cx), float(cy)
    camera = _camera(source, (focal, focal), (cx, cy), baseline, (width, height))
    camera = replace(camera, quarter_turns=turns)
    for model, R_own_rectified in cameras:
        _check_view(model, R_own_rectified, camera, source)
    return camera


def _inner_rectangle(model: CameraModel, R_own_rectified: Array, turns: int, source: str) -> Array:
    """Find a rectangle, on the plane z = 1 of the rectified camera, that the image fully covers.

    Each side of the rectangle touches one border of the image, at the pixel that is nearest to the
    centre. Pixels that cannot be unprojected are ignored, because the distortion polynomial of a
    wide lens may fold the corners of the image.

    Returns:
        ``[[x0, y0], [x1, y1]]``, two opposite corners of the rectangle.
    """
    found, borders = [], _borders(model.width, model.height)
    for k in range(4):
        border = borders[(k + turns) % 4]
        rays = unproject(model, border) @ R_own_rectified
        rays = rays[~np.isnan(rays).any(axis=1)]
        if 2 * len(rays) < len(border):
            raise _folded(source)
        with np.errstate(divide="ignore"):
            at = rays[:, k % 2] / np.maximum(rays[:, 2], 0.0)
        inner = at.max() if k < 2 else at.min()
        found.append(float(np.clip(inner, -_MAX_HALF_VIEW, _MAX_HALF_VIEW)))
    return np.array(found).reshape(2, 2)


def _check_view(model: CameraModel, R_own_rectified: Array, camera: Camera, source: str) -> None:
    """Raise an `InputError` if the original image shows a part of the rectified view twice or not
    at all."""
    xy = np.concatenate(_borders(camera.width, camera.height))
    rays = camera.backproject(xy, np.ones(len(xy))) @ R_own_rectified.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    back = unproject(model, project(model, rays))
    if not np.allclose(back, rays, rtol=0.0, atol=_SAME):
        raise _folded(source)


def _borders(width: int, height: int) -> tuple[Array, ...]:
    """Return the ``(N, 2)`` pixels on the left, upper, right and lower border of an image."""
    across, down = np.arange(float(width)), np.arange(float(height))
    top, left = np.zeros(width), np.zeros(height)
    return (
        np.column_stack([left, down]),
        np.column_stack([across, top]),
        np.column_stack([left + width - 1, down]),
        np.column_stack([across, top + height - 1]),
    )


def _folded(source: str) -> InputError:
    return InputError(
        f"{source}: the distortion folds the image within its borders, so its coefficients are "
        "wrong or in the wrong order; calibrate again, or check the distortion model."
    )


def _maps(model: CameraModel, R_own_rectified: Array, camera: Camera) -> NDArray[np.float32]:
    """Return the ``(H, W, 2)`` float32 position of each rectified pixel in the original image."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
    ).reshape(-1, 3)
    xy = project(model, rays @ R_own_rectified.T)
    return np.nan_to_num(xy, nan=-1e4).reshape(*u.shape, 2).astype(np.float32)


def _linear(maps: NDArray[np.float32]) -> Callable[[Image], Image]:
    """Make a function that warps an image bilinearly, with a resolution of 1/32 pixel. The
    fixed-point maps are three times as fast as floating-point maps."""
    import cv2

    fixed, weights = cv2.convertMaps(maps[..., 0], maps[..., 1], cv2.CV_16SC2)

    def remap(image: Image) -> Image:
        return np.asarray(
            cv2.remap(image, fixed, weights, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            np.uint8,
        )

    return remap


def _nearest(maps: NDArray[np.float32]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    import cv2

    columns, rows = np.moveaxis(np.rint(maps), 2, 0)

    def remap(depth: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(cv2.remap(depth, columns, rows, cv2.INTER_NEAREST), depth.dtype)

    return remap
