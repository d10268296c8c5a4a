"""By how much the right side of a stereo pair is late, measured in the rows of its matches.

In a rectified pair a point is in the same row of both images. If the right one is taken later, its
row is moved on by the image's speed times the delay. Columns are moved as well, and bend the map:
there, bundle adjustment takes much of the delay for depth and motion. Rows say nothing of depth, so
that nothing can hide in them, and no map is asked. A rig whose rows do not correspond, as one
calibrated badly, shows the same at every speed: a polynomial of the position takes that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import StereoConfig
from vslam.features import MIN_DISPARITY, Features
from vslam.frontend.orb import Extraction
from vslam.geometry import Matrix
from vslam.kernels import inner_kernel, kernel

EVERY = 8  # of that many features one is measured: they are a hundred an image
ROUNDS = 3  # of Gauss-Newton
LARGEST = 3.0  # pixels of the feature's level: beyond, it is another thing
HUBER_PX = 0.3
_UNKNOWNS = 7  # the delay, and a polynomial of second order in the position


def row_offsets(
    left: Extraction, right: Extraction, u_right: NDArray[np.float32], config: StereoConfig
) -> NDArray[np.float32]:
    """By how many pixels stereo matches are lower in the right image than in the left one:
    ``(N,)`` float32, of some of them; NaN of all other features."""
    pyramid = left.pyramid
    return _row_offsets(
        left.xy,
        left.octave,
        u_right,
        pyramid.pixels,
        right.pyramid.pixels,
        pyramid.offsets,
        pyramid.shapes,
        pyramid.scales,
        config.sad_window,
    )


@kernel
def _row_offsets(xy, octave, u_right, pixels_l, pixels_r, offsets, shapes, scales, half):
    found = np.full(len(xy), np.nan, np.float32)
    for i in range(0, len(xy), EVERY):
        if np.isnan(u_right[i]):
            continue
        level = octave[i]
        height, width = shapes[level]
        image_l = pixels_l[offsets[level] : offsets[level] + height * width].reshape(height, width)
        image_r = pixels_r[offsets[level] : offsets[level] + height * width].reshape(height, width)
        x, y = int(np.rint(xy[i, 0] / scales[level])), int(np.rint(xy[i, 1] / scales[level]))
        moved = (u_right[i] - xy[i, 0]) / scales[level]
        found[i] = _row_shift(image_l, image_r, x, y, moved, half) * scales[level]
    return found


@inner_kernel
def _row_shift(image_l, image_r, x, y, dx, half):
    """Rows by which the patch around ``(x, y)`` is lower in the right image, NaN where it does not
    tell; ``dx`` columns to the right of it is where to begin.

    The inverse compositional form of Lucas and Kanade's method (Baker and Matthews, IJCV 2004): the
    gradients are those of the left patch.
    """
    height, width = image_l.shape
    edge = half + 1
    if x < edge or y < edge or x + edge >= width or y + edge >= height:
        return np.nan
    xx, xy, yy = 0.0, 0.0, 0.0
    for j in range(-half, half + 1):
        for k in range(-half, half + 1):
            gx = 0.5 * (float(image_l[y + j, x + k + 1]) - float(image_l[y + j, x + k - 1]))
            gy = 0.5 * (float(image_l[y + j + 1, x + k]) - float(image_l[y + j - 1, x + k]))
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
    determinant = xx * yy - xy * xy
    if determinant < 0.05 * xx * yy or determinant < 1.0:
        return np.nan
    dy = 0.0
    for _ in range(ROUNDS):
        x0, y0 = int(np.floor(x + dx)), int(np.floor(y + dy))
        if x0 < half or y0 < half or x0 + half + 1 >= width or y0 + half + 1 >= height:
            return np.nan
        a, b = x + dx - x0, y + dy - y0
        mean = 0.0
        for j in range(-half, half + 1):
            for k in range(-half, half + 1):
                mean += _between(image_r, x0 + k, y0 + j, a, b) - float(image_l[y + j, x + k])
        mean /= (2 * half + 1) ** 2
        rx, ry = 0.0, 0.0
        for j in range(-half, half + 1):
            for k in range(-half, half + 1):
                gx = 0.5 * (float(image_l[y + j, x + k + 1]) - float(image_l[y + j, x + k - 1]))
                gy = 0.5 * (float(image_l[y + j + 1, x + k]) - float(image_l[y + j - 1, x + k]))
                here = _between(image_r, x0 + k, y0 + j, a, b) - float(image_l[y + j, x + k])
                rx += gx * (here - mean)
                ry += gy * (here - mean)
        dx -= (yy * rx - xy * ry) / determinant
        dy -= (xx * ry - xy * rx) / determinant
        if abs(dy) > LARGEST:
            return np.nan
    return dy


@inner_kernel
def _between(image, x, y, a, b):
    """Bilinear, at ``(x + a, y + b)``."""
    upper = (1.0 - a) * float(image[y, x]) + a * float(image[y, x + 1])
    lower = (1.0 - a) * float(image[y + 1, x]) + a * float(image[y + 1, x + 1])
    return (1.0 - b) * upper + b * lower


class SideDelay:
    """What all frames so far tell of the delay.

    Attributes:
        seconds: by which the right side is late.
        sigma: of that; infinite as long as nothing tells.
    """

    def __init__(self, camera: Camera, config: StereoConfig) -> None:
        self.seconds, self.sigma = 0.0, np.inf
        self._camera, self._config = camera, config
        self._normal = np.zeros((_UNKNOWNS, _UNKNOWNS))
        self._right = np.zeros(_UNKNOWNS)
        self._squares, self._weight, self._frames = 0.0, 0.0, 0

    @property
    def known(self) -> float:
        """``seconds`` where they are beyond doubt, else 0."""
        config = self._config
        least = max(config.least_delay, config.delay_sigmas * self.sigma)
        sure = self._frames >= config.delay_frames and abs(self.seconds) > least
        return self.seconds if sure else 0.0

    def add(self, features: Features, twist: Matrix, scales: NDArray[np.float64]) -> None:
        """Learn from a tracked frame, whose camera moved by ``twist`` per second: it maps points
        of the camera before to those of the camera then."""
        offsets = features.row_offset
        if offsets is None or self._camera.sensor != "stereo":
            return
        chosen = np.flatnonzero(np.isfinite(offsets) & np.isfinite(features.u_right))
        if len(chosen) < _UNKNOWNS:
            return
        ray = _rays(features.xy[chosen], self._camera)
        disparity = features.xy[chosen, 0].astype(np.float64) - features.u_right[chosen]
        speed = self._camera.fy * _speed(ray, disparity, twist, self._camera, axis=1)
        x, y = ray[:, 0], ray[:, 1]
        A = np.stack([speed, np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        found = offsets[chosen].astype(np.float64)
        residual = found - A @ self._solution()
        scale = scales[features.octave[chosen]]
        weight = scale**-2.0 * np.minimum(1.0, HUBER_PX / np.maximum(np.abs(residual), 1e-9))
        weighted = A * weight[:, None]
        self._normal += weighted.T @ A
        self._right += weighted.T @ found
        self._squares += float(weight @ residual**2)
        self._weight += float(weight.sum())
        self._frames += 1
        self._conclude()

    def corrected(self, features: Features, twist: Matrix | None) -> Features:
        """Features with columns in the right image as they were when the left one was taken."""
        delay = self.known
        if delay == 0.0 or twist is None:
            return features
        ray = _rays(features.xy, self._camera)
        seen = features.xy[:, 0].astype(np.float64) - features.u_right
        disparity = seen
        for _ in range(3):  # depth depends on the disparity, and the speed on depth
            disparity = np.maximum(disparity, MIN_DISPARITY)
            speed = self._camera.fx * _speed(ray, disparity, twist, self._camera, axis=0)
            disparity = seen + delay * speed
        return features.with_larger_disparities(disparity - seen)

    def memory(self) -> tuple[float, ...]:
        """All that was learned."""
        sums = (self._squares, self._weight, float(self._frames))
        return (*sums, *self._right.tolist(), *self._normal.ravel().tolist())

    def restore(self, memory: tuple[float, ...]) -> None:
        """Go on from there; from nothing if that is empty.

        Raises:
            ValueError: it is none.
        """
        if not memory:
            return
        (self._squares, self._weight, frames), rest = memory[:3], np.array(memory[3:])
        self._frames = int(frames)
        self._right = rest[:_UNKNOWNS]
        self._normal = rest[_UNKNOWNS:].reshape(_UNKNOWNS, _UNKNOWNS)
        self._conclude()

    def _conclude(self) -> None:
        if not self._frames:
            return
        self.seconds = float(self._solution()[0])
        variance = self._squares / self._weight
        self.sigma = float(np.sqrt(variance * np.linalg.pinv(self._normal, hermitian=True)[0, 0]))

    def _solution(self) -> NDArray[np.float64]:
        return np.linalg.lstsq(self._normal, self._right, rcond=1e-12)[0]


def _rays(xy: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """``(N, 3)`` points in the left camera at depth 1."""
    xy = xy.astype(np.float64)
    x, y = (xy[:, 0] - camera.cx) / camera.fx, (xy[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=1)


def _speed(
    ray: NDArray[np.float64],
    disparity: NDArray[np.float64],
    twist: Matrix,
    camera: Camera,
    axis: int,
) -> NDArray[np.float64]:
    """``(N,)`` speed in the right image of points at a disparity, in focal lengths a second."""
    inverse_depth = disparity / camera.bf
    moved = twist[:3] * inverse_depth[:, None] + np.cross(twist[3:], ray)
    where = ray[:, axis] - (camera.baseline * inverse_depth if axis == 0 else 0.0)
    return moved[:, axis] - where * moved[:, 2]
