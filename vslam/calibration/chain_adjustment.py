"""Bundle adjustment of a camera, and of its motion and the scene in several chains of keyframes.

All chains have the same camera, but each has its own points and poses, of which the first is the
identity. Points and then poses are eliminated from the normal equations of each chain (Triggs et
al., "Bundle adjustment - a modern synthesis", section 6.1), so that a system of six unknowns
remains: the logarithm of the focal length, two radial coefficients, the principal point and the
read-out time. A point is ``R (a, b, 1) + rho t`` in the frame of a keyframe: it may be far away,
and its depth does not matter if the camera only turns (inverse depth, Civera et al., TRO 2008).

A rolling shutter exposes each row later than the row above it. To first order, a corner is
displaced by its own motion per frame, times its row, times the read-out time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Array, CameraModel, Lens, unproject, without_zeros

UNKNOWNS = 6
LOG_FOCAL, CENTRE, READ_OUT = 0, slice(3, 5), 5
"""Places of the logarithm of the focal length, the principal point and the read-out time among the
unknowns."""

NOISE_PX = 0.5
"""Error at which the weight of a corner is one half (Cauchy), in pixels of an image whose longer
side is 960 pixels or shorter. Corners are off by 0.2 pixels, and 2.4 standard deviations are as
good as least squares to 95 % (Holland and Welsch, "Robust regression using iteratively reweighted
least-squares", 1977)."""

# Standard deviations of what is known before: of both radial terms at the middle of the image's
# shorter borders, relative; of the principal point in longer sides of the image; and of the
# read-out time in intervals between frames. [own] The principal points of KITTI, EuRoC and TUM are
# off the middle by 0.2 to 2.5 % of the width. The radial terms are unknowns, and not their
# coefficients, because what is known before must not say anything about the focal length.
_DISTORTION, _CENTRE, _READ_OUT = 0.15, 0.01, 0.5
_USUAL = 0.3  # standard deviation of a coordinate of a corner, in `NOISE_PX` [own]
_NEAREST_Z = 0.1  # cosine of the largest angle from the axis at which a chain can begin: 84 degrees
_FEWEST = 20  # matches of the first and the last keyframe
_MOST_RHO = 5.0  # inverse depth, in distances between the first and the last keyframe
_BEHIND = 100.0  # squared error of a point behind a camera, in squared `NOISE_PX`
_DAMPING, _MOST_DAMPING = 1e-3, 1e6
_CONVERGED = 1e-5  # relative decrease of the cost
_LONGEST_STEP = 0.3  # of the logarithm of the focal length


@dataclass(frozen=True)
class Corners:
    """Corners in C chains of K keyframes, at most N in each.

    Attributes:
        xy: ``(C, K, N, 2)`` float64 pixels, NaN where a corner is not seen.
        late: ``(C, K, N, 2)`` float64 displacement of the corners in pixels by a rolling shutter
            whose read-out takes the whole interval between two frames.
        noise: scale of the errors in pixels.
    """

    xy: Array
    late: Array
    noise: float

    def of(self, chains: NDArray[Any], every: int = 1) -> Corners:
        """Return some of the chains, with every n-th corner."""
        return replace(self, xy=self.xy[chains, :, ::every], late=self.late[chains, :, ::every])


@dataclass(frozen=True)
class Scenes:
    """Poses ``(C, K, 3, 3)`` and ``(C, K, 3)``, and points ``(C, N, 3)``: a, b, rho."""

    R: Array
    t: Array
    points: Array


@dataclass(frozen=True)
class Adjusted:
    """The result of a bundle adjustment.

    Attributes:
        camera: the camera; its first two distortion coefficients are not 0.
        read_out: time between the first and the last row, in intervals between frames.
        scenes: motion and scene of each chain.
        costs: ``(C,)`` robust cost of each chain in square pixels.
        cost: their sum, and the cost of deviations from what is known before.
        information: ``(C, 6, 6)`` float64, what each chain says about the unknowns, in square
            pixels.
        gradient: ``(C, 6)`` float64 gradients of the halved costs by the unknowns, after motion and
            scene are adapted. Their sum is 0.
        prior: ``(6,)`` float64 information before the first chain, in square pixels.
        prior_variance: of a coordinate of a corner, as assumed for the prior, in square pixels.
        variance: of one coordinate of a corner, in square pixels.
    """

    camera: CameraModel
    read_out: float
    scenes: Scenes
    costs: Array
    cost: float
    information: Array
    gradient: Array
    prior: Array
    prior_variance: float
    variance: float


def begin(camera: CameraModel, corners: Corners) -> Scenes:
    """Estimate motion and scene of each chain from its first and last keyframe, by the five-point
    algorithm in RANSAC. The poses between them are interpolated. The points of a chain are NaN if
    this fails."""
    C, K, N, _ = corners.xy.shape
    R, t = np.tile(np.eye(3), (C, K, 1, 1)), np.zeros((C, K, 3))
    points = np.full((C, N, 3), np.nan)
    model = replace(camera, distortion=without_zeros(camera.lens, camera.distortion))
    for c, xy in enumerate(corners.xy):
        rays = unproject(model, xy[[0, -1]].reshape(-1, 2)).reshape(2, N, 3)
        with np.errstate(invalid="ignore"):
            rays[~(rays[..., 2] > _NEAREST_Z)] = np.nan
        plane = rays / rays[..., 2:]
        both = ~np.isnan(plane[..., 0]).any(axis=0)
        found = _relative_pose(plane[0, both], plane[1, both], corners.noise / camera.fx)
        if found is None:
            continue
        turn, shift = found
        R_last = cv2.Rodrigues(turn)[0]
        for k in range(1, K):
            share = k / (K - 1)
            R[c, k], t[c, k] = cv2.Rodrigues(share * turn)[0], share * shift
        last = rays[1, both]
        across, along = np.cross(last, plane[0, both] @ R_last.T), np.cross(last, shift)
        rho = -np.einsum("ni,ni->n", across, along) / np.einsum("ni,ni->n", along, along)
        rho = np.clip(np.nan_to_num(rho), 0.0, _MOST_RHO)
        points[c, :, :2] = plane[0, :, :2]
        points[c, :, 2] = np.median(rho)
        points[c, both, 2] = rho
    return Scenes(R, t, points)


def _relative_pose(one: Array, two: Array, noise: float) -> tuple[Array, Array] | None:
    """Return the rotation vector and the direction of the translation between two views."""
    if len(one) < _FEWEST:
        return None
    K = np.eye(3)
    cv2.setRNGSeed(0)
    E, inliers = cv2.findEssentialMat(one[:, :2], two[:, :2], K, cv2.USAC_ACCURATE, 0.999, noise)
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, one[:, :2], two[:, :2], K, mask=inliers)
    turn = np.asarray(cv2.Rodrigues(R)[0].ravel(), np.float64)
    return turn, np.asarray(t.ravel(), np.float64)


