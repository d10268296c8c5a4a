"""Measures the delay of the right image of a stereo pair from the rows of stereo matches.

In a rectified pair, a point lies in the same row of both images. If the right image is taken later,
the point moves in the image during the delay. Its row in the right image is then shifted by its
image velocity times the delay.

The column of the point is shifted as well. This distorts the map, because bundle adjustment
explains much of a column shift by depth and motion. A row shift does not depend on depth, so bundle
adjustment cannot absorb it. Therefore, the delay is measured from the row shifts, and no map is
needed.

A wrong calibration also shifts the rows, but by the same amount at every speed. A polynomial of the
image position models this part of the row shift.

The measured delay is reported, but it is not corrected during the run. The reason is that the delay
is known only after some seconds, when the map is already distorted. To correct the delay, set
``Camera.right_delay`` in the calibration. The delay is then corrected in every frame whose motion
is known.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import StereoConfig
from vslam.features import Features, level_of, level_pixel
from vslam.frontend.orb import Extraction
from vslam.geometry import Matrix
from vslam.image_motion import rays, row_speeds
from vslam.kernels import inner_kernel, kernel

EVERY = 8  # every 8th feature is measured, about a hundred per image
ROUNDS = 3  # maximum number of Gauss-Newton steps
STILL = 0.05  # pixels; the iteration ends when a step is smaller
LARGEST = 3.0  # pixels of the feature's level; a match with a larger row shift is wrong
HUBER_PX = 0.3
FRAMES_OF_A_GROUP, FEWEST_GROUPS, MOST_GROUPS = 5, 5, 16
_DEGREE = 3  # degree of the polynomial in the image coordinates
_P = (_DEGREE + 1) * (_DEGREE + 2) // 2  # number of coefficients of this polynomial
# Shapes of the arrays of ``DelayState``.
_SOLUTION, _TWIST, _WAITING, _GROUP = (1 + _P,), (6,), (7 + _P, 7 + _P), (2 + _P, 2 + _P)


def row_offsets(
    left: Extraction, right: Extraction, u_right: NDArray[np.float32], config: StereoConfig
) -> NDArray[np.float32]:
    """Measure the row of features in the right image minus their row in the left image, in
    full-resolution pixels. Only a subset of the features is measured.

    Args:
        u_right: ``(N,)`` columns of the left features in the right image, NaN without a match.

    Returns:
        ``(N,)`` float32, NaN for features that were not measured.
    """
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
        image_l = level_of(pixels_l, offsets, shapes, level)
        image_r = level_of(pixels_r, offsets, shapes, level)
        ratio_x, ratio_y = shapes[0, 1] / width, shapes[0, 0] / height
        x, y = level_pixel(xy[i, 0], ratio_x), level_pixel(xy[i, 1], ratio_y)
        dx = (u_right[i] - xy[i, 0]) / ratio_x
        found[i] = _row_shift(image_l, image_r, x, y, dx, half) * ratio_y
    return found


@inner_kernel
def _row_shift(image_l, image_r, x, y, dx, half):
    """Measure the vertical shift of the patch around ``(x, y)`` from the left to the right image,
    in pixels of the pyramid level. The search starts at the horizontal shift ``dx``.

    The result is NaN if the patch has too little texture or is not found. The method is inverse
    compositional Lucas-Kanade (Baker and Matthews, IJCV 2004).
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
                r = _interpolated(image_r, x0 + k, y0 + j, a, b) - float(image_l[y + j, x + k])
                rx, ry, total = rx + gx * r, ry + gy * r, total + r
        # The mean difference is subtracted, because the brightness of the two images may differ.
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
def _interpolated(image, x, y, a, b):
    upper = (1.0 - a) * float(image[y, x]) + a * float(image[y, x + 1])
    lower = (1.0 - a) * float(image[y + 1, x]) + a * float(image[y + 1, x + 1])
    return (1.0 - b) * upper + b * lower


