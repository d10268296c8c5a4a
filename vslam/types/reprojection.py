"""Reprojection errors: the layout of observations and the inlier test.

An observation consists of ``u, v, u_right`` in pixels. A keypoint without a stereo match gives a
monocular observation, whose ``u_right`` is NaN.

Kernels that only test for inliers call ``chi_square_ratio``. Optimisers also need the residual.
They call ``residual``, and pass its result to ``chi_square``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel
from vslam.types.geometry import Matrix

# Limits of the squared error of an inlier, divided by its variance. They are the 95 % quantiles of
# chi-square with 2 and 3 degrees of freedom (ORB-SLAM2, III-C).
CHI2_MONO = 5.991
CHI2_STEREO = 7.815


def stack_uvr(xy: NDArray[np.floating], u_right: NDArray[np.floating]) -> Matrix:
    """Combine keypoints and their stereo columns into observations.

    Args:
        xy: ``(N, 2)`` keypoints in the left image.
        u_right: ``(N,)`` columns of the stereo matches in the right image. NaN without a match.

    Returns:
        ``(N, 3)`` float64 ``u, v, u_right``.
    """
    uvr = np.empty((len(xy), 3))
    uvr[:, :2], uvr[:, 2] = xy, u_right
    return uvr


@inner_kernel
def unpacked(intrinsics):
    """Return the array ``Camera.intrinsics`` as a tuple.

    A kernel keeps the values of a tuple in registers, but not the values of an array.
    """
    return (
        intrinsics[0],
        intrinsics[1],
        intrinsics[2],
        intrinsics[3],
        intrinsics[4],
        intrinsics[5],
    )


@inner_kernel
def chi_square_ratio(x, y, z, u, v, u_right, inverse_sigma2, pinhole):
    """Return the squared reprojection error of a point, divided by its chi-square limit.

    The ratio is at most 1 for an inlier. The point must lie in front of the camera.

    Args:
        x, y, z: float64 point in the camera frame.
        u, v, u_right: float64 observation in pixels.
        inverse_sigma2: inverse variance of a pixel coordinate.
        pinhole: intrinsics as ``unpacked`` returns them.
    """
    fx, fy, cx, cy, bf, disparity_weight = pinhole
    chi2 = (u - fx * x / z - cx) ** 2 + (v - fy * y / z - cy) ** 2
    limit = CHI2_MONO
    if not np.isnan(u_right):
        chi2 += (disparity_weight * (u_right - u + bf / z)) ** 2
        limit = CHI2_STEREO
    return chi2 * inverse_sigma2 / limit


@inner_kernel
def residual(x, y, z, u, v, u_right, pinhole):
    """Compute the reprojection errors of a point in u, in v and in the negative disparity.

    Args:
        x, y, z: float64 point in the camera frame.
        u, v, u_right: float64 observation in pixels.
        pinhole: intrinsics as ``unpacked`` returns them.

    Returns:
        The three errors in pixels, and whether the observation is stereo. The error of the
        disparity is multiplied by the disparity weight. It is 0 for a monocular observation.
    """
    fx, fy, cx, cy, bf, disparity_weight = pinhole
    iz = 1.0 / z
    stereo = not np.isnan(u_right)
    r_disparity = disparity_weight * (u_right - u + bf * iz) if stereo else 0.0
    return u - (fx * x * iz + cx), v - (fy * y * iz + cy), r_disparity, stereo


@inner_kernel
def chi_square(r_u, r_v, r_disparity, stereo, inverse_sigma2):
    """Return the squared error of a ``residual`` divided by its variance, and its limit.

    The observation is an inlier if the first number is at most the limit. The Huber loss is linear
    above this limit.
    """
    chi2 = (r_u * r_u + r_v * r_v + r_disparity * r_disparity) * inverse_sigma2
    return chi2, CHI2_STEREO if stereo else CHI2_MONO
