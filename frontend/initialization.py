"""Initialises a monocular map from two views (section IV of the ORB-SLAM paper).

If the scene is planar or the camera only rotates, the fundamental matrix is not determined. In all
other cases, a homography does not explain the matches. Therefore, both models are fitted to the
same random samples, and both give motions. Each of them is refined on the Sampson error.

A reconstruction is accepted only if one motion explains the matches clearly better than any other
motion. The reason is that a map with wrong first points cannot be repaired later. Whole pixels do
not tell the two motions that fit a plane apart, so matches are aligned to fractions of a pixel.

All samples are fitted and scored in one batch. For this batch, NumPy is as fast as a Numba kernel,
and NumPy needs no compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.config import InitializationConfig
from vslam.frontend.matching import Projections, Searchable, consistent_orientation, search_windows
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.geometry import Matrix, se3_exp
from vslam.types.reprojection import CHI2_MONO, stack_uvr

# Search radius for matches in the second view, in pixels. A larger radius allows faster motion
# between the views. [OS1 IV, customary]
_WINDOW = 100.0
# Upper bound of the descriptor distance of a match, in bits. [OS1 IV, customary]
_MATCH_DISTANCE = 50
# Upper bound of the ratio of the best to the second-best distance. [OS1 IV, customary]
_MATCH_RATIO = 0.9
# Number of RANSAC draws for each of the two models. ORB-SLAM uses 200. [OS1 IV, own]
_DRAWS = 300
# Upper bound of the reprojection error of an inlier, in pixels at octave 0. [OS1 IV, customary]
_MAX_ERROR = 2.0
# At least this many points must be triangulated with a parallax of `min_parallax_deg`. [OS1 IV,
# customary]
_MIN_POINTS = 50
# At least this fraction of the inliers of the model must be triangulated in front of both
# cameras. [OS1 IV, own]
_MIN_POINT_SHARE = 0.7
# Motions that explain less than this fraction of the points that the best motion explains are not
# refined. [own]
_MIN_RIVAL_SHARE = 0.5
# The motion is ambiguous if the cost of another one is less than this many times as large. In
# rendered rooms, halls and streets, wrong motions had 1.7 to 5 times the cost of the right one, and
# 1.2 times where an earlier version began a wrong map. [own]
_MIN_RIVAL_COST = 1.5
# It must be this many times as large if the other motion needs less than half of the parallax. A
# turn and a short step forwards look much like an orbit around a surface, and cameras are more
# often turned. In a hand-held recording, whose images err by 0.3 pixels, such orbits fitted up to
# 1.7 times better. [own]
_SIMPLER, _SIMPLER_RIVAL_COST = 2.0, 3.0
# Two motions are the same if their translations differ by less than this angle, in degrees. [own]
_SAME_DIRECTION = 10.0
_REFINEMENTS, _STEPS = 2, 10  # alignments of the matches, and Gauss-Newton steps after each
_OUTLIER = 3.0  # standard deviations
_MIN_SIGMA = 0.02  # px at octave 0, smallest standard deviation of aligned matches
_ALIGNED = 0.2  # standard deviation of an aligned match, divided by that of other matches [own]

# The parallax of `_MIN_POINTS` points must also be at least this fraction of `min_parallax_deg`
# if the best rotation between the views is taken from the flow. [own]
_MIN_LEFT = 0.4
_ROTATIONS = 8  # iterations that find this rotation

CHI2_LINE = 3.841  # 95 % quantile of chi-square with 1 degree of freedom: distance from a line
# Matches per sample. The eight-point algorithm needs all of them; a homography needs only four.
SAMPLE = 8
# Points with a smaller parallax than this (0.36 degrees) are counted, but not mapped (ORB-SLAM).
MAX_COSINE = 0.99998


@dataclass(frozen=True)
class TwoViewModel:
    """A homography or a fundamental matrix that was fitted to the N matches of two views.

    Attributes:
        matrix: ``(3, 3)``. A homography maps pixels of view 1 to pixels of view 2. A fundamental
            matrix maps pixels of view 1 to epipolar lines in view 2.
        inlier: ``(N,)`` bool, True for matches that the model explains.
    """

    kind: Literal["homography", "fundamental"]
    matrix: Matrix
    inlier: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class KnownTurn:
    """The rotation between two views, as a gyroscope measured it.

    Attributes:
        R_2_1: ``(3, 3)``, maps directions of view 1 to view 2.
        tolerance: largest error of the rotation, in radians.
    """

    R_2_1: Matrix
    tolerance: float

    def allows(self, T_2_1: Matrix) -> bool:
        """Return whether a ``(4, 4)`` motion has this rotation."""
        cosine = 0.5 * (np.trace(self.R_2_1.T @ T_2_1[:3, :3]) - 1.0)
        return bool(cosine >= np.cos(self.tolerance))


@dataclass(frozen=True)
class TwoViews:
    """The relative pose of two views and the points that were triangulated from them.

    Attributes:
        T_2_1: ``(4, 4)`` transform from camera 1 to camera 2; its translation has length 1.
        match: ``(M,)`` int64 indices of the triangulated matches among all matches of the two
            views.
        points: ``(M, 3)`` triangulated points, in the frame of camera 1. The unit of length is the
            distance between the two cameras.
        shift: ``(M, 2)`` offset from each position in view 2 to its aligned position, in pixels;
            NaN where the match was not aligned.
    """

    T_2_1: Matrix
    match: NDArray[np.int64]
    points: Matrix
    shift: Matrix


Align = Callable[[Matrix, NDArray[np.int64], Matrix], Matrix]
"""Finds the image patches of N points of view 1 in view 2. Takes the motion ``T_2_1``, the ``(N,)``
indices of the matches, and the ``(N, 3)`` points in the frame of camera 1. Returns the ``(N, 2)``
offsets from the matched positions in pixels, NaN where a patch was not found."""


def match_views(
    before: Features, now: Features, context: Context
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match the features of two frames by their descriptors. Each feature of the frame ``before``
    is searched for in a window around the same position in the frame ``now``.

    Returns:
        ``(N,)`` indices of the matched features in ``before``, and ``(N,)`` indices in ``now``.
    """
    camera = context.camera
    n = len(before)
    octave = before.octave.astype(np.int64)
    found, _ = search_windows(
        Projections(
            stack_uvr(before.xy, np.zeros(n)),
            np.full(n, _WINDOW),
            octave,
            octave,
            before.descriptors.view(np.uint64),
        ),
        Searchable.of_features(now, camera.width, camera.height),
        np.ones(len(now), np.bool_),
        _MATCH_DISTANCE,
        _MATCH_RATIO,
    )
    first = np.flatnonzero(found >= 0)
    second = found[first].astype(np.int64)
    keep = consistent_orientation(before.angle[first], now.angle[second])
    return first[keep], second[keep]


