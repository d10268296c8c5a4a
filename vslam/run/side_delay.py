"""Measures the delay of the right image of a stereo pair from the rows of stereo matches.

In a rectified pair, a point lies in the same row of both images. If the right image is taken later,
the point moves in the image during the delay. Its row in the right image is then shifted by its
image velocity times the delay. The velocity is known from the left images before and after.

A wrong calibration also shifts the rows, but by the same amount at every speed. It is modelled by a
polynomial of the image position (wrong directions) and by terms that are proportional to the
disparity (wrong positions of the cameras). A delay at constant velocity cannot be distinguished
from such an error. In addition, each frame has a random row shift, because the velocity at the
exposure is not exactly the mean velocity if the camera vibrates.

The measured delay is reported, but it is not corrected during the run, because the map is already
distorted when enough frames have been seen. To correct the delay, set ``Camera.right_delay`` in the
calibration.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import StereoConfig
from vslam.datasets.frames import TimedFrame
from vslam.run.matching import describe, match_described
from vslam.support.errors import UnreadableImageError
from vslam.types.camera import Camera, Image

# The report warns if the measured delay of the right camera differs too much from the delay in
# the calibration. The difference must exceed this value, in seconds, and also `_DELAY_SIGMAS`
# (docs/research/stress.md). [own]
_LEAST_DELAY = 1.2e-3
# The report warns of a delay only if the difference also exceeds this many standard deviations of
# the measured delay. [own]
_DELAY_SIGMAS = 5.0

_FEATURES = 1000
_FEWEST, _MOST = 10, 32  # measured frames
_APART = 5  # frames; measured frames are at least as far apart
FEWEST_FRAMES = _FEWEST * _APART
_LONGEST_S = 1.0  # from the frame before to the frame after; the velocity changes in a longer time
_WINDOW, _LEVELS = (15, 15), 3  # of the optical flow
_SAME_PX = 0.3
_STILL = 5.0  # pixels per second; a tracked point is uncertain by about one
_DEGREE = 3  # degree of the polynomial in the image coordinates
_HUBER_PX, _ROUNDS = 0.3, 10


@dataclass(frozen=True)
class SideDelay:
    """The measured delay of the right image.

    Attributes:
        seconds: the delay in seconds, positive if the right image is taken later than the left
            image.
        sigma: standard deviation of ``seconds``, estimated by leaving out one frame at a time
            (jackknife: Efron and Stein, Annals of Statistics 1981).
    """

    seconds: float
    sigma: float

    def is_wrong(self, camera: Camera, config: StereoConfig) -> bool:
        """Return whether the delay differs significantly from that in the calibration
        (``Camera.right_delay``)."""
        least = max(_LEAST_DELAY, _DELAY_SIGMAS * self.sigma)
        return abs(self.seconds - camera.right_delay) > least

    def description(self) -> str:
        """Tell which camera is late, and by how much."""
        side = "right" if self.seconds > 0 else "left"
        return f"the {side} camera is {1e3 * abs(self.seconds):.1f} ms late"

    def remedy(self) -> str:
        return (
            f"trigger both by one signal, or write right_delay: {self.seconds:.4f} (seconds) into "
            "the file that --calib names"
        )


def measure_delay(frames: Iterable[TimedFrame], n_frames: int) -> SideDelay | None:
    """Measure the delay in frames that are spread over a sequence of ``n_frames`` stereo pairs.

    At most three frames are held at a time. The result is None if there are too few frames or
    matches, or if the camera hardly moves.
    """
    n = min(_MOST, n_frames // _APART)
    if n < _FEWEST:
        return None
    measured = set(np.linspace(1, n_frames - 2, n).round().astype(int).tolist())
    around: deque[TimedFrame] = deque(maxlen=3)
    several = []
    for k, frame in enumerate(islice(frames, n_frames)):
        around.append(frame)
        if k - 1 in measured:
            with suppress(UnreadableImageError):
                several.append(_row_motion(*around))
    return fit_delay(several)


def fit_delay(several: Sequence[NDArray[np.float64]]) -> SideDelay | None:
    """Fit the delay to the row shifts in several frames by least squares (Huber loss).

    Args:
        several: for each frame, ``(N, 5)``: the row of a point in the right image minus its row in
            the left image (px), the velocity of this row (px/s), the position of the point in the
            image, from -1 to 1, and its disparity, relative to the image width.

    Returns:
        None if too few frames have points, or if the points hardly move.
    """
    several = [points for points in several if len(points)]
    n = len(several)
    if n < _FEWEST:
        return None
    frame = np.repeat(np.arange(n), [len(points) for points in several])
    offset, speed, x, y, disparity = np.concatenate(several).T
    if speed.std() < _STILL:
        return None
    powers = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    displaced = [disparity, x * disparity, y * disparity]
    table = np.column_stack([speed, *powers, *displaced, offset])
    weight, removed = np.ones(len(table)), np.zeros(n)
    ends = np.cumsum([len(points) for points in several])[:-1]
    for _ in range(_ROUNDS):
        total = np.bincount(frame, weight)
        means = np.column_stack([np.bincount(frame, weight * one) / total for one in table.T])
        reduced = table - (removed[:, None] * means)[frame]
        weighted = np.split(reduced * np.sqrt(weight)[:, None], ends)
        moments = np.array([one.T @ one for one in weighted])
        solution = _solve(moments.sum(axis=0))
        residual = reduced[:, -1] - reduced[:, :-1] @ solution
        # Random effects: each frame has a row shift of its own, with a variance that is estimated.
        own = means[:, -1] - means[:, :-1] @ solution
        rest = table[:, -1] - table[:, :-1] @ solution - own[frame]
        noise = np.average(rest**2, weights=weight) + 1e-12
        variance = max(np.mean(own**2) - noise * np.mean(1.0 / total), 0.0)
        removed = 1.0 - np.sqrt(noise / (noise + total * variance))
        weight = np.minimum(1.0, _HUBER_PX / np.maximum(np.abs(residual), 1e-9))
    without = np.array([_solve(moments.sum(axis=0) - one)[0] for one in moments])
    return SideDelay(float(solution[0]), float(np.sqrt(n - 1) * without.std()))


def _solve(moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve a linear least-squares problem, given the second moments of its variables, of which the
    last one is the measurement."""
    inverse = np.linalg.pinv(moments[:-1, :-1], rcond=1e-12, hermitian=True)
    solution: NDArray[np.float64] = inverse @ moments[:-1, -1]
    return solution