def adjust(
    camera: CameraModel,
    scenes: Scenes,
    corners: Corners,
    iterations: int,
    *,
    read_out: float = 0.0,
    free: Sequence[int] = range(UNKNOWNS),
    turning: bool = False,
) -> Adjusted:
    """Minimise the robust reprojection error by Levenberg-Marquardt.

    Args:
        camera: start. Its focal lengths are equal, and all but the first two distortion
            coefficients are 0.
        free: places of the unknowns of the camera that are estimated; the others stay.
        turning: whether the camera turns on the spot in all chains, so that depths do not matter.
    """
    if turning:
        points = scenes.points * [1.0, 1.0, 0.0]
        scenes = replace(scenes, t=np.zeros_like(scenes.t), points=points)
    state = _State(camera, read_out, scenes, corners, turning)
    damping = _DAMPING
    for _ in range(iterations):
        equations = _Equations(state)
        while damping < _MOST_DAMPING:
            trial = equations.step(damping, list(free))
            if trial.cost <= state.cost:
                break
            damping *= 10.0
        else:
            break
        decrease, state = 1.0 - trial.cost / max(state.cost, 1e-12), trial
        damping = max(damping / 5.0, 1e-7)
        if decrease < _CONVERGED:
            break
    information, gradient = _Equations(state).reduced()
    variance = np.sum(state.weights * state.squared) / max(2 * np.count_nonzero(state.weights), 1)
    return Adjusted(
        state.camera, state.read_out, state.scenes, state.costs, state.cost, information, gradient,
        state.prior, (_USUAL * corners.noise) ** 2, float(variance),
    )  # fmt: skip