def reconstruct(
    xy_1: Matrix,
    xy_2: Matrix,
    sigma: Matrix,
    camera: Camera,
    config: InitializationConfig,
    *,
    seed: int,
    turn: KnownTurn | None = None,
    align: Align | None = None,
) -> TwoViews | None:
    """Reconstruct the relative pose of two views and the matched points. Returns None if the
    matches do not determine the motion.

    The matches of a plane, such as the ground, allow two motions, which usually differ in their
    rotation. The rotation of a gyroscope then tells which one it was.

    Args:
        xy_1, xy_2: ``(N, 2)`` matched pixels.
        sigma: ``(N,)`` standard deviation of these positions, pixels.
        turn: the rotation between the views; None if it is unknown. It is not used if no motion
            with this rotation explains about as many points as the best motion.
        align: aligns the matches; None if the images are not available.
    """
    if len(xy_1) < SAMPLE:
        return None
    motions, match = possible_motions(xy_1, xy_2, sigma, camera, seed=seed)
    xy_1, xy_2, sigma = xy_1[match], xy_2[match], sigma[match]
    if len(match) < _MIN_POINTS or not motions:
        return None
    left = np.sort(angles_after_rotation(xy_1, xy_2, camera))[-_MIN_POINTS]
    if left < _MIN_LEFT * np.radians(config.min_parallax_deg):
        return None
    counts = np.array([_triangulate(T, xy_1, xy_2, sigma, camera)[1].sum() for T in motions])
    if turn is not None:
        allowed = np.array([turn.allows(T) for T in motions])
        if counts[allowed].max(initial=0) > _MIN_RIVAL_SHARE * counts.max():
            counts[~allowed] = 0
    rivals = [
        _refined(T, match, xy_1, xy_2, sigma, camera, align)
        for T, count in zip(motions, counts, strict=True)
        if count >= max(SAMPLE, _MIN_RIVAL_SHARE * counts.max())
    ]
    if not rivals:
        return None
    unit = max(min(one.median for one in rivals), _MIN_SIGMA)
    costs = np.array([one.cost(unit) for one in rivals])
    best = rivals[int(np.argmin(costs))]
    needed = [
        (_SIMPLER_RIVAL_COST if best.parallax > _SIMPLER * one.parallax else _MIN_RIVAL_COST)
        if _differ(best.T_2_1, one.T_2_1)
        else 0.0
        for one in rivals
    ]
    points, good, cosine = best.points, best.good, best.cosine
    widest = np.sort(cosine[good])[:_MIN_POINTS]  # cosines of the largest parallaxes
    if (
        len(points[good]) < max(_MIN_POINTS, _MIN_POINT_SHARE * len(match))
        or (costs < np.array(needed) * costs.min()).any()
        or widest[-1] > np.cos(np.radians(config.min_parallax_deg))
    ):
        return None
    kept = good & (cosine < MAX_COSINE)
    return TwoViews(best.T_2_1, match[kept], points[kept], best.shift[kept])


