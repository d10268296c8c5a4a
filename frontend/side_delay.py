"""By how much the right side of a stereo pair is late, measured in the rows of its matches.

In a rectified pair a point is in the same row of both images. If the right one is taken later, its
row is moved on by the image's speed times the delay. Columns are moved as well, and bend the map:
there, bundle adjustment takes much of the delay for depth and motion. A row shift does not depend
on depth, so bundle adjustment cannot absorb a delay there, and no map is needed. A rig whose rows
do not correspond, because its calibration is wrong, shows the same shift at every speed; a
polynomial of the position in the image takes that.

The delay is measured and reported, never corrected on the way: it is known only after some seconds,
when the map is bent already. ``Camera.right_delay`` corrects it wherever the motion is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import StereoConfig
from vslam.features import Features, level_pixel
from vslam.frontend.orb import Extraction
from vslam.geometry import Matrix
from vslam.image_motion import rays, row_speeds
from vslam.kernels import inner_kernel, kernel

EVERY = 8  # of that many features one is measured: they are a hundred an image
ROUNDS = 3  # of Gauss-Newton, at most
STILL = 0.05  # pixels; a smaller step ends them
LARGEST = 3.0  # pixels of the feature's level: beyond, it is another thing
HUBER_PX = 0.3
FRAMES_OF_A_GROUP, FEWEST_GROUPS, MOST_GROUPS = 5, 5, 16
_DEGREE = 3  # of the polynomial
_NUISANCES = (_DEGREE + 1) * (_DEGREE + 2) // 2
_SOLUTION, _TWIST = (1 + _NUISANCES,), (6,)
_WAITING, _GROUP = (7 + _NUISANCES, 7 + _NUISANCES), (2 + _NUISANCES, 2 + _NUISANCES)


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
        config.sad_window,
    )


@kernel
def _row_offsets(xy, octave, u_right, pixels_l, pixels_r, offsets, shapes, half):
    found = np.full(len(xy), np.nan, np.float32)
    for i in range(0, len(xy), EVERY):
        if np.isnan(u_right[i]):
            continue
        level = octave[i]
        height, width = shapes[level]
        image_l = pixels_l[offsets[level] : offsets[level] + height * width].reshape(height, width)
        image_r = pixels_r[offsets[level] : offsets[level] + height * width].reshape(height, width)
        wide, high = shapes[0, 1] / width, shapes[0, 0] / height
        x, y = level_pixel(xy[i, 0], wide), level_pixel(xy[i, 1], high)
        moved = (u_right[i] - xy[i, 0]) / wide
        found[i] = _row_shift(image_l, image_r, x, y, moved, half) * high
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
    xx, xy, yy, sum_x, sum_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(-half, half + 1):
        for k in range(-half, half + 1):
            gx = 0.5 * (float(image_l[y + j, x + k + 1]) - float(image_l[y + j, x + k - 1]))
            gy = 0.5 * (float(image_l[y + j + 1, x + k]) - float(image_l[y + j - 1, x + k]))
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
            sum_x, sum_y = sum_x + gx, sum_y + gy
    determinant = xx * yy - xy * xy
    if determinant < 0.05 * xx * yy or determinant < 1.0:
        return np.nan
    dy = 0.0
    for _ in range(ROUNDS):
        x0, y0 = int(np.floor(x + dx)), int(np.floor(y + dy))
        if x0 < half or y0 < half or x0 + half + 1 >= width or y0 + half + 1 >= height:
            return np.nan
        a, b = x + dx - x0, y + dy - y0
        rx, ry, total = 0.0, 0.0, 0.0
        for j in range(-half, half + 1):
            for k in range(-half, half + 1):
                gx = 0.5 * (float(image_l[y + j, x + k + 1]) - float(image_l[y + j, x + k - 1]))
                gy = 0.5 * (float(image_l[y + j + 1, x + k]) - float(image_l[y + j - 1, x + k]))
                here = _between(image_r, x0 + k, y0 + j, a, b) - float(image_l[y + j, x + k])
                rx, ry, total = rx + gx * here, ry + gy * here, total + here
        # One side may be brighter.
        mean = total / (2 * half + 1) ** 2
        rx, ry = rx - mean * sum_x, ry - mean * sum_y
        step_x, step_y = (yy * rx - xy * ry) / determinant, (xx * ry - xy * rx) / determinant
        dx, dy = dx - step_x, dy - step_y
        if abs(dy) > LARGEST:
            return np.nan
        if abs(step_x) + abs(step_y) < STILL:
            break
    return dy


@inner_kernel
def _between(image, x, y, a, b):
    """Bilinear, at ``(x + a, y + b)``."""
    upper = (1.0 - a) * float(image[y, x]) + a * float(image[y, x + 1])
    lower = (1.0 - a) * float(image[y + 1, x]) + a * float(image[y + 1, x + 1])
    return (1.0 - b) * upper + b * lower


@dataclass(frozen=True, eq=False)
class DelayState:
    """What ``SideDelay`` has learned.

    Attributes:
        n_group: frames in the group that is being filled.
        length: frames in a full group.
        solution: ``(1 + P,)`` the delay and the P coefficients of the polynomial, as of the last
            full group.
        twist: ``(6,)`` of the last frame, per second.
        waiting: ``(7 + P, 7 + P)`` sums of the last frame.
        group: ``(2 + P, 2 + P)`` sums of the group that is being filled.
        groups: ``(G, 2 + P, 2 + P)`` sums of the full groups.
    """

    n_group: int
    length: int
    solution: NDArray[np.float64]
    twist: NDArray[np.float64]
    waiting: NDArray[np.float64]
    group: NDArray[np.float64]
    groups: NDArray[np.float64]

    @classmethod
    def nothing(cls) -> DelayState:
        """Before the first frame."""
        return cls(
            n_group=0,
            length=FRAMES_OF_A_GROUP,
            solution=np.zeros(_SOLUTION),
            twist=np.zeros(_TWIST),
            waiting=np.zeros(_WAITING),
            group=np.zeros(_GROUP),
            groups=np.zeros((0, *_GROUP)),
        )

    def numbers(self) -> tuple[float, ...]:
        """The state as a map file keeps it; ``of_numbers`` reads it."""
        arrays = (self.solution, self.twist, self.waiting, self.group, self.groups)
        flat = np.concatenate([array.ravel() for array in arrays])
        return (float(self.n_group), float(self.length), *flat.tolist())

    @classmethod
    def of_numbers(cls, numbers: tuple[float, ...]) -> DelayState:
        """The state that ``numbers`` gave; of no numbers, that before the first frame.

        Raises:
            ValueError: the numbers are no state.
        """
        if not numbers:
            return cls.nothing()
        ends = np.cumsum([np.prod(shape) for shape in (_SOLUTION, _TWIST, _WAITING, _GROUP)])
        values = np.array(numbers[2:])
        if len(values) < ends[-1] or (len(values) - ends[-1]) % np.prod(_GROUP):
            raise ValueError("what it knows of the delay between the sides is damaged")
        solution, twist, waiting, group, groups = np.split(values, ends)
        return cls(
            n_group=int(numbers[0]),
            length=int(numbers[1]),
            solution=solution,
            twist=twist,
            waiting=waiting.reshape(_WAITING),
            group=group.reshape(_GROUP),
            groups=groups.reshape(-1, *_GROUP),
        )


class SideDelay:
    """What all frames so far tell of the delay, by least squares.

    The speed of the image at a frame is that between the frames before and after it: the sums of a
    frame wait for the next one. They can, since a speed is linear in the twist.

    Attributes:
        seconds: by which the right side is late.
        sigma: of that, from how much groups of frames contradict each other (Liang and Zeger,
            Biometrika 1986); infinite until there are enough groups.
    """

    _solution: NDArray[np.float64]
    _twist: NDArray[np.float64]
    _waiting: NDArray[np.float64]
    _group: NDArray[np.float64]
    _groups: list[NDArray[np.float64]]

    def __init__(self, camera: Camera, config: StereoConfig) -> None:
        self._camera, self._config = camera, config
        self.restore(DelayState.nothing())

    @property
    def is_wrong(self) -> bool:
        """Whether the delay differs from that of the calibration (``Camera.right_delay``) by more
        than can be chance."""
        least = max(self._config.least_delay, self._config.delay_sigmas * self.sigma)
        return abs(self.seconds - self._camera.right_delay) > least

    def add(
        self,
        features: Features,
        row_offset: NDArray[np.float32] | None,
        twist: Matrix | None,
        scales: NDArray[np.float64],
    ) -> None:
        """Learn from a tracked frame.

        Args:
            features: N of them.
            row_offset: ``Extracted.row_offset``; without it, there is nothing to learn.
            twist: ``(6,)`` per second, maps points of the camera before to those of this one; None
                if unknown.
            scales: ``(levels,)`` of the pyramid.
        """
        if row_offset is None or twist is None:
            self._waiting[:] = 0.0
            return
        self._take_in(0.5 * (self._twist + twist))
        self._twist = twist
        self._waiting = self._moments(features, row_offset, twist, scales)

    def state(self) -> DelayState:
        """All that was learned."""
        return DelayState(
            self._n_group,
            self._length,
            self._solution.copy(),
            self._twist.copy(),
            self._waiting.copy(),
            self._group.copy(),
            np.array(self._groups).reshape(-1, *_GROUP),
        )

    def restore(self, state: DelayState) -> None:
        """Continue from what ``state`` gave."""
        self.seconds, self.sigma = 0.0, np.inf
        self._n_group, self._length = state.n_group, state.length
        self._solution = state.solution.copy()
        self._twist = state.twist.copy()
        self._waiting = state.waiting.copy()
        self._group = state.group.copy()
        self._groups = list(state.groups.copy())
        self._conclude()

    def _moments(
        self,
        features: Features,
        row_offset: NDArray[np.float32],
        twist: Matrix,
        scales: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Weighted second moments of the derivatives of the speed by the twist, the polynomial and
        the row offsets of a frame. What contradicts the rest weighs little (Huber)."""
        chosen = np.flatnonzero(np.isfinite(row_offset) & np.isfinite(features.u_right))
        xy = features.xy[chosen]
        x, y = rays(xy, self._camera)
        inverse_depth = (xy[:, 0].astype(np.float64) - features.u_right[chosen]) / self._camera.bf
        speeds = self._camera.fy * row_speeds(x, y, inverse_depth)
        powers = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        found = row_offset[chosen].astype(np.float64)
        A = np.column_stack([speeds, *powers, found])
        residual = found - (speeds @ twist) * self._solution[0] - A[:, 6:-1] @ self._solution[1:]
        robust = np.minimum(1.0, HUBER_PX / np.maximum(np.abs(residual), 1e-9))
        weight = robust * scales[features.octave[chosen]] ** -2.0
        moments: NDArray[np.float64] = (A * weight[:, None]).T @ A
        return moments

    def _take_in(self, twist: Matrix) -> None:
        """Add the frame that waits, now that its motion is known from both sides."""
        if not self._waiting.any():
            return
        project = np.zeros((len(self._group), len(self._waiting)))
        project[0, :6] = twist
        project[1:, 6:] = np.eye(1 + _NUISANCES)
        self._group += project @ self._waiting @ project.T
        self._n_group += 1
        if self._n_group == self._length:
            self._groups.append(self._group)
            self._group, self._n_group = np.zeros_like(self._group), 0
            if len(self._groups) == MOST_GROUPS:  # each two become one
                self._groups = [
                    a + b for a, b in zip(self._groups[::2], self._groups[1::2], strict=True)
                ]
                self._length *= 2
            self._conclude()

    def _conclude(self) -> None:
        if len(self._groups) < FEWEST_GROUPS:
            return
        groups = np.stack(self._groups)
        total = groups.sum(axis=0)
        inverse = np.linalg.pinv(total[:-1, :-1], rcond=1e-12, hermitian=True)
        self._solution = inverse @ total[:-1, -1]
        self.seconds = float(self._solution[0])
        pulls = (groups[:, :-1, -1] - groups[:, :-1, :-1] @ self._solution) @ inverse[0]
        n = len(pulls)
        self.sigma = float(np.sqrt(n / (n - 1) * pulls @ pulls))
