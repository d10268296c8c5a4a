"""Pinhole cameras with rectified images.

In the camera frame, x points right, y down and z forward. Units are metres and pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # (H, W) grey values
DepthImage = NDArray[np.float32]  # (H, W) metres along z; 0 means unknown
Sensor = Literal["stereo", "mono", "rgbd"]

# Disparities are measured more accurately than columns and rows, so the reprojection error
# multiplies errors of disparity by this factor (docs/research/motorway.md).
DISPARITY_WEIGHT = 3.0

# Largest plausible distance of the principal point from the middle, as a share of the image size.
# With a calibration for images of half the size, this share is 0.25. With a calibration for images
# of twice the size, it is 0.5.
_OFF_CENTRE = 0.2
# If a calibration belongs to images of a different size, the principal point is wrong by nearly the
# same factor in x and in y. The ratio of both factors must lie between this number and its inverse.
_SAME_RATIO = 1.25
_FACTORS = {0.5: "half", 2.0: "twice"}
_NARROWEST, _WIDEST = 10.0, 150.0  # degrees, plausible fields of view of a camera on a vehicle


@dataclass(frozen=True)
class Camera:
    """A rectified stereo pair, an RGB-D camera or a single camera.

    Both images of a stereo pair have the same focal lengths. A point lies in the same row of both
    images.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point of the left camera in pixels.
        baseline: distance from the left to the right camera in metres. It is 0 for a single camera.
            For an RGB-D camera, it describes the accuracy of the depth: a stereo pair with this
            baseline would measure depth equally accurately (``frontend/depth.py``).
        width, height: image size in pixels.
        depth: whether the second image of a frame is a depth image instead of a right image. The
            depth image holds the depth of each pixel of the left image.
        right_delay: seconds from the exposure of the left image to the exposure of the right image.
            It is negative if the right image is exposed first.
        quarter_turns: 1 or -1 if the images of two cameras, one above the other, were turned by 90
            degrees, so that the cameras are side by side. 1 means that the right camera is the
            lower one. 0 if the images were not turned. The *camera as mounted* is the left camera
            before its images were turned. Trajectories contain its poses, and its first pose is the
            world frame.

    Raises:
        ValueError: a size or focal length is not positive, the baseline is negative, the principal
            point is farther from the image than the image is wide or high, or ``quarter_turns`` is
            not -1, 0 or 1.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    width: int
    height: int
    depth: bool = False
    right_delay: float = 0.0
    quarter_turns: int = 0

    def __post_init__(self) -> None:
        if self.quarter_turns not in (-1, 0, 1):
            raise ValueError(f"quarter_turns is {self.quarter_turns} but must be -1, 0 or 1")
        size = f"{self.width}x{self.height}"
        if not (self.width > 0 and self.height > 0):
            raise ValueError(f"the image size {size} must be positive")
        if not (0 < self.fx < math.inf and 0 < self.fy < math.inf):
            raise ValueError(f"the focal lengths ({self.fx}, {self.fy}) must be positive")
        if not 0 <= self.baseline < math.inf:
            raise ValueError(
                f"the baseline of {self.baseline} m must not be negative; "
                "it is 0 for a single camera"
            )
        # The principal point of a rectified image may lie outside it, but not far away.
        near = -self.width <= self.cx <= 2 * self.width
        if not (near and -self.height <= self.cy <= 2 * self.height):
            raise ValueError(
                f"the principal point ({self.cx}, {self.cy}) lies far outside the {size} image"
            )

    @property
    def sensor(self) -> Sensor:
        """The kind of camera, as a value of the option ``--sensor``."""
        if self.monocular:
            return "mono"
        return "rgbd" if self.depth else "stereo"

    @property
    def monocular(self) -> bool:
        """Whether there is only a left camera."""
        return self.baseline == 0.0

    def left_camera(self) -> Camera:
        """Return the left camera of this stereo pair or RGB-D camera as a single camera."""
        return replace(self, baseline=0.0, depth=False, right_delay=0.0)

    @property
    def T_mounted_camera(self) -> NDArray[np.float64]:
        """``(4, 4)`` rotation from the frame of the left camera to that of the camera as
        mounted."""
        T, s = np.eye(4), self.quarter_turns
        if s:
            T[:2, :2] = [[0, -s], [s, 0]]
        return T

    def as_mounted(self, T_wc: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``(..., 4, 4)`` poses of the camera as mounted from poses of the left camera."""
        return T_wc @ self.T_mounted_camera.T if self.quarter_turns else T_wc

    @property
    def bf(self) -> float:
        """The baseline times the focal length, in metres times pixels.

        A point at depth z has a disparity of ``bf / z`` pixels.
        """
        return self.baseline * self.fx

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """``(6,)`` float64 ``[fx, fy, cx, cy, bf, disparity_weight]``, the input of kernels."""
        return np.array([self.fx, self.fy, self.cx, self.cy, self.bf, DISPARITY_WEIGHT])

    def project(self, p_c: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project ``(N, 3)`` points in the frame of the left camera into the images.

        Returns:
            ``(N, 3)`` columns u and rows v in the left image, and columns u_right in the right
            image, in pixels.
        """
        x, y, z = p_c.T
        u = self.fx * x / z + self.cx
        return np.stack([u, self.fy * y / z + self.cy, u - self.bf / z], axis=1)

    def backproject(
        self, xy: NDArray[np.floating], depth: NDArray[np.floating]
    ) -> NDArray[np.float64]:
        """Compute the 3D points of pixels with known depths.

        Args:
            xy: ``(N, 2)`` pixels of the left image.
            depth: ``(N,)`` depths in metres.

        Returns:
            ``(N, 3)`` points in the frame of the left camera.
        """
        z = np.asarray(depth, np.float64)
        x = (xy[:, 0] - self.cx) * z / self.fx
        y = (xy[:, 1] - self.cy) * z / self.fy
        return np.stack([x, y, z], axis=1)


def calibration_doubts(camera: Camera) -> list[str]:
    """Return the reasons why a calibration is implausible.

    Each reason is one sentence without a full stop. The list is empty if the calibration is
    plausible. An implausible calibration usually belongs to different images.
    """
    off_centre = principal_point_doubt((camera.cx, camera.cy), (camera.width, camera.height))
    doubts = [off_centre] if off_centre else []
    fields = field_of_view(camera)
    if not all(_NARROWEST <= angle <= _WIDEST for angle in fields):
        doubts.append(
            f"the focal lengths ({camera.fx:.1f}, {camera.fy:.1f}) give a field of view of "
            f"{fields[0]:.0f} x {fields[1]:.0f} degrees; the calibration seems to belong to images "
            "of another size, or its focal lengths are not in pixels"
        )
    return doubts


def principal_point_doubt(principal: tuple[float, float], size: tuple[int, int]) -> str:
    """Return the reason why a principal point is implausible, or an empty string.

    Args:
        principal: column and row of the principal point in pixels.
        size: width and height of the images in pixels.
    """
    (cx, cy), (width, height) = principal, size
    across, down = cx / width, cy / height
    if max(abs(across - 0.5), abs(down - 0.5)) <= _OFF_CENTRE:
        return ""
    return (
        f"the principal point ({cx:.1f}, {cy:.1f}) is far from the middle of the "
        f"{width}x{height} images; {_cause(across, down)}"
    )


def _cause(across: float, down: float) -> str:
    """Guess why a principal point, given in fractions of the image size, is implausible."""
    if min(across, down) <= 0.0 or not 1 / _SAME_RATIO < across / down < _SAME_RATIO:
        return "check the order of its numbers, and whether the images were cropped or turned"
    ratio = across + down  # it is 1 if the principal point is in the middle
    names = [name for factor, name in _FACTORS.items() if abs(ratio / factor - 1.0) < 0.1]
    times = names[0] if names else f"{ratio:.1f} times"
    return f"the calibration seems to belong to images of {times} this size"


def field_of_view(camera: Camera) -> tuple[float, float]:
    """Compute the horizontal and vertical field of view of a camera, in degrees."""
    across, down = (
        2 * math.degrees(math.atan(size / (2 * focal)))
        for size, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
    )
    return across, down


def same_camera(one: Camera, other: Camera) -> bool:
    """Return whether two cameras are equal, apart from rounding errors of calibration files."""
    shapes = [(c.width, c.height, c.depth, c.monocular, c.quarter_turns) for c in (one, other)]
    first, second = ([*c.intrinsics, c.right_delay] for c in (one, other))
    return shapes[0] == shapes[1] and bool(np.allclose(first, second, rtol=1e-6))


Given = TypeVar("Given")
Made = TypeVar("Made")


class ImageMap(Protocol):
    """Applies a function to each image of a frame, like the ``map`` of Python or a thread pool."""

    def __call__(
        self, function: Callable[[Given], Made], images: Iterable[Given], /
    ) -> Iterator[Made]: ...


def check_images(left: Image, second: Image | DepthImage | None, camera: Camera) -> None:
    """Check that the images of a frame match a camera.

    Raises:
        ValueError: the sizes, the types or the number of the images are wrong.
    """
    other = "depth" if camera.depth else "right"
    if left is None:
        raise ValueError("the left image is None; was its file read?")
    if second is None and not camera.monocular:
        raise ValueError(f"the {other} image is None, but the camera is {camera.sensor}")
    if second is not None and camera.monocular:
        raise ValueError("a second image was given, but the camera is monocular: pass None")
    expected = (camera.height, camera.width)
    images = [left] if second is None else [left, second]
    if any(image.shape[:2] == expected and image.ndim == 3 for image in images):
        raise ValueError(
            f"an image is in colour (shape {' and '.join(str(image.shape) for image in images)}), "
            f"but grey images of shape {expected} are expected; convert it with "
            "cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)"
        )
    if any(image.shape != expected for image in images):
        shapes = " and ".join(str(image.shape) for image in images)
        raise ValueError(f"the images have shape {shapes}, but the camera's images have {expected}")
    wanted = [np.uint8, np.float32 if camera.depth else np.uint8]
    if any(image.dtype != dtype for image, dtype in zip(images, wanted, strict=False)):
        types = " and ".join(str(image.dtype) for image in images)
        expected_types = "uint8 and float32" if camera.depth else "uint8"
        how = (
            "convert a depth in millimetres with (depth / 1000).astype(np.float32)"
            if camera.depth and left.dtype == np.uint8
            else "convert grey values of 0 to 255 with image.astype(np.uint8), or those of 0 to 1 "
            "with (255 * image).astype(np.uint8)"
        )
        raise ValueError(f"the images have type {types} instead of {expected_types}; {how}")


def check_mask(mask: NDArray[np.uint8] | NDArray[np.bool_], camera: Camera) -> None:
    """Check that a mask of the left image matches a camera.

    Raises:
        ValueError: the size or type of the mask is wrong.
    """
    if mask.shape != (expected := (camera.height, camera.width)):
        raise ValueError(
            f"the mask has shape {mask.shape}, but the camera's images have {expected}"
        )
    if mask.dtype not in (np.uint8, np.bool_):
        raise ValueError(f"the mask has type {mask.dtype} instead of uint8 or bool; use mask > 0")