class _State:
    """An estimate, with its errors. It is not changed after it was made."""

    def __init__(
        self,
        camera: CameraModel,
        read_out: float,
        scenes: Scenes,
        corners: Corners,
        turning: bool,
    ) -> None:
        self.turning = turning
        self.camera, self.read_out, self.scenes, self.corners = camera, read_out, scenes, corners
        size = camera.width, camera.height
        off = np.array([camera.cx, camera.cy]) - (np.array(size) - 1.0) / 2.0
        self.powers = (max(size) / 2.0 / camera.fx) ** np.array([2.0, 4.0])
        self.radial = np.array(camera.distortion[:2]) * self.powers
        self.unknowns = np.array([0.0, *self.radial, *off, read_out])
        sigma = np.array([_DISTORTION] * 2 + [_CENTRE * max(size)] * 2 + [_READ_OUT])
        self.prior = np.r_[0.0, (_USUAL * corners.noise) ** 2 / sigma**2]
        points = scenes.points
        one = np.concatenate([points[..., :2], np.ones((*points.shape[:2], 1))], axis=-1)
        self.turned = one[:, None] @ scenes.R.swapaxes(2, 3)
        self.seen_at = self.turned + points[:, None, :, 2:] * scenes.t[:, :, None]
        self.ratio, self.ratio_by_point, self.ratio_by_k = _ratio(
            camera.lens, camera.distortion, self.seen_at
        )
        xy = camera.fx * self.ratio[..., None] * self.seen_at[..., :2] + (camera.cx, camera.cy)
        errors = corners.xy - read_out * corners.late - xy
        squared = np.einsum("ckni,ckni->ckn", errors, errors)
        seen, behind = ~np.isnan(corners.xy[..., 0]), np.isnan(squared)
        scale = corners.noise**2
        loss = scale * np.log1p(np.where(behind, _BEHIND, squared / scale))
        self.costs = np.where(seen, loss, 0.0).sum(axis=(1, 2))
        self.cost = float(self.costs.sum() + self.prior @ self.unknowns**2)
        self.errors = np.where(behind[..., None], 0.0, errors)
        self.squared = np.where(behind, 0.0, squared)
        self.weights = np.where(behind, 0.0, 1.0 / (1.0 + self.squared / scale))