def possible_motions(
    xy_1: Matrix, xy_2: Matrix, sigma: Matrix, camera: Camera, *, seed: int
) -> tuple[list[Matrix], NDArray[np.int64]]:
    """Return the motions ``T_2_1`` of a homography and of an essential matrix, and the indices of
    the matches that one of the two models explains."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    homography, fundamental = fit_models(xy_1, xy_2, sigma, seed=seed)
    motions = motions_of_homography(np.linalg.inv(K) @ homography.matrix @ K)
    motions += motions_of_essential(K.T @ fundamental.matrix @ K)
    return motions, np.flatnonzero(homography.inlier | fundamental.inlier)


@dataclass(frozen=True)
class _Refined:
    """A motion that was refined on N matches.

    Attributes:
        error: ``(N,)`` Sampson errors, in pixels at octave 0.
        shift: ``(N, 2)`` offset of each match to its aligned position in view 2, pixels; NaN where
            it was not aligned.
        points, good, cosine: see ``_triangulate``.
    """

    T_2_1: Matrix
    error: Matrix
    shift: Matrix
    points: Matrix
    good: NDArray[np.bool_]
    cosine: Matrix

    @property
    def median(self) -> float:
        """Standard deviation of the errors, estimated from their median."""
        aligned = np.isfinite(self.shift[:, 0])
        usual = self.error[aligned] if aligned.any() else self.error
        return 1.4826 * float(np.median(np.abs(usual)))

    @property
    def parallax(self) -> float:
        """Median parallax of the points, in radians."""
        if not self.good.any():
            return 0.0
        return float(np.arccos(np.clip(np.median(self.cosine[self.good]), -1.0, 1.0)))

    def cost(self, unit: float) -> float:
        """Mean of the squared errors in a given unit. Matches whose point is not in front of both
        cameras cost as much as outliers."""
        squared = np.minimum((self.error / unit) ** 2, _OUTLIER**2)
        return float(np.where(self.good, squared, _OUTLIER**2).mean())


def _refined(
    T_2_1: Matrix,
    match: NDArray[np.int64],
    xy_1: Matrix,
    xy_2: Matrix,
    sigma: Matrix,
    camera: Camera,
    align: Align | None,
) -> _Refined:
    shift = np.full(xy_2.shape, np.nan)
    weight, moved = 1.0 / sigma, xy_2
    for _ in range(1 if align is None else _REFINEMENTS):
        points, good, _ = _triangulate(T_2_1, xy_1, moved, sigma, camera)
        if align is not None:
            shift = np.full(xy_2.shape, np.nan)
            shift[good] = align(T_2_1, match[good], points[good])
            aligned = np.isfinite(shift[:, 0])
            moved = np.where(aligned[:, None], xy_2 + shift, xy_2)
            weight = np.where(aligned, 1.0, _ALIGNED) / sigma
        T_2_1 = refined_motion(T_2_1, xy_1, moved, weight, camera)
    points, good, cosine = _triangulate(T_2_1, xy_1, moved, sigma, camera)
    error = sampson_errors(T_2_1, xy_1, moved, camera) / sigma
    return _Refined(T_2_1, error, shift, points, good, cosine)


def _differ(T: Matrix, other: Matrix) -> bool:
    t, u = T[:3, 3], other[:3, 3]
    return bool(t @ u < np.cos(np.radians(_SAME_DIRECTION)) * np.linalg.norm(t) * np.linalg.norm(u))


def refined_motion(
    T_2_1: Matrix, xy_1: Matrix, xy_2: Matrix, weight: Matrix, camera: Camera
) -> Matrix:
    """Minimise the robust Sampson error of a motion by Gauss-Newton over its five parameters.

    Args:
        T_2_1: ``(4, 4)`` initial motion.
        xy_1, xy_2: ``(N, 2)`` matched pixels.
        weight: ``(N,)`` inverse standard deviations of the positions, up to a common factor.
    """
    for _ in range(_STEPS):
        error = weight * sampson_errors(T_2_1, xy_1, xy_2, camera)
        sigma = max(1.4826 * float(np.median(np.abs(error))), 1e-9)
        robust = np.minimum(1.0, (_OUTLIER * sigma / np.maximum(np.abs(error), 1e-12)) ** 2)
        J = np.empty((len(error), 5))
        for k in range(5):
            step = np.zeros(5)
            step[k] = 1e-6
            moved = weight * sampson_errors(_perturbed(T_2_1, step), xy_1, xy_2, camera)
            J[:, k] = (moved - error) / 1e-6
        H = (robust[:, None] * J).T @ J
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(5), J.T @ (robust * error))
        length = float(np.linalg.norm(step))
        T_2_1 = _perturbed(T_2_1, step * min(1.0, 0.2 / max(length, 1e-12)))
        if length < 1e-7:
            break
    return T_2_1


def _perturbed(T: Matrix, step: Matrix) -> Matrix:
    """Turn a motion by a rotation vector, and the direction of its translation by two angles."""
    t = T[:3, 3] / np.linalg.norm(T[:3, 3])
    aside = np.cross(t, np.eye(3)[int(np.argmin(np.abs(t)))])
    aside /= np.linalg.norm(aside)
    turn = se3_exp(np.concatenate([np.zeros(3), step[:3]]))[:3, :3]
    return _motion(turn @ T[:3, :3], t + step[3] * aside + step[4] * np.cross(t, aside))


def sampson_errors(T_2_1: Matrix, xy_1: Matrix, xy_2: Matrix, camera: Camera) -> Matrix:
    """Compute the ``(N,)`` signed Sampson errors of a motion, in pixels (Hartley and Zisserman,
    section 11.4.3)."""
    t = T_2_1[:3, 3] / np.linalg.norm(T_2_1[:3, 3])
    E = np.cross(t, T_2_1[:3, :3], axisb=0, axisc=0)
    ray_1, ray_2 = (camera.backproject(xy, np.ones(len(xy))) for xy in (xy_1, xy_2))
    line_2, line_1 = ray_1 @ E.T, ray_2 @ E
    spread = _squared(line_1[:, :2] / [camera.fx, camera.fy])
    spread += _squared(line_2[:, :2] / [camera.fx, camera.fy])
    return np.einsum("ni,ni->n", ray_2, line_2) / np.sqrt(np.maximum(spread, 1e-18))


def angles_after_rotation(xy_1: Matrix, xy_2: Matrix, camera: Camera) -> Matrix:
    """Compute the ``(N,)`` angles between the rays of two views, in radians, that are left after
    the rotation that explains most of them.

    They are a lower bound of the parallax that does not depend on an estimated translation. The
    parallax of a wrong translation can be large, because its points are too near.

    Args:
        xy_1, xy_2: ``(N, 2)`` matched pixels.
    """
    rays = [camera.backproject(xy, np.ones(len(xy))) for xy in (xy_1, xy_2)]
    one, two = (ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays)
    weight = np.ones(len(one))
    for _ in range(_ROTATIONS):
        U, _, Vt = np.linalg.svd((weight[:, None] * two).T @ one)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        angles = np.linalg.norm(two - one @ R.T, axis=1)
        # Least absolute differences by iteratively reweighted least squares
        weight = 1.0 / np.maximum(angles, max(float(np.median(angles)), 1e-9))
    return angles


def fit_models(
    xy_1: Matrix, xy_2: Matrix, sigma: Matrix, *, seed: int
) -> tuple[TwoViewModel, TwoViewModel]:
    """Fit a homography and a fundamental matrix to the matches (ORB-SLAM paper, section IV, step
    2).

    Args:
        xy_1, xy_2: ``(N, 2)`` matched pixels, N at least 8.
        sigma: ``(N,)`` standard deviation of these positions, pixels.
    """
    n = len(xy_1)
    x_1, N_1 = normalised(xy_1)
    x_2, N_2 = normalised(xy_2)
    rng = np.random.default_rng(seed)
    drawn = np.argpartition(rng.random((_DRAWS, n)), SAMPLE - 1, axis=1)[:, :SAMPLE]
    N_2_inverse = np.linalg.inv(N_2)

    def homographies(chosen: NDArray[np.integer]) -> Matrix:
        return N_2_inverse @ fit_homographies(x_1[chosen], x_2[chosen]) @ N_1

    def fundamentals(chosen: NDArray[np.integer]) -> Matrix:
        return N_2.T @ fit_fundamentals(x_1[chosen], x_2[chosen]) @ N_1

    found = []
    for fit, score_all in ((homographies, score_homographies), (fundamentals, score_fundamentals)):
        models = fit(drawn)
        scores, inlier = score_all(models, xy_1, xy_2, sigma)
        best = int(np.argmax(scores))
        M, score, explained = models[best], float(scores[best]), inlier[best]
        # Refitting a model to all its inliers usually gives a model with more inliers.
        while np.count_nonzero(explained) >= SAMPLE:
            refit = fit(np.flatnonzero(explained)[None])
            scores, inlier = score_all(refit, xy_1, xy_2, sigma)
            if scores[0] <= score:
                break
            M, score, explained = refit[0], float(scores[0]), inlier[0]
        found.append((M, explained))
    (H, inlier_H), (F, inlier_F) = found
    return TwoViewModel("homography", H, inlier_H), TwoViewModel("fundamental", F, inlier_F)


def normalised(xy: Matrix) -> tuple[Matrix, Matrix]:
    """Normalise ``(N, 2)`` points: their mean becomes 0, and their mean distance from it becomes
    the square root of 2 (Hartley, "In defense of the eight-point algorithm", PAMI 1997).

    Returns:
        The ``(N, 2)`` normalised points, and the ``(3, 3)`` matrix that normalises them.
    """
    centre = xy.mean(axis=0)
    spread = np.linalg.norm(xy - centre, axis=1).mean()
    scale = np.sqrt(2.0) / max(float(spread), 1e-12)
    N = np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
    return scale * (xy - centre), N


def fit_homographies(x_1: Matrix, x_2: Matrix) -> Matrix:
    """Fit a homography to each of B samples of M matches, using the DLT (Hartley and Zisserman,
    section 4.1). The points have shape ``(B, M, 2)``. Returns ``(B, 3, 3)`` matrices."""
    x, y, u, v = x_1[..., 0], x_1[..., 1], x_2[..., 0], x_2[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    above = np.stack([zero, zero, zero, -x, -y, -one, v * x, v * y, v], axis=-1)
    below = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1)
    return _null_vectors(np.concatenate([above, below], axis=1))


def fit_fundamentals(x_1: Matrix, x_2: Matrix) -> Matrix:
    """Fit a fundamental matrix to each of B samples of M matches, using the eight-point algorithm
    (Hartley and Zisserman, section 11.2). The points have shape ``(B, M, 2)``.

    Returns ``(B, 3, 3)`` matrices of rank 2. Each matrix F satisfies ``x_2' F x_1 = 0``.
    """
    x, y, u, v = x_1[..., 0], x_1[..., 1], x_2[..., 0], x_2[..., 1]
    A = np.stack([u * x, u * y, u, v * x, v * y, v, x, y, np.ones_like(x)], axis=-1)
    U, d, Vt = np.linalg.svd(_null_vectors(A))
    d[:, 2] = 0.0
    return (U * d[:, None, :]) @ Vt


def _null_vectors(A: Matrix) -> Matrix:
    """For each of B matrices A, find the unit vector h that minimises ``|A h|``. Returns ``(B, 3,
    3)``, each h reshaped to a 3x3 matrix."""
    _, vectors = np.linalg.eigh(A.swapaxes(1, 2) @ A)
    return vectors[:, :, 0].reshape(-1, 3, 3)


def score_homographies(
    H: Matrix, xy_1: Matrix, xy_2: Matrix, sigma: Matrix
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Score B homographies by the symmetric transfer error (section IV of the ORB-SLAM paper).
    Returns ``(B,)`` scores and a ``(B, N)`` bool mask of the inliers."""
    with np.errstate(all="ignore"):  # collinear samples give NaN errors, which score 0
        error_2 = _squared(_transferred(H, xy_1) - xy_2) / sigma**2
        error_1 = _squared(_transferred(_adjugates(H), xy_2) - xy_1) / sigma**2
    return _score(error_1, error_2, CHI2_MONO)


