"""Georeferences a finished map by adding GPS fixes to its pose graph.

First, RANSAC with Umeyama's closed form (TPAMI 1991) aligns the map frame with the local
east-north-up frame (ENU). If tracking was lost, the map consists of parts that tracking did not
connect. These parts are aligned separately. Then the poses of the keyframes are optimised in a pose
graph. The graph has the edges of the essential graph and a GPS factor for each fix. No keyframe is
held fixed.

At first, fixes have a Cauchy loss with a large scale. The scale shrinks from one optimisation to
the next. In this way, even a map that has drifted far is moved to its fixes. Afterwards, fixes that
fail a chi-square test are discarded, and the remaining fixes have a Gaussian loss.

The error of GPS is mostly a bias that changes slowly, which is caused by the atmosphere and by
reflections. A hundred fixes in ten seconds therefore provide little more information than a single
fix. For this reason, all fixes within ``CORRELATION_S`` together have the weight of a single fix.

The drift of a metric map depends on the camera, its calibration and the loops that were closed.
However, the pose graph has a single drift model for all maps. With this model, a map with little
drift would be bent towards the bias of the fixes. Therefore, the standard deviations of all tree
and covisibility edges are multiplied by a common factor. The factor that maximises the marginal
likelihood of the fixes is chosen (empirical Bayes: MacKay, Bayesian Interpolation, 1992).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.backend.pose_graph import (
    COVISIBLE,
    GAP,
    ROTATION_FIRST,
    TREE,
    WEAK,
    PoseGraph,
    edge_sigmas,
    minimised,
    parts_of,
)
from vslam.backend.similarity_graph import scale_of
from vslam.config import PoseGraphConfig
from vslam.support.errors import InputError
from vslam.types.geometry import inverses

CORRELATION_S = 10.0  # docs/research/gps.md compares other values
GATE = 11.34  # chi-square with three degrees of freedom that 1 % of correct fixes exceed
_MEDIAN = 2.366  # median of the chi-square distribution with three degrees of freedom
_CAUCHY = 2.0  # smallest scale of the Cauchy loss, in standard deviations
_NARROWING = 3.0  # factor by which this scale shrinks from one optimisation to the next
_DRIFT = 0.02  # tolerance of RANSAC for the drift of the map, as a fraction of the map's radius
_DRAWS, _MOST_DRAWN = 1000, 500  # RANSAC: number of samples, and number of fixes to draw from
_UP_WEIGHT = 1e-3  # see _umeyama
_METRIC = 0.02  # standard deviation of a metric map's scale, due to calibration errors
_MAX_UNSURE = 0.1  # largest accepted standard deviation of the directions of an ``Alignment``, rad
_LOOSE = np.array([0.3, 0.3, 0.3, 100.0, 100.0, 100.0])  # standard deviations of priors, rad and m
_STRETCH = 0.1  # ``_factors(stretch=...)`` of a monocular map while its local scale is estimated
# Factors on the standard deviations of the drift. The most likely factor is used.
_DRIFTS = (4.0, 1.0, 0.25, 0.0625)
# Standard deviation with which ``_likeliest`` holds each part of the map, rad and m.
_HELD = 1e-3
_WINDOW = 25  # number of keyframes on each side from which the local scale is estimated

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Positions:
    """M antenna positions that GPS measured, and the SLAM estimates of the same positions.

    Attributes:
        seconds: ``(M,)`` times of the measurements, seconds.
        keyframe: ``(M,)`` int64 index of the keyframe in whose frame ``arm`` and ``lever`` are
            given.
        arm: ``(M, 3)`` estimated position of the camera, in units of the map.
        lever: ``(M, 3)`` vector from the camera to the antenna, in metres.
        enu: ``(M, 3)`` measured position of the antenna relative to a reference point: east, north
            and up, in metres.
        sigma: ``(M, 3)`` standard deviations of ``enu`` in metres.
    """

    seconds: Array
    keyframe: NDArray[np.int64]
    arm: Array
    lever: Array
    enu: Array
    sigma: Array

    def select(self, chosen: NDArray[np.bool_]) -> Positions:
        return Positions(*(values[chosen] for values in vars(self).values()))

    @property
    def crowding(self) -> Array:
        """``(M,)`` numbers of positions in a time window of ``CORRELATION_S`` around each position,
        including the position itself."""
        times = np.sort(self.seconds)
        first = np.searchsorted(times, self.seconds - 0.5 * CORRELATION_S, "left")
        last = np.searchsorted(times, self.seconds + 0.5 * CORRELATION_S, "right")
        return (last - first).astype(np.float64)


@dataclass(frozen=True)
class Anchored:
    """The keyframes of a georeferenced map, in the ENU frame.

    Attributes:
        T_enu_k: ``(N, 4, 4)`` poses of the keyframes (camera to ENU), in metres.
        scale: ``(N,)`` metres per unit of the map at each keyframe.
        used: ``(M,)`` bool, True for GPS fixes that passed the chi-square test.
        residual_m: root mean square distance of the used fixes from the trajectory.
        S_enu_w: ``(4, 4)`` alignment of the whole map before the optimisation.
        level: whether the fixes determine the rotation of the map about every axis. It is False if
            the fixes lie on a straight line. The rotation about the line is then determined by the
            assumption that the camera is upright.
    """

    T_enu_k: Array
    scale: Array
    used: NDArray[np.bool_]
    residual_m: float
    S_enu_w: Array
    level: bool


def anchor(
    graph: PoseGraph, seconds: Array, positions: Positions, config: PoseGraphConfig, *, metric: bool
) -> Anchored:
    """Georeference a finished map: find the poses of the keyframes in the ENU frame that agree best
    with the essential graph and the GPS fixes.

    Args:
        seconds: ``(N,)`` times of the keyframes.
        metric: whether the unit of the map is the metre, apart from errors of the calibration. For
            a monocular map, it must be False. The scale and its drift are then estimated without a
            prior.

    Raises:
        InputError: the camera travelled too short a distance to determine the direction of travel.
    """
    T_wk = inverses(graph.T_cw)
    measured = (graph.kind != WEAK) & (graph.kind != GAP)
    part = parts_of(graph.edges[measured], len(graph.keyframes))
    main = align(T_wk, positions, metric=metric)
    if main.unsure > _MAX_UNSURE:
        raise InputError(
            "the drive is too short for GPS: the fixes do not determine its direction; drive "
            "farther, or use a receiver with a smaller error."
        )
    T_enu_k, scale = _aligned(T_wk, main.S_enu_w)
    for label in np.unique(part) if part.any() else ():
        at = part[positions.keyframe] == label
        own = align(T_wk, positions.select(at), metric=metric) if at.sum() >= 3 else main
        if own.unsure <= _MAX_UNSURE:
            inside = part == label
            T_enu_k[inside], scale[inside] = _aligned(T_wk[inside], own.S_enu_w)

    width = 2.0 * float(np.sqrt(np.median(_chi2(positions, T_enu_k, scale))))
    width = max(width, _CAUCHY * _NARROWING ** (1 if metric else 4))
    stretch = 0.0 if metric else _STRETCH
    while width > _CAUCHY:
        width = max(width / _NARROWING, _CAUCHY)
        factors = _factors(
            graph, seconds, T_enu_k, scale, positions, config, cauchy=width, stretch=stretch
        )
        T_enu_k = _optimised(factors)
        if not metric:
            scale = _local_scale(T_wk, T_enu_k, scale, part)
    used = np.ones(len(positions.seconds), np.bool_)
    for _ in range(2):
        chi2 = _chi2(positions, T_enu_k, scale)
        # Receivers underestimate their errors, so the gate is widened if the residuals are large.
        used = chi2 <= GATE * max(1.0, float(np.median(chi2)) / _MEDIAN)
        chosen = positions.select(used)
        final = partial(_factors, graph, seconds, T_enu_k, scale, chosen, config)
        T_enu_k = _likeliest(final, part) if metric else _optimised(final())
    distance = np.linalg.norm(_residuals(positions, T_enu_k, scale)[used], axis=1)
    residual = float(np.sqrt(np.mean(distance**2)))
    return Anchored(T_enu_k, scale, used, residual, main.S_enu_w, main.unsure_about <= _MAX_UNSURE)


@dataclass(frozen=True)
class Alignment:
    """A similarity transform from the map to ENU, and its uncertainty.

    Attributes:
        S_enu_w: ``(4, 4)`` similarity transform from the map to ENU.
        unsure: standard deviation of the direction of travel, rad.
        unsure_about: standard deviation of the rotation about the direction of travel, rad.
    """

    S_enu_w: Array
    unsure: float
    unsure_about: float


def align(T_wk: Array, positions: Positions, *, metric: bool, seed: int = 0) -> Alignment:
    """Align a map with its GPS fixes using RANSAC.

    The scale of a metric map is estimated as well, because the calibration may be inaccurate. The
    result is a weighted mean of two scales: the scale that the fixes suggest, and the calibrated
    scale, which is 1. The weights are the inverse variances. ``_METRIC`` is the standard deviation
    of the calibrated scale.

    Args:
        T_wk: ``(N, 4, 4)`` poses of the keyframes in the map (camera to world).
        positions: at least three GPS positions.
        metric: see ``anchor``.
    """
    k, enu = positions.keyframe, positions.enu
    path = _points(T_wk[k], positions.arm)
    lever = np.einsum("mij,mj->mi", T_wk[k, :3, :3], positions.lever)
    up = -T_wk[k, :3, 1]
    sigma = float(np.sqrt(np.mean(positions.sigma**2)))
    radius = float(np.sqrt(np.sum(np.median((enu - np.median(enu, axis=0)) ** 2, axis=0))))
    tolerance = max(np.sqrt(GATE) * sigma, _DRIFT * radius)
    reach = tolerance + float(np.linalg.norm(lever, axis=1).max())

    rng = np.random.default_rng(seed)
    drawn = np.unique(np.linspace(0, len(enu) - 1, min(len(enu), _MOST_DRAWN)).astype(int))
    triples = drawn[np.argsort(rng.random((_DRAWS, len(drawn))), axis=1)[:, :3]]
    fixed = 1.0 if metric else None
    S = _umeyama(path[triples], enu[triples], up[triples], fixed)
    distance = np.linalg.norm(_mapped(S, path[drawn]) - enu[drawn], axis=-1)
    best = S[np.argmin(np.minimum(distance / reach, 1.0).sum(axis=1))]
    for _ in range(3):
        enu = positions.enu - lever @ (best[:3, :3] / scale_of(best)).T
        inliers = np.linalg.norm(_mapped(best, path) - enu, axis=-1) <= tolerance
        if inliers.sum() < 3:
            inliers[:] = True
        matches = path[inliers], enu[inliers], up[inliers]
        best = _umeyama(*matches, fixed)
    spread = np.linalg.eigvalsh(np.cov(_mapped(best, path[inliers]).T, bias=True))[::-1]
    independent = float(np.sum(1.0 / positions.select(inliers).crowding))
    error = sigma / np.sqrt(independent)
    if metric:
        free = _umeyama(*matches, None)
        residual = np.sqrt(np.mean((_mapped(free, path[inliers]) - enu[inliers]) ** 2))
        variance = max(sigma, residual) ** 2 / (independent * max(spread.sum(), 1e-12))
        share = _METRIC**2 / (_METRIC**2 + variance)
        scale = 1.0 + share * (float(scale_of(free)) - 1.0)
        best = _umeyama(*matches, scale)
    unsure, unsure_about = error / np.sqrt(np.maximum([spread[0], spread[1:].sum()], 1e-12))
    return Alignment(best, float(unsure), float(unsure_about))


def _umeyama(p: Array, q: Array, up: Array, fixed: float | None) -> Array:
    """Compute the ``(..., 4, 4)`` similarity transforms that map ``(..., M, 3)`` points p to points
    q (Umeyama's closed form). Their scale is ``fixed``, or is estimated if ``fixed`` is None.

    Points on a line do not determine the rotation about this line. In this case, the upward axes
    ``up`` of the camera determine it. In all other cases, these axes hardly affect the result.
    """
    p_mean, q_mean = p.mean(axis=-2), q.mean(axis=-2)
    p0, q0 = p - p_mean[..., None, :], q - q_mean[..., None, :]
    cross = np.einsum("...mi,...mj->...ij", q0, p0)
    size = np.sqrt((p0**2).sum((-2, -1)) * (q0**2).sum((-2, -1)))
    upward = np.zeros_like(cross)
    upward[..., 2, :] = up.mean(axis=-2)
    U, _, Vt = np.linalg.svd(cross + _UP_WEIGHT * size[..., None, None] * upward)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    R = U @ Vt
    scale: Array | float
    if fixed is not None:
        scale = fixed
    else:
        scale = np.einsum("...ij,...ij->...", R, cross) / np.maximum((p0**2).sum((-2, -1)), 1e-12)
    S = np.zeros((*size.shape, 4, 4))
    S[..., :3, :3] = np.asarray(scale)[..., None, None] * R
    S[..., :3, 3] = q_mean - np.einsum("...ij,...j->...i", S[..., :3, :3], p_mean)
    S[..., 3, 3] = 1.0
    return S


def _mapped(S: Array, points: Array) -> Array:
    """Transform ``(M, 3)`` points by ``(..., 4, 4)`` similarities. Returns ``(..., M, 3)``."""
    return points @ np.swapaxes(S[..., :3, :3], -2, -1) + S[..., None, :3, 3]


def _aligned(T_wk: Array, S_enu_w: Array) -> tuple[Array, Array]:
    """Return the poses ``T_enu_k`` and the scales of the keyframes after the similarity
    ``S_enu_w``."""
    scale = float(scale_of(S_enu_w))
    T_enu_k = S_enu_w @ T_wk
    T_enu_k[:, :3, :3] /= scale
    return T_enu_k, np.full(len(T_wk), scale)


def _points(T: Array, points: Array) -> Array:
    """Transform each of ``(M, 3)`` points by the pose with the same index."""
    return np.einsum("mij,mj->mi", T[:, :3, :3], points) + T[:, :3, 3]


def _antenna(positions: Positions, scale: Array) -> Array:
    """Return the ``(M, 3)`` positions of the antenna in the frames of the keyframes, in metres."""
    return positions.arm * scale[positions.keyframe, None] + positions.lever


def _residuals(positions: Positions, T_enu_k: Array, scale: Array) -> Array:
    return _points(T_enu_k[positions.keyframe], _antenna(positions, scale)) - positions.enu


def _chi2(positions: Positions, T_enu_k: Array, scale: Array) -> Array:
    return np.sum((_residuals(positions, T_enu_k, scale) / positions.sigma) ** 2, axis=1)


def _local_scale(T_wk: Array, T_enu_k: Array, scale: Array, part: NDArray[np.int64]) -> Array:
    """Estimate the scale of the map at each keyframe, as ``(N,)`` metres per unit of the map.

    The scale is the length of the path around the keyframe in ENU, divided by the length of the
    same path in the map. The path stays within the keyframe's part of the map. Where its length is
    0, the given ``scale`` is returned.
    """
    scale = scale.copy()
    for label in np.unique(part):
        inside = np.flatnonzero(part == label)
        k = np.arange(len(inside))
        first, last = np.maximum(k - _WINDOW, 0), np.minimum(k + _WINDOW, len(k) - 1)
        steps = (np.diff(T[inside, :3, 3], axis=0) for T in (T_enu_k, T_wk))
        paths = (np.append(0.0, np.cumsum(np.linalg.norm(step, axis=1))) for step in steps)
        metres, units = (path[last] - path[first] for path in paths)
        scale[inside[units > 0]] = metres[units > 0] / units[units > 0]
    return scale


def _likeliest(factors: Callable[..., _Factors], part: NDArray[np.int64]) -> Array:
    """Optimise the poses with each factor of the drift model in ``_DRIFTS``. Returns the ``(N, 4,
    4)`` poses for the factor that maximises the likelihood of the fixes, given the edges.

    The likelihood is an integral over all poses of the keyframes. Laplace's approximation depends
    on the error at the optimum and on the determinants of the normal matrices with and without the
    fixes.

    Args:
        factors: the function ``_factors``, with all arguments except ``drift``.
        part: ``(N,)`` label of the part of the map that each keyframe belongs to.
    """
    import gtsam

    held = gtsam.noiseModel.Isotropic.Sigma(6, _HELD)
    best, least = None, np.inf
    for drift in _DRIFTS:
        found = factors(drift=drift)
        vision, both = found.vision, found.both()
        result = minimised(both, found.start)
        after = _log_determinant(both, result)
        # Vision alone does not determine where each part of the map is, so each part is held.
        for i in np.unique(part, return_index=True)[1].tolist():
            vision.add(gtsam.PriorFactorPose3(i, result.atPose3(i), held))
        surprise = 2.0 * both.error(result) + after - _log_determinant(vision, result)
        if surprise < least:  # False for NaN
            best, least = result, surprise
    return _optimised(factors()) if best is None else _poses(best)


def _log_determinant(factors: Any, values: Any) -> float:
    """Return the log determinant of the normal matrix, or NaN if GTSAM cannot factorise the matrix.
    This happens if the edges have much smaller standard deviations than the priors, for example on
    a drive of less than a metre."""
    try:
        # GTSAM returns the log determinant of the triangular root.
        return 2.0 * float(factors.linearize(values).eliminateMultifrontal().logDeterminant())
    except RuntimeError:
        return np.nan


def _optimised(factors: _Factors) -> Array:
    return _poses(minimised(factors.both(), factors.start))


def _poses(values: Any) -> Array:
    return np.array([values.atPose3(i).matrix() for i in range(values.size())])


class _Factors(NamedTuple):
    """The factors of a pose-graph optimisation with GPS, and its initial values.

    Attributes:
        vision: ``gtsam.NonlinearFactorGraph`` of the edges.
        fixes: ``gtsam.NonlinearFactorGraph`` of the fixes.
        start: ``gtsam.Values``, the initial poses of the keyframes.
    """

    vision: Any
    fixes: Any
    start: Any

    def both(self) -> Any:
        """Return a new ``gtsam.NonlinearFactorGraph`` of the edges and the fixes."""
        import gtsam

        both = gtsam.NonlinearFactorGraph(self.vision)
        both.push_back(self.fixes)
        return both


def _factors(
    graph: PoseGraph,
    seconds: Array,
    T_enu_k: Array,
    scale: Array,
    positions: Positions,
    config: PoseGraphConfig,
    *,
    cauchy: float | None = None,
    stretch: float = 0.0,
    drift: float = 1.0,
) -> _Factors:
    """Create the factors of a pose-graph optimisation with GPS, which starts from ``T_enu_k``.

    Args:
        cauchy: scale of the Cauchy loss of the fixes, in standard deviations of the fixes; None
            uses a Gaussian loss.
        stretch: relative standard deviation of the lengths of edges. It is added in quadrature to
            ``edge_sigmas``.
        drift: factor that multiplies the standard deviations of tree and covisibility edges.
    """
    import gtsam

    noise = gtsam.noiseModel
    vision, fixes = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    loose = noise.Diagonal.Sigmas(_LOOSE)
    for i, T in enumerate(T_enu_k):
        pose = gtsam.Pose3(T)
        start.insert(i, pose)
        # This prior determines the poses of parts without fixes. On a straight drive, it also
        # determines the rotation about the direction of travel.
        if graph.fixed[i]:
            vision.add(gtsam.PriorFactorPose3(i, pose, loose))
    edges, T_i_j = graph.edges, graph.T_i_j.copy()
    T_i_j[:, :3, 3] *= scale[edges].mean(axis=1)[:, None]
    sigmas = edge_sigmas(edges, T_i_j, graph.kind, seconds[edges], len(T_enu_k), config)
    sigmas[(graph.kind == TREE) | (graph.kind == COVISIBLE)] *= drift
    stretched = stretch * np.linalg.norm(T_i_j[:, :3, 3], axis=1, keepdims=True)
    sigmas[:, :3] = np.hypot(sigmas[:, :3], stretched)
    for (i, j), T, sigma in zip(edges.tolist(), T_i_j, sigmas[:, ROTATION_FIRST], strict=True):
        between = noise.Diagonal.Sigmas(sigma)
        vision.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(T), between))
    crowding = np.sqrt(positions.crowding)
    antenna = _antenna(positions, scale)
    for k, (i, n) in enumerate(zip(positions.keyframe.tolist(), crowding.tolist(), strict=True)):
        plain = noise.Diagonal.Sigmas(n * positions.sigma[k])
        loss = None if cauchy is None else noise.mEstimator.Cauchy.Create(cauchy / n)
        model = plain if loss is None else noise.Robust.Create(loss, plain)
        fixes.add(gtsam.GPSFactorArm(i, positions.enu[k], antenna[k], model))
    return _Factors(vision, fixes, start)