class _Equations:
    """The normal equations of each chain at an estimate."""

    def __init__(self, state: _State) -> None:
        self._state = state
        camera, w, e = state.camera, state.weights, state.errors
        C, K, N = w.shape
        by_point = state.seen_at[..., :2, None] * state.ratio_by_point[..., None, :]
        by_point[..., 0, 0] += state.ratio
        by_point[..., 1, 1] += state.ratio
        by_point = _where(w, camera.fx * by_point)  # (C, K, N, 2, 3)
        R, t, rho = state.scenes.R, state.scenes.t, state.scenes.points[..., 2]
        directions = np.stack([R[..., 0], R[..., 1], t], axis=-1)  # (C, K, 3, 3)
        J_point = _where(w, by_point @ directions[:, :, None])
        turning = np.cross(state.turned[..., None, :], by_point)
        J_pose = np.concatenate([turning, by_point * rho[:, None, :, None, None]], axis=-1)
        J_pose = _where(w, J_pose)[:, 1:]
        if state.turning:
            J_point[..., 2] = 0.0  # depth and translation stay 0
            J_pose[..., 3:] = 0.0
        J_camera = np.zeros((C, K, N, 2, UNKNOWNS))
        across = camera.fx * state.seen_at[..., :2]
        by_radial = state.ratio_by_k / state.powers
        stretch = state.ratio + by_radial @ ([2.0, 4.0] * state.radial)
        J_camera[..., LOG_FOCAL] = across * stretch[..., None]
        J_camera[..., 1] = across * by_radial[..., :1]
        J_camera[..., 2] = across * by_radial[..., 1:]
        J_camera[..., 0, 3] = J_camera[..., 1, 4] = 1.0
        J_camera[..., READ_OUT] = state.corners.late
        J_camera = _where(w, J_camera)
        root = np.sqrt(w)[..., None]
        J_point, J_pose = root[..., None] * J_point, root[:, 1:, :, :, None] * J_pose
        J_camera, e = root[..., None] * J_camera, root * e
        by_corner = J_point.transpose(0, 2, 4, 1, 3).reshape(C, N, 3, 2 * K)
        self._points = by_corner @ by_corner.swapaxes(2, 3)
        self._b_points = (by_corner @ e.swapaxes(1, 2).reshape(C, N, 2 * K, 1))[..., 0]
        self._n = n = 6 * (K - 1)
        by_pose = J_pose.reshape(C, K - 1, 2 * N, 6).swapaxes(2, 3)
        by_camera = J_camera.reshape(C, K, 2 * N, UNKNOWNS)
        poses = by_pose @ by_pose.swapaxes(2, 3)
        mixed = (by_pose @ by_camera[:, 1:]).reshape(C, n, UNKNOWNS)
        self._rest = np.zeros((C, n + UNKNOWNS, n + UNKNOWNS))
        for k in range(K - 1):
            at = slice(6 * k, 6 * k + 6)
            self._rest[:, at, at] = poses[:, k]
        self._rest[:, :n, n:], self._rest[:, n:, :n] = mixed, mixed.swapaxes(1, 2)
        flat = by_camera.reshape(C, -1, UNKNOWNS).swapaxes(1, 2)
        self._rest[:, n:, n:] = flat @ flat.swapaxes(1, 2)
        of_poses = by_pose @ e[:, 1:].reshape(C, K - 1, 2 * N, 1)
        of_camera = flat @ e.reshape(C, -1, 1)
        self._b_rest = np.concatenate([of_poses.reshape(C, n), of_camera[..., 0]], axis=1)
        couple = _products(J_pose, J_point[:, 1:]).transpose(0, 1, 3, 2, 4).reshape(C, n, N, 3)
        camera_point = _products(J_camera, J_point).sum(axis=1).swapaxes(1, 2)
        self._coupling = np.concatenate([couple, camera_point], axis=1)

    def _eliminated(self, damping: float) -> tuple[Array, Array, Array, Array]:
        """Eliminate points and poses.

        Returns:
            ``(C, 6, 6)`` and ``(C, 6)``, the system of the camera; ``(C, N, 3, 3)`` inverses of the
            points' blocks; ``(C, n, 7)``, the steps of the poses for no step of the camera (last
            column), and by how much a step of the camera changes them.
        """
        n, eye = self._n, np.eye(3)
        diagonal = damping * np.einsum("cnaa->cna", self._points)[..., None]
        inverses = np.linalg.inv(self._points + (diagonal + 1e-9) * eye)
        C, m = self._b_rest.shape
        coupling = self._coupling.reshape(C, m, -1)
        weighted = (self._coupling.swapaxes(1, 2) @ inverses).swapaxes(1, 2).reshape(C, m, -1)
        A = self._rest - weighted @ coupling.swapaxes(1, 2)
        b = self._b_rest - (weighted @ self._b_points.reshape(C, -1, 1))[..., 0]
        added = damping * np.einsum("caa->ca", self._rest)[:, :n] + 1e-9
        right = np.concatenate([A[:, :n, n:], b[:, :n, None]], axis=2)
        X = np.linalg.solve(A[:, :n, :n] + added[..., None] * np.eye(n), right)
        H = A[:, n:, n:] - A[:, n:, :n] @ X[..., :UNKNOWNS]
        g = b[:, n:] - np.einsum("cia,ca->ci", A[:, n:, :n], X[..., UNKNOWNS])
        return H, g, inverses, X

    def reduced(self) -> tuple[Array, Array]:
        """Return the information of each chain about the camera, and its gradient."""
        H, g, _, _ = self._eliminated(1e-7)
        return H, g

    def step(self, damping: float, free: list[int]) -> _State:
        """Return the estimate after a step."""
        state, C = self._state, len(self._b_rest)
        H, g, inverses, X = self._eliminated(damping)
        move = np.zeros(UNKNOWNS)
        if free:
            total = H.sum(axis=0) + np.diag(state.prior)
            total += damping * np.diag(np.diag(total))
            right = g.sum(axis=0) - state.prior * state.unknowns
            move[free] = np.linalg.solve(total[np.ix_(free, free)], right[free])
            move[LOG_FOCAL] = np.clip(move[LOG_FOCAL], -_LONGEST_STEP, _LONGEST_STEP)
        poses = X[..., UNKNOWNS] - X[..., :UNKNOWNS] @ move
        rest = np.concatenate([poses, np.tile(move, (C, 1))], axis=1)
        coupling = self._coupling.reshape(C, rest.shape[1], -1).swapaxes(1, 2)
        left = self._b_points - (coupling @ rest[..., None]).reshape(self._b_points.shape)
        points = np.einsum("cnab,cnb->cna", inverses, left)
        camera, growth = state.camera, float(np.exp(move[LOG_FOCAL]))
        focal, k = camera.fx * growth, (state.radial + move[1:3]) / state.powers
        moved = replace(
            camera, fx=focal, fy=focal, cx=camera.cx + float(move[3]),
            cy=camera.cy + float(move[4]),
            distortion=(float(k[0]) * growth**2, float(k[1]) * growth**4, 0.0, 0.0),
        )  # fmt: skip
        by_keyframe = poses.reshape(C, -1, 6)
        R, t = state.scenes.R.copy(), state.scenes.t.copy()
        R[:, 1:] = _rotations(by_keyframe[..., :3]) @ R[:, 1:]
        t[:, 1:] += by_keyframe[..., 3:]
        scenes = Scenes(R, t, state.scenes.points + points)
        return _State(
            moved, state.read_out + float(move[READ_OUT]), scenes, state.corners, state.turning
        )


