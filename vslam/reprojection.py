"""Reprojection errors: how observations are laid out, and the one test that tells inliers.

An observation is a row ``u, v, u_right`` in pixels; ``u_right`` is NaN without a stereo match, and
every kernel decides monocular or stereo by that alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.geometry import Matrix
from vslam.kernels import inner_kernel

# 95 % quantiles of chi-square with 2 and 3 degrees of freedom: the largest squared error, in
# variances, of an inlier seen by one camera (u, v) or by both (u, v, u_right). ORB-SLAM2, III-C.
CHI2_MONO = 5.991
CHI2_STEREO = 7.815


def stack_uvr(xy: NDArray[np.floating], u_right: NDArray[np.floating]) -> Matrix:
    """``(N, 3)`` float64 observations of ``(N, 2)`` keypoints and their ``(N,)`` stereo columns."""
    uvr = np.empty((len(xy), 3))
    uvr[:, :2], uvr[:, 2] = xy, u_right
    return uvr


@inner_kernel
def chi_square_ratio(x, y, z, uvr, inverse_sigma2, intrinsics):
    """Squared reprojection error of a point in the camera over its chi-square limit: at most 1 for
    an inlier. The point must lie in front of the camera.

    Args:
        uvr: ``(3,)`` observation; inverse_sigma2: inverse variance of a pixel coordinate.
        intrinsics: ``(5,)`` fx, fy, cx, cy, bf.
    """
    fx, fy, cx, cy, bf = intrinsics
    u = fx * x / z + cx
    chi2 = (uvr[0] - u) ** 2 + (uvr[1] - fy * y / z - cy) ** 2
    limit = CHI2_MONO
    if not np.isnan(uvr[2]):
        chi2 += (uvr[2] - u + bf / z) ** 2
        limit = CHI2_STEREO
    return chi2 * inverse_sigma2 / limit


@inner_kernel
def residual(x, y, z, uvr, intrinsics, r):
    """Reprojection error of a point in the camera into ``r`` (3,), 0 for a missing u_right;
    returns whether the observation is stereo."""
    fx, fy, cx, cy, bf = intrinsics
    iz = 1.0 / z
    u = fx * x * iz + cx
    r[0] = uvr[0] - u
    r[1] = uvr[1] - (fy * y * iz + cy)
    stereo = not np.isnan(uvr[2])
    r[2] = uvr[2] - (u - bf * iz) if stereo else 0.0
    return stereo


@inner_kernel
def chi_square(r, stereo, inverse_sigma2):
    """Squared error of a ``residual`` in variances, and the limit of an inlier, which is where the
    Huber loss becomes linear, too."""
    chi2 = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) * inverse_sigma2
    return chi2, CHI2_STEREO if stereo else CHI2_MONO
