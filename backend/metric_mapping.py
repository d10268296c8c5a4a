"""Bundle adjustment that gives the map of one camera its scale, from the samples of an IMU.

Images do not tell the scale of a map, which drifts from keyframe to keyframe. Local bundle
adjustment with an IMU (``backend/inertial_adjustment.py``) cannot mend it, because older keyframes
hold its window. Here, the newest keyframes are adjusted all together, at certain keyframes and at
the end of a drive (Campos et al., ORB-SLAM3, T-RO 2021, section V-B; there, it is done twice after
the start).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import (
    BundleProblem,
    cholesky_solve,
    empty_equations,
    linearise,
    observations_of,
    reduced_system,
    robust_cost,
)
from vslam.backend.inertial_adjustment import (
    InertialChain,
    adjust_with_imu,
    chain_of,
    linear_factors,
    start_values,
)
from vslam.backend.inertial_filter import BIAS, FALL, N
from vslam.backend.inertial_start import ACCEL_BIAS, GYRO_BIAS
from vslam.backend.keyframe_motions import motions_between, record_motion
from vslam.backend.local_mapping import assemble, remove_observations, window_landmarks
from vslam.types.context import Context
from vslam.types.geometry import Matrix, inverses
from vslam.types.imu import GRAVITY, InertialWindow
from vslam.types.map import CARRIED, Map
from vslam.types.map_kernels import refresh_landmarks

# The number of newest keyframes that are adjusted together, and after how many new keyframes. They
# are 10 to 40 s of a drive. While the map has fewer than YOUNG keyframes, each adds much to what is
# known of the scale, and adjustment costs little. [own]
WIDE_KEYFRAMES, WIDE_EVERY = 100, 20
YOUNG, YOUNG_EVERY = 40, 5
_SOON = (4, 8)  # keyframes after the first one of a sub-map
_ITERATIONS, _TOLERANCE = 15, 1e-6
# The images' scale drifts by more than the white noise of features explains, because features are
# biased towards the point that a camera approaches (docs/research/motorway.md). The standard
# deviation of the drift from one keyframe to the next, for a camera that comes nearer to the scene
# by its whole distance. With it, the scale of three rendered streets (demo, seeds 80, 82 and 83)
# errs by 0.3 to 0.9 of its standard deviation when this is 1 to 2.6 %. [own]
_DRIFT = 0.05
_VARIANCES = (0.05, 4.0)  # plausible variances of unit weight
# What is known of gravity before the adjustment: its length, and hardly its direction (m/s^2, rad).
_LENGTH, _TILT = 1e-3, 0.1


@dataclass(frozen=True)
class MapScale:
    """The scale of a map of one camera.

    Attributes:
        scale: metres per unit of the map.
        sigma: standard deviation of its logarithm.
    """

    scale: float
    sigma: float


def scale_of_map(
    map_: Map,
    first: int,
    context: Context,
    inertial: InertialWindow,
    R_world_camera: Matrix,
    start: float,
) -> MapScale | None:
    """Find the scale of the newest keyframes by a bundle adjustment with an IMU. The map is only
    read.

    Args:
        first: the first keyframe whose unit of length is that of the newest keyframe.
        inertial, R_world_camera: see ``adjust_widely``.
        start: about how many metres a unit of the map has.

    Returns:
        None if samples are missing, or do not agree with the images.
    """
    chain = _newest_chain(map_, first, int(map_.living_keyframes()[-1]), inertial, R_world_camera)
    if chain is None:
        return None
    ids = chain.camera
    cameras = np.concatenate([ids[1:], ids[:1]])  # the oldest one is held fixed
    landmarks, _ = window_landmarks(map_.arrays, ids, map_.n_landmarks, map_.n_keyframes)
    landmarks = landmarks[map_.arrays.n_observations[landmarks] > 1]
    problem, _ = assemble(map_, ids[1:], ids[:1], landmarks, context.camera)
    T_cw = problem.T_cw.copy()
    T_cw[:, :3, 3] *= start
    problem = replace(problem, T_cw=T_cw, points=start * problem.points)
    chain = replace(chain, camera=map_.places_among(cameras)[ids])
    found = scale_of_problem(problem, chain, inertial.noise_factor)
    return None if found is None else replace(found, scale=start * found.scale)


def scale_of_problem(
    problem: BundleProblem, chain: InertialChain, noise_factor: float
) -> MapScale | None:
    """Find by how much the positions of all cameras must grow to be in metres.

    Args:
        problem: all its cameras belong to the chain.
        noise_factor: see ``InertialChain.weighed``.

    Returns:
        None if the samples do not agree with the images.
    """
    variance = _image_variance(problem)
    chain = chain.weighed(noise_factor, variance)
    found = adjust_with_imu(problem, chain, iterations=_ITERATIONS, tolerance=_TOLERANCE)
    if found is None:
        return None
    before, after = (inverses(T)[:, :3, 3] for T in (problem.T_cw, found.T_cw))
    before, after = before - before.mean(axis=0), after - after.mean(axis=0)
    growth = float(np.sqrt(np.sum(after**2) / np.sum(before**2)))
    solved = replace(problem, T_cw=found.T_cw, points=found.points)
    return MapScale(growth, _scale_sigma(solved, chain, found.inlier, variance))


def adjust_widely(
    map_: Map, keyframe: int, context: Context, inertial: InertialWindow, R_world_camera: Matrix
) -> None:
    """Run bundle adjustment with an IMU over the newest keyframes up to one of them.

    Older keyframes that observe the same landmarks are held fixed.

    Args:
        inertial: what is known from the IMU at a frame.
        R_world_camera: ``(3, 3)`` rotation of the camera at this frame, in the world frame.
    """
    first = max(_breaks(map_), default=0)
    chain = _newest_chain(map_, first, keyframe, inertial, R_world_camera)
    if chain is None:
        return
    ids, a = chain.camera, map_.arrays
    landmarks, others = window_landmarks(a, ids, map_.n_landmarks, map_.n_keyframes)
    free, fixed = ids, np.flatnonzero(others)
    if ids[0] == 0 or not len(fixed):
        free, fixed = ids[1:], np.concatenate([ids[:1], fixed])
    problem, rows = assemble(map_, free, fixed, landmarks, context.camera)
    chain = replace(chain, camera=map_.places_among(np.concatenate([free, fixed]))[ids])
    chain = chain.weighed(inertial.noise_factor, _image_variance(problem))
    found = adjust_with_imu(problem, chain, iterations=_ITERATIONS, tolerance=_TOLERANCE)
    if found is None:
        return
    a.T_cw[free] = found.T_cw[: len(free)]
    a.xyz[landmarks] = found.points
    remove_observations(a, rows[~found.inlier])
    refresh_landmarks(a, landmarks, map_.scales)


def record_missing_motions(map_: Map, first: int, inertial: InertialWindow) -> None:
    """Record the motions before keyframes that were mapped while the state of the IMU was unknown,
    as far as there are samples.

    Args:
        first: the keyframes after this one are looked at.
    """
    seconds = map_.keyframes.motion_seconds[: map_.n_keyframes]
    missing = np.flatnonzero(seconds == 0.0)
    for keyframe in missing[missing > first].tolist():
        record_motion(map_, keyframe, inertial)


def is_wide(map_: Map, keyframe: int) -> bool:
    """Return whether the newest keyframes are adjusted together after a keyframe: regularly, and
    soon after a sub-map has begun, whose scale is that of a distance that the IMU measured."""
    young = map_.restarts and keyframe - map_.restarts[-1] in _SOON
    return bool(young) or keyframe % (YOUNG_EVERY if keyframe < YOUNG else WIDE_EVERY) == 0


def _breaks(map_: Map) -> list[int]:
    """Return the first keyframes of the sub-maps whose distance from the map was not measured."""
    return [one for one in map_.restarts if map_.keyframes.restart[one] != CARRIED]


def _newest_chain(
    map_: Map, first: int, keyframe: int, inertial: InertialWindow, R_world_camera: Matrix
) -> InertialChain | None:
    """Connect the newest keyframes from ``first`` to ``keyframe``, by their ids."""
    ids = map_.living_keyframes().astype(np.int64)
    ids = ids[(ids >= first) & (ids <= keyframe)]
    ids = ids[map_.sessions[ids] == map_.sessions[keyframe]][-WIDE_KEYFRAMES:]
    if len(ids) < 2:
        return None
    down = inertial.state.gravity / np.linalg.norm(inertial.state.gravity)
    along, unknown = np.outer(down, down), np.zeros((N, N))
    unknown[FALL, FALL] = _LENGTH**2 * along + (_TILT * GRAVITY) ** 2 * (np.eye(3) - along)
    unknown[BIAS, BIAS] = np.diag(np.repeat([GYRO_BIAS**2, ACCEL_BIAS**2], 3))
    found = replace(inertial, state=replace(inertial.state, covariance=unknown))
    return chain_of(found, motions_between(map_, ids), ids, R_world_camera)


def _image_variance(problem: BundleProblem) -> float:
    """Return the mean square of the residuals of the images, divided by the expected one (the
    variance of unit weight of a least-squares adjustment). 1 if there are too few residuals."""
    inlier = np.ones(len(problem.camera), np.bool_)
    cost = robust_cost(problem.T_cw, problem.points, observations_of(problem, None), inlier)
    spare = 2 * len(problem.camera) - 3 * len(problem.points) - 6 * problem.n_free
    return float(np.clip(2.0 * cost / spare, *_VARIANCES)) if spare > 0 else 1.0


def _scale_sigma(
    problem: BundleProblem, chain: InertialChain, use: NDArray[np.bool_], variance: float
) -> float:
    """Return the standard deviation of the logarithm of the scale of the positions of all cameras
    (Umeyama, 1991), at the solution of a problem.

    Args:
        variance: see ``InertialChain.weighed``.
    """
    n_free, n_points = problem.n_free, len(problem.points)
    observations = observations_of(problem, use)
    equations = empty_equations(n_free, n_points, len(problem.camera))
    size, n_poses = 6 * n_free + chain.n_unknowns, 6 * n_free
    S, rhs, V_inverse = np.empty((size, size)), np.empty(size), np.empty((n_points, 3, 3))
    linearise(problem.T_cw, n_free, problem.points, observations, equations)
    reduced_system(n_free, observations, equations, 1e-9, S, rhs, V_inverse)
    of_images = np.triu(S[:n_poses, :n_poses])
    of_images += np.triu(of_images, 1).T
    states = start_values(problem.T_cw, chain)
    S += linear_factors(problem.T_cw, states, chain, n_free).hessian
    centre = inverses(problem.T_cw)[:, :3, 3]
    apart = centre - centre.mean(axis=0)
    rhs[:] = 0.0
    rhs[:n_poses] = _moving(problem, apart / np.sum(apart**2))
    derivative = rhs.copy()
    if not cholesky_solve(S, rhs):
        return float("inf")
    # How much the scale changes if the images let all later keyframes drift away from one keyframe.
    pulled, drift = of_images @ rhs[:n_poses], 0.0
    for k, growth in enumerate(_approach(problem, chain)):
        away = np.zeros_like(centre)
        later = chain.camera[k + 1 :]
        away[later] = centre[later] - centre[chain.camera[k]]
        drift += float(growth * (_moving(problem, away) @ pulled)) ** 2
    return float(np.sqrt(variance * (derivative @ rhs) + _DRIFT**2 * drift))


def _moving(problem: BundleProblem, by: Matrix) -> Matrix:
    """Return the ``(6 n_free,)`` increments of the free cameras that move the centres of all
    cameras by ``(K, 3)`` in the world. An increment moves a camera by ``-R_wc rho``."""
    increments = np.zeros((problem.n_free, 6))
    R_cw = problem.T_cw[: problem.n_free, :3, :3]
    increments[:, :3] = -np.einsum("nij,nj->ni", R_cw, by[: problem.n_free])
    return increments.ravel()


def _approach(problem: BundleProblem, chain: InertialChain) -> Matrix:
    """Return how far the camera moves forward from each keyframe of a chain to the next, divided by
    the median depth of the landmarks that it observes."""
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    T = problem.T_cw[problem.camera]
    depth = np.einsum("nj,nj->n", T[:, 2, :3], problem.points[point]) + T[:, 2, 3]
    medians = [np.median(depth[problem.camera == k]) for k in chain.camera[:-1]]
    T_cw = problem.T_cw[chain.camera]
    moved = np.diff(inverses(T_cw)[:, :3, 3], axis=0)
    forward: Matrix = np.einsum("nj,nj->n", T_cw[:-1, 2, :3], moved) / np.array(medians)
    return forward