@dataclass(eq=False)
class DelayState:
    """The state of ``SideDelay``. "Moments" are weighted second moments of the variables of a
    regression; see ``SideDelay._moments``.

    Attributes:
        n_group: number of frames in the group that is being filled.
        length: number of frames in a full group.
        solution: ``(1 + P,)`` the delay in seconds, followed by the P coefficients of the
            polynomial that models a wrong calibration. It is estimated whenever a group becomes
            full.
        twist: ``(6,)`` velocity of the camera before the last frame, see ``Frame.twist``.
        waiting: ``(7 + P, 7 + P)`` moments of the last frame, which has not been added to a group
            yet.
        group: ``(2 + P, 2 + P)`` moments of the group that is being filled.
        groups: ``(G, 2 + P, 2 + P)`` moments of the full groups.
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
        """Return the state before the first frame."""
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
        """Convert the state to numbers for a map file. ``of_numbers`` is the inverse."""
        arrays = (self.solution, self.twist, self.waiting, self.group, self.groups)
        flat = np.concatenate([array.ravel() for array in arrays])
        return (float(self.n_group), float(self.length), *flat.tolist())

    @classmethod
    def of_numbers(cls, numbers: tuple[float, ...]) -> DelayState:
        """Create a state from the result of ``numbers``. An empty tuple gives the state before the
        first frame.

        Raises:
            ValueError: ``numbers`` does not have the length of a state.
        """
        if not numbers:
            return cls.nothing()
        ends = np.cumsum([np.prod(shape) for shape in (_SOLUTION, _TWIST, _WAITING, _GROUP)])
        values = np.array(numbers[2:])
        if len(values) < ends[-1] or (len(values) - ends[-1]) % np.prod(_GROUP):
            raise ValueError("the stored measurement of the right image's delay is damaged")
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
    """Estimates the delay of the right image by least squares from all frames processed so far.

    The velocity at a frame is the mean of the velocities before and after the frame. A frame is
    therefore added only when the next frame is tracked. Until then, the second moments of its
    measurements are kept. The velocity can be applied to these moments later, because image
    velocities are linear in the twist of the camera.

    Attributes:
        seconds: the delay in seconds, positive if the right image is taken later than the left
            image.
        sigma: standard deviation of ``seconds``, estimated from the disagreement between groups of
            frames (cluster-robust: Liang and Zeger, Biometrika 1986). It is infinite until there
            are enough groups.
    """

    def __init__(self, camera: Camera, config: StereoConfig) -> None:
        self._camera, self._config = camera, config
        self.restore(DelayState.nothing())

    @property
    def is_wrong(self) -> bool:
        """Whether the measured delay differs significantly from the delay in the calibration
        (``Camera.right_delay``)."""
        least = max(self._config.least_delay, self._config.delay_sigmas * self.sigma)
        return abs(self.seconds - self._camera.right_delay) > least

    def add(
        self,
        features: Features,
        row_offset: NDArray[np.float32] | None,
        twist: Matrix | None,
        scales: NDArray[np.float64],
    ) -> None:
        """Add a tracked frame. If its velocity is unknown, it is skipped, and so is the frame
        before it.

        Args:
            row_offset: ``Extracted.row_offset``; None adds only the velocity.
            twist: ``(6,)`` mean velocity since the previous frame, see ``Frame.twist``.
            scales: ``(levels,)`` pyramid scale factors.
        """
        state = self._state
        if twist is not None:
            self._add_waiting(0.5 * (state.twist + twist))
            state.twist = twist
        state.waiting = np.zeros(_WAITING)
        if row_offset is not None and twist is not None:
            state.waiting = self._moments(features, row_offset, twist, scales)

    def state(self) -> DelayState:
        """Return the state for a map file or a checkpoint."""
        return deepcopy(self._state)

    def restore(self, state: DelayState) -> None:
        self.seconds, self.sigma = 0.0, np.inf
        self._state = deepcopy(state)
        self._estimate()

    def _moments(
        self,
        features: Features,
        row_offset: NDArray[np.float32],
        twist: Matrix,
        scales: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Compute the ``(7 + P, 7 + P)`` weighted second moments of the regression variables in one
        frame.

        The variables are the six derivatives of the row velocity with respect to the twist, the P
        terms of the polynomial, and the row offset. Outliers are down-weighted (Huber).
        """
        chosen = np.flatnonzero(np.isfinite(row_offset) & np.isfinite(features.u_right))
        xy = features.xy[chosen]
        x, y = rays(xy, self._camera)
        inverse_depth = (xy[:, 0].astype(np.float64) - features.u_right[chosen]) / self._camera.bf
        speeds = self._camera.fy * row_speeds(x, y, inverse_depth)
        powers = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        offset = row_offset[chosen].astype(np.float64)
        A = np.column_stack([speeds, *powers, offset])
        solution = self._state.solution
        residual = offset - (speeds @ twist) * solution[0] - A[:, 6:-1] @ solution[1:]
        robust = np.minimum(1.0, HUBER_PX / np.maximum(np.abs(residual), 1e-9))
        weight = robust * scales[features.octave[chosen]] ** -2.0
        moments: NDArray[np.float64] = (A * weight[:, None]).T @ A
        return moments

    def _add_waiting(self, twist: Matrix) -> None:
        """Add the moments of the last frame to the current group of frames. ``twist`` is the
        velocity of the camera at that frame."""
        state = self._state
        if not state.waiting.any():
            return
        project = np.zeros((len(state.group), len(state.waiting)))
        project[0, :6] = twist
        project[1:, 6:] = np.eye(1 + _P)
        state.group += project @ state.waiting @ project.T
        state.n_group += 1
        if state.n_group == state.length:
            state.groups = np.concatenate([state.groups, state.group[None]])
            state.group, state.n_group = np.zeros_like(state.group), 0
            if len(state.groups) == MOST_GROUPS:  # merge neighbours in pairs
                state.groups = state.groups[::2] + state.groups[1::2]
                state.length *= 2
            self._estimate()

    def _estimate(self) -> None:
        groups = self._state.groups
        if len(groups) < FEWEST_GROUPS:
            return
        total = groups.sum(axis=0)
        inverse = np.linalg.pinv(total[:-1, :-1], rcond=1e-12, hermitian=True)
        self._state.solution = solution = inverse @ total[:-1, -1]
        self.seconds = float(solution[0])
        influence = (groups[:, :-1, -1] - groups[:, :-1, :-1] @ solution) @ inverse[0]
        n = len(influence)
        self.sigma = float(np.sqrt(n / (n - 1) * influence @ influence))
