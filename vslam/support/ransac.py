"""Random generator and stopping rule of the RANSAC kernels (Fischler and Bolles, CACM 1981).

Each kernel owns the state of its generator. Therefore, the same seed always gives the same result,
regardless of the random numbers that other threads draw.
"""

from __future__ import annotations

import numpy as np

from vslam.support.kernels import kernel

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S33 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(33)


@kernel
def random_index(state, n):
    """Return a random integer in ``[0, n)``, using SplitMix64 (Steele et al. 2014).

    ``state`` is the ``(1,)`` uint64 state of the generator, which is updated.
    """
    state[0] += _STEP
    z = state[0]
    z = (z ^ (z >> _S30)) * _MIX_A
    z = (z ^ (z >> _S27)) * _MIX_B
    z = z ^ (z >> _S31)
    # 31 random bits are multiplied by n. The bias is below n / 2^31, and int64 cannot overflow.
    return (np.int64(z >> _S33) * n) >> 31


@kernel
def draw_three(state, n):
    """Return three different random integers in ``[0, n)``. ``n`` must be at least 3."""
    i = random_index(state, n)
    j = random_index(state, n - 1)
    k = random_index(state, n - 2)
    if j >= i:
        j += 1
    low, high = min(i, j), max(i, j)
    if k >= low:
        k += 1
    if k >= high:
        k += 1
    return i, j, k


@kernel
def draws_needed(inlier_share, confidence, limit):
    """Return the number of random samples that RANSAC needs.

    Each sample consists of three items. With probability ``confidence``, at least one of these
    samples contains only inliers (Fischler and Bolles 1981, section II-B). The number is at most
    ``limit``.
    """
    good = inlier_share**3
    if good >= 1.0:
        return 1
    miss = np.log1p(-good)
    if miss == 0.0:
        return limit
    return int(min(float(limit), np.ceil(np.log1p(-confidence) / miss)))