def score_fundamentals(
    F: Matrix, xy_1: Matrix, xy_2: Matrix, sigma: Matrix
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Score B fundamental matrices by the distances from the epipolar lines in both views (section
    IV of the ORB-SLAM paper). Returns ``(B,)`` scores and a ``(B, N)`` bool mask of the inliers.

    The inlier threshold is ``CHI2_LINE``, because the distance from a line has one degree of
    freedom. A perfect match has the same score as with a homography, so that the scores of both
    models can be compared.
    """
    one = np.ones((len(xy_1), 1))
    p_1, p_2 = np.hstack([xy_1, one]), np.hstack([xy_2, one])
    lines_2 = p_1 @ F.swapaxes(1, 2)  # (B, N, 3)
    lines_1 = p_2 @ F
    product = np.einsum("bni,ni->bn", lines_2, p_2) ** 2 / sigma**2
    with np.errstate(all="ignore"):
        error_2 = product / _squared(lines_2[..., :2])
        error_1 = product / _squared(lines_1[..., :2])
    return _score(error_1, error_2, CHI2_LINE)


def _score(error_1: Matrix, error_2: Matrix, limit: float) -> tuple[Matrix, NDArray[np.bool_]]:
    """Compute ``(B,)`` scores and a ``(B, N)`` bool mask of the inliers from the ``(B, N)``
    chi-square errors of B models in both views."""
    score = np.zeros(len(error_1))
    for error in (error_2, error_1):
        score += np.where(error < limit, CHI2_MONO - error, 0.0).sum(axis=1)
    return score, (error_1 < limit) & (error_2 < limit)


def _transferred(H: Matrix, xy: Matrix) -> Matrix:
    p = np.hstack([xy, np.ones((len(xy), 1))]) @ H.swapaxes(1, 2)
    return p[..., :2] / p[..., 2:]


def _adjugates(H: Matrix) -> Matrix:
    """Compute the adjugates of ``(B, 3, 3)`` matrices: their inverses up to scale, which exist even
    for singular matrices."""
    a, b, c = H[:, 0], H[:, 1], H[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)


def _squared(x: Matrix) -> Matrix:
    return np.einsum("...i,...i->...", x, x)


def motions_of_essential(E: Matrix) -> list[Matrix]:
    """Return the four candidate motions ``T_2_1`` of an essential matrix (Hartley and Zisserman,
    section 9.6.2)."""
    U, _, Vt = np.linalg.svd(E)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    s = np.linalg.det(U) * np.linalg.det(Vt)
    turns = (s * U @ W @ Vt, s * U @ W.T @ Vt)
    return [_motion(R, t) for R in turns for t in (U[:, 2], -U[:, 2])]


def motions_of_homography(A: Matrix) -> list[Matrix]:
    """Return the eight candidate motions ``T_2_1`` of a calibrated homography (Faugeras and
    Lustman, "Motion and structure from motion in a piecewise planar environment", 1988). The list
    is empty if two singular values are equal, for example for a pure rotation."""
    U, (d1, d2, d3), Vt = np.linalg.svd(A)
    if d1 / d2 < 1.00001 or d2 / d3 < 1.00001:
        return []
    s = np.linalg.det(U) * np.linalg.det(Vt)
    x1 = np.sqrt((d1**2 - d2**2) / (d1**2 - d3**2))
    x3 = np.sqrt((d2**2 - d3**2) / (d1**2 - d3**2))
    root = np.sqrt((d1**2 - d2**2) * (d2**2 - d3**2))
    motions = []
    for e1 in (1.0, -1.0):
        for e3 in (1.0, -1.0):
            # d' = d2 (eq. 13) and d' = -d2 (eq. 15).
            sin, cos = e1 * e3 * root / ((d1 + d3) * d2), (d2**2 + d1 * d3) / ((d1 + d3) * d2)
            R = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
            motions.append(_motion(s * U @ R @ Vt, U @ [e1 * x1, 0.0, -e3 * x3]))
            sin, cos = e1 * e3 * root / ((d1 - d3) * d2), (d1 * d3 - d2**2) / ((d1 - d3) * d2)
            R = np.array([[cos, 0.0, sin], [0.0, -1.0, 0.0], [sin, 0.0, -cos]])
            motions.append(_motion(s * U @ R @ Vt, U @ [e1 * x1, 0.0, e3 * x3]))
    return motions


def _motion(R: Matrix, t: Matrix) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t / np.linalg.norm(t)
    return T


def _triangulate(
    T_2_1: Matrix,
    xy_1: Matrix,
    xy_2: Matrix,
    sigma: Matrix,
    camera: Camera,
) -> tuple[Matrix, NDArray[np.bool_], Matrix]:
    """Triangulate N matches.

    Returns:
        ``(N, 3)`` points in the frame of camera 1; ``(N,)`` bool, True for points in front of both
        cameras with small reprojection errors; ``(N,)`` cosine of the parallax angle of each point.
    """
    R, t = T_2_1[:3, :3], T_2_1[:3, 3]
    ray_1 = camera.backproject(xy_1, np.ones(len(xy_1)))
    ray_2 = camera.backproject(xy_2, np.ones(len(xy_2))) @ R  # in the frame of camera 1
    centre_2 = -R.T @ t
    # Midpoint of the shortest segment between the rays.
    aa, bb, ab = _squared(ray_1), _squared(ray_2), np.einsum("ni,ni->n", ray_1, ray_2)
    on_1, on_2 = ray_1 @ centre_2, ray_2 @ centre_2
    with np.errstate(all="ignore"):  # parallel rays give NaN
        determinant = aa * bb - ab * ab
        depth_1 = (bb * on_1 - ab * on_2) / determinant
        depth_2 = (ab * on_1 - aa * on_2) / determinant
        points = 0.5 * (depth_1[:, None] * ray_1 + centre_2 + depth_2[:, None] * ray_2)
        in_2 = points @ R.T + t
        limit = (_MAX_ERROR * sigma) ** 2
        good = (depth_1 > 0) & (depth_2 > 0) & (points[:, 2] > 0) & (in_2[:, 2] > 0)
        good &= _squared(camera.project(points)[:, :2] - xy_1) < limit
        good &= _squared(camera.project(in_2)[:, :2] - xy_2) < limit
    return points, good, ab / np.sqrt(aa * bb)