def _products(one: Array, two: Array) -> Array:
    """Multiply the transposed ``(..., 2, a)`` matrices with the ``(..., 2, b)`` matrices."""
    first = one[..., 0, :, None] * two[..., 0, None, :]
    return np.asarray(first + one[..., 1, :, None] * two[..., 1, None, :])


def _where(weights: Array, J: Array) -> Array:
    return np.where(weights[..., None, None] > 0.0, J, 0.0)


def _rotations(turns: Array) -> Array:
    rotations = np.array([cv2.Rodrigues(turn)[0] for turn in turns.reshape(-1, 3)], np.float64)
    return rotations.reshape(*turns.shape, 3)


def _ratio(lens: Lens, distortion: tuple[float, ...], points: Array) -> tuple[Array, Array, Array]:
    """Return the ratio m with which a camera of focal length 1 projects a point (X, Y, Z) to
    m (X, Y), for points of shape ``(..., 3)``; its gradient by the point, ``(..., 3)``; and its
    derivatives by the first two coefficients, ``(..., 2)``. NaN for points behind a pinhole."""
    k1, k2 = distortion[:2]
    X, Y, Z = np.moveaxis(points, -1, 0)
    if lens == "pinhole":
        with np.errstate(invalid="ignore"):
            Z = np.where(Z > 1e-3, Z, np.nan)
        r2 = (X * X + Y * Y) / (Z * Z)
        m, slope = (1.0 + r2 * (k1 + k2 * r2)) / Z, 2.0 * (k1 + 2.0 * k2 * r2) / Z**3
        by_point = np.stack([slope * X, slope * Y, -m / Z - slope * r2 * Z], axis=-1)
        return m, by_point, np.stack([r2 / Z, r2 * r2 / Z], axis=-1)
    a2 = np.maximum(X * X + Y * Y, 1e-18)
    across = np.sqrt(a2)
    angle = np.arctan2(across, Z)
    q, n2 = angle * angle, a2 + Z * Z
    m = angle * (1.0 + q * (k1 + k2 * q)) / across
    slope = 1.0 + q * (3.0 * k1 + 5.0 * k2 * q)
    along = (slope * Z / n2 - m) / a2
    by_point = np.stack([along * X, along * Y, -slope / n2], axis=-1)
    return m, by_point, np.stack([angle**3, angle**5], axis=-1) / across[..., None]