def _row_motion(before: TimedFrame, frame: TimedFrame, after: TimedFrame) -> NDArray[np.float64]:
    """Match a left image with its right image, and track the points to the left images before and
    after it.

    Returns:
        ``(N, 5)`` the points, see ``fit_delay``.
    """
    elapsed = after.timestamp - before.timestamp
    left, right = frame.read(map)
    if right is None or elapsed > _LONGEST_S:
        return np.zeros((0, 5))
    right = np.asarray(right, np.uint8)
    matches = match_described(describe(left, _FEATURES), describe(right, _FEATURES))
    if not len(matches):
        return np.zeros((0, 5))
    earlier, later = (_track(left, _left(other), matches.left) for other in (before, after))
    shift = matches.right - matches.left
    position = 2.0 * matches.left / left.shape[::-1] - 1.0
    speed = (later - earlier)[:, 1] / elapsed
    found = np.column_stack([shift[:, 1], speed, position, -shift[:, 0] / left.shape[1]])
    return found[np.isfinite(found).all(axis=1)]


def _track(image: Image, other: Image, xy: NDArray[np.float32]) -> NDArray[np.float32]:
    """Find ``(N, 2)`` points in another image by optical flow; NaN if the way back leads to another
    point."""
    flow = partial(cv2.calcOpticalFlowPyrLK, winSize=_WINDOW, maxLevel=_LEVELS)
    there, _, _ = flow(image, other, xy, xy.copy())
    back, seen, _ = flow(other, image, there, there.copy())
    same = (seen.ravel() == 1) & (np.linalg.norm(back - xy, axis=1) < _SAME_PX)
    return np.where(same[:, None], there, np.float32(np.nan))


def _left(frame: TimedFrame) -> Image:
    return frame.read(map)[0] if frame.sides is None else frame.sides[0]()


def delay_warnings(found: SideDelay | None, camera: Camera, config: StereoConfig) -> list[str]:
    """Return a warning if the measured delay of the right camera is not the calibrated delay."""
    if found is None or not found.is_wrong(camera, config):
        return []
    known = camera.right_delay
    instead = f" instead of {1e3 * known:.1f} ms (right_delay)" if known else ""
    remedy = found.remedy()
    return [
        "The cameras are not synchronised: the rows of stereo matches show that "
        f"{found.description()}{instead}. {remedy[0].upper()}{remedy[1:]} and run again; see "
        "docs/howto/cameras.md."
    ]
