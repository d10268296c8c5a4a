"""Estimates a constant error of all disparities of a stereo pair from the motion of the camera.

Two calibration errors cause such an offset. The rotation between the two cameras may be wrong by
some hundredths of a degree. A principal point may be wrong by a tenth of a pixel. Both errors shift
all disparities by nearly the same amount. Depths are then wrong by a fraction that grows with the
depth.

The offset cannot be determined from a single stereo pair. It can be determined from a moving
camera, because one motion must explain how both near and far points move in the image. Therefore,
the offset becomes an additional unknown of bundle adjustment that is common to all keyframes
(self-calibration: Triggs et al., "Bundle adjustment - a modern synthesis", section 10).

The offset is estimated in disjoint windows of keyframes. The estimates are weighted by their
information (inverse variance) and combined with a prior of mean 0.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.local_mapping import adjust_locally, assemble, map_keyframe
from vslam.config import StereoConfig
from vslam.types.context import Context
from vslam.types.features import shifted_columns
from vslam.types.imu import InertialWindow
from vslam.types.map import Map
from vslam.types.map_kernels import collect_landmarks

# The offset is estimated again after this many keyframes. [own]
_OFFSET_KEYFRAMES = 12

STEP = 0.2  # pixels between the three offsets for which the cost is computed
ITERATIONS = 15
# Variance of the error of the estimate, in multiples of the inverse of its information. It is not
# 1, because the errors of one landmark's observations in several keyframes are correlated
# (docs/research/uncertainty.md).
VARIANCE = 3.0
TOLERANCE = 1e-5  # least relative decrease of the cost; STEP changes it by some thousandths


def map_and_calibrate(
    map_: Map, keyframe: int, context: Context, inertial: InertialWindow | None = None
) -> None:
    """Run local mapping for a new keyframe (``map_keyframe``). For a stereo camera, the disparity
    offset of the map is updated after every ``_OFFSET_KEYFRAMES`` keyframes."""
    map_keyframe(map_, keyframe, context, inertial)
    if context.config.stereo.offset_sigma > 0.0 and context.camera.sensor == "stereo":
        _calibrate(map_, keyframe, context, inertial)


def _calibrate(map_: Map, keyframe: int, context: Context, inertial: InertialWindow | None) -> None:
    config = context.config.stereo
    known, window = map_.scalars, map_.living_keyframes()
    window = window[window > max([known.calibrated_until, *(k - 1 for k in map_.restarts)])]
    if len(window) < _OFFSET_KEYFRAMES:
        return
    map_.scalars = replace(known, calibrated_until=keyframe)
    landmarks = collect_landmarks(map_.arrays, window, map_.n_landmarks)
    problem, _ = assemble(map_, window[1:], window[:1], landmarks, context.camera)
    found, information = remaining_offset(problem)
    if information <= 0.0:
        return
    prior = config.offset_sigma**-2.0
    total = known.offset_information + information
    change = found * information / (prior + total)
    map_.scalars = replace(
        map_.scalars,
        disparity_offset=known.disparity_offset + change,
        offset_information=total,
    )
    a, n = map_.arrays, map_.n_rows
    a.u_right[:n] = shifted_columns(a.u_right[:n], a.xy[:n, 0], change)
    adjust_locally(map_, keyframe, context, inertial)


def offset_sigma(information: float, config: StereoConfig) -> float:
    """Compute the standard deviation of the disparity offset, in pixels, that is caused by the
    noise of the measurements.

    The prior of mean 0 makes the estimated offset smaller than the true offset. The result does not
    include this error.

    Args:
        information: see ``Scalars.offset_information``.
    """
    if information <= 0.0:
        return 0.0
    prior = config.offset_sigma**-2.0 if config.offset_sigma > 0.0 else 0.0
    return float(np.sqrt(VARIANCE * information) / (prior + information))


def remaining_offset(problem: BundleProblem) -> tuple[float, float]:
    """Estimate the offset that must be added to all disparities of a bundle problem. Returns the
    offset, in pixels, and its information (inverse variance). Returns 0, 0 if the problem does not
    determine the offset.

    After bundle adjustment, the cost is nearly quadratic in the offset. Therefore, a parabola is
    fitted to the costs at three offsets.
    """
    first = adjust(problem, iterations=5)
    start = replace(problem, T_cw=first.T_cw, points=first.points)

    def cost(offset: float) -> float:
        uvr = problem.uvr.copy()
        uvr[:, 2] -= offset
        shifted = replace(start, uvr=uvr)
        return adjust(shifted, iterations=ITERATIONS, use=first.inlier, tolerance=TOLERANCE).cost

    below, here, above = cost(-STEP), cost(0.0), cost(STEP)
    bend = below + above - 2.0 * here
    if not bend > 0.0:
        return 0.0, 0.0
    return 0.5 * STEP * (below - above) / bend, bend / STEP**2
