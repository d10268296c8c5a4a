"""Estimates a constant error of all disparities of a stereo pair from the motion of the camera.

Two calibration errors cause such an offset. The rotation between the two cameras may be wrong by
some hundredths of a degree. A principal point may be wrong by a tenth of a pixel. Both errors shift
all disparities by nearly the same amount. Depths are then wrong by a fraction that grows with the
depth.

The offset cannot be determined from a single stereo pair. It can be determined from a moving
camera, because one motion must explain how both near and far points move in the image. Therefore,
the offset becomes an additional unknown of bundle adjustment that is common to all keyframes
(self-calibration: Triggs et al., "Bundle adjustment - a modern synthesis", section 10).

The offset is estimated in disjoint windows of keyframes, whose estimates are weighted by their
information (inverse variance). A patch across the edge of an object takes over the larger disparity
of the object, so the errors of small disparities are skewed. The estimate therefore uses only the
disparities that agree best with the motion.

To correct an offset that is not there makes the map as wrong as not to correct one that is.
Therefore, the prior gives a probability to no offset, and else a normal distribution (Mitchell and
Beauchamp, "Bayesian variable selection in linear regression", 1988). The posterior mean is added to
the disparities.
"""

from __future__ import annotations

from dataclasses import replace
from math import exp, sqrt

import numpy as np

from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.local_mapping import adjust_locally, assemble, refine_map
from vslam.config import StereoConfig
from vslam.types.context import Context
from vslam.types.features import shifted_columns
from vslam.types.imu import InertialWindow
from vslam.types.map import Map, Scalars
from vslam.types.map_kernels import collect_landmarks

# The offset is estimated again after this many keyframes. [own]
_OFFSET_KEYFRAMES = 12

# Prior probability of an offset. Real pairs mostly have one, rendered ones have none. With 0.5,
# half of the offset of KITTI 06 is used. With 1, short drives without an offset become 1.2 times as
# wrong (docs/research/motorway.md). [own]
PROBABILITY = 0.75
TRIM = 2.0  # standard deviations about the median, within which disparities are used
DEVIATION_OF_MEDIAN = 1.4826  # normal standard deviations per median deviation
STEP = 0.2  # pixels between the three offsets for which the cost is computed
ITERATIONS = 15
# Variance of the error of the estimate, in multiples of the inverse of its information. It is not
# 1, because the errors of one landmark's observations in several keyframes are correlated
# (docs/research/uncertainty.md).
VARIANCE = 3.0
TOLERANCE = 1e-5  # least relative decrease of the cost; STEP changes it by some thousandths


def refine_and_calibrate(
    map_: Map, keyframe: int, context: Context, inertial: InertialWindow | None = None
) -> None:
    """Adjust the map around a new keyframe (``refine_map``). For a stereo camera, the disparity
    offset of the map is updated after every ``_OFFSET_KEYFRAMES`` keyframes."""
    refine_map(map_, keyframe, context, inertial)
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
    map_.scalars = found_offset(map_.scalars, known.disparity_offset + found, information, config)
    a, n = map_.arrays, map_.n_rows
    change = map_.scalars.disparity_offset - known.disparity_offset
    a.u_right[:n] = shifted_columns(a.u_right[:n], a.xy[:n, 0], change)
    adjust_locally(map_, keyframe, context, inertial)


def found_offset(known: Scalars, found: float, information: float, config: StereoConfig) -> Scalars:
    """Add the estimate of one window to what is known of the disparity offset.

    Args:
        found: the offset of all measured disparities in the window, in pixels.
        information: see ``remaining_offset``.
    """
    n, total = known.offset_windows + 1, known.offset_information + information
    step = found - known.offset_mean
    mean = known.offset_mean + step * information / total
    scatter = known.offset_scatter + step**2 * known.offset_information * information / total
    # Windows that differ by more than their information says have errors of their own (Birge, "The
    # calculation of errors by the method of least squares", 1932).
    variance = max(VARIANCE, (VARIANCE + scatter) / n) / total
    offset, sigma = posterior_offset(mean, variance, config.offset_sigma**2)
    return replace(
        known,
        disparity_offset=offset,
        offset_sigma=sigma,
        offset_mean=mean,
        offset_information=total,
        offset_scatter=scatter,
        offset_windows=n,
    )


def posterior_offset(mean: float, variance: float, prior: float) -> tuple[float, float]:
    """Compute the posterior mean and the standard deviation of the offset. A priori, there is an
    offset with the probability ``PROBABILITY``, and it is normally distributed with mean 0.

    Args:
        mean, variance: of the estimate, in pixels and squared pixels.
        prior: variance of an offset that is not zero, in squared pixels.
    """
    share = prior / (prior + variance)
    ratio = sqrt(1.0 - share) * exp(min(0.5 * share * mean**2 / variance, 100.0))
    odds = PROBABILITY / (1.0 - PROBABILITY) * ratio
    probability = odds / (1.0 + odds)
    offset = probability * share * mean
    second_moment = probability * (share * variance + (share * mean) ** 2)
    return offset, sqrt(max(second_moment - offset**2, 0.0))


def remaining_offset(problem: BundleProblem) -> tuple[float, float]:
    """Estimate the offset that must be added to all disparities of a bundle problem. Returns the
    offset, in pixels, and its information (inverse variance). Returns 0, 0 if the problem does not
    determine the offset.

    After bundle adjustment, the cost is nearly quadratic in the offset. Therefore, a parabola is
    fitted to the costs at three offsets.
    """
    first = adjust(problem, iterations=5)
    start = trimmed(replace(problem, T_cw=first.T_cw, points=first.points))

    def cost(offset: float) -> float:
        uvr = start.uvr.copy()
        uvr[:, 2] -= offset
        shifted = replace(start, uvr=uvr)
        return adjust(shifted, iterations=ITERATIONS, use=first.inlier, tolerance=TOLERANCE).cost

    below, here, above = cost(-STEP), cost(0.0), cost(STEP)
    bend = below + above - 2.0 * here
    if not bend > 0.0:
        return 0.0, 0.0
    return 0.5 * STEP * (below - above) / bend, bend / STEP**2


def trimmed(problem: BundleProblem) -> BundleProblem:
    """Return the problem without the disparities whose residuals differ by more than ``TRIM``
    standard deviations from the median. These observations become monocular."""
    landmark = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    T_cw = problem.T_cw[problem.camera]
    z = np.einsum("nj,nj->n", T_cw[:, 2, :3], problem.points[landmark]) + T_cw[:, 2, 3]
    bf = problem.intrinsics[4]
    with np.errstate(divide="ignore"):
        residual = problem.uvr[:, 0] - problem.uvr[:, 2] - bf / z
    residual *= np.sqrt(problem.inverse_sigma2)
    stereo = np.isfinite(residual)
    if not stereo.any():
        return problem
    apart = np.abs(residual - np.median(residual[stereo]))
    sigma = DEVIATION_OF_MEDIAN * np.median(apart[stereo])
    uvr = problem.uvr.copy()
    uvr[apart > TRIM * sigma, 2] = np.nan
    return replace(problem, uvr=uvr)
