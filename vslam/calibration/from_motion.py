"""Estimates the focal length and the distortion of one camera from how it moves.

The camera is the one with which its motion and the scene explain the followed corners best
(self-calibration by bundle adjustment, `vslam.calibration.chain_adjustment`). Because a bundle
adjustment only finds the minimum near its start, the field of view is scanned first, for a pinhole
camera and for a fisheye lens.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from vslam.calibration.chain_adjustment import (
    LOG_FOCAL,
    NOISE_PX,
    UNKNOWNS,
    Adjusted,
    Corners,
    Scenes,
    adjust,
    begin,
)
from vslam.calibration.chains import KEYFRAMES, LARGEST, Chain, chains_of
from vslam.calibration.models import CameraModel, Lens, unproject
from vslam.support.errors import InputError
from vslam.types.camera import Image

_MOST_CHAINS, _SCANNED = 24, 8  # chains that are adjusted, and chains with which views are scanned
_MOST_POINTS = 160  # of a chain
_SCAN_ITERATIONS, _ITERATIONS, _CHECK_ITERATIONS = 4, 40, 20
# Fields of view along the longer side that are tried, in degrees. Neighbours differ by 10 to 30 %
# in focal length.
_VIEWS: dict[Lens, tuple[float, ...]] = {
    "pinhole": tuple(np.geomspace(20.0, 125.0, 13).tolist()),
    "fisheye": tuple(np.geomspace(90.0, 200.0, 6).tolist()),
}
_WIDE = 80.0  # degrees; narrower lenses are no fisheye lenses
_WIDER = 0.9  # ratio of the costs below which a fisheye lens is preferred to a pinhole camera [own]
# Ratio of the costs below which the camera turns on the spot. Without parallax, depths reduce the
# cost by a ninth. [own]
_NO_PARALLAX = 1.2
# Change of the logarithm of the focal length that must raise the cost by this share of what the
# standard deviation predicts. [own]
_OTHER, _LEAST_RISE = 0.2, 0.25
_MOST_MINIMA, _BETTER = 3, 1e-3  # local minima that are left, and the least reduction of the cost
# The errors of a corner in the keyframes of a chain are not independent, because all are found by
# the same patch, which does not deform quite affinely. This is the variance of their mean, relative
# to independent errors, if half of the keyframes have the same error. [own]
_DRIFT = KEYFRAMES / 2.0
_TWO_SIGMAS = 0.975  # share of the distribution below two standard deviations
_LITTLE = 1e-9  # relative information of the other chains, if a chain tells all
_LEAST_KNOWN = 0.05  # largest standard deviation of the focal length, relative [own]
_FEWEST_FOR_ZOOM = 6  # chains
_ZOOM, _ZOOM_SIGMAS = 0.05, 4.0  # relative change of the focal length that is a zoom [own]
_ROLLING = 0.15  # read-out time in frame intervals that is a rolling shutter [own]


@dataclass(frozen=True)
class StatedFocalLength:
    """The focal length that a file states.

    Attributes:
        focal: pixels.
        sigma: its standard deviation, relative.
        where: which data state it, such as "EXIF".
    """

    focal: float
    sigma: float
    where: str


@dataclass(frozen=True)
class MotionFit:
    """A camera that was estimated from motion.

    Attributes:
        camera: the camera, with ``k1 k2`` (pinhole: ``k1 k2 0 0``; fisheye: ``k1 k2 0 0``).
        sigma: standard deviation of the focal length, relative.
        view: horizontal field of view in degrees.
        read_out: time between the exposure of the first and of the last row, in intervals between
            frames. 0 for a global shutter.
        chains: number of chains of keyframes. 0 if the focal length is the one that a file states,
            because the motion does not determine it.
        zoomed: relative change of the focal length from the first half to the second half of the
            images; 0 if it is not significant.
        stated_in: which data state the focal length, if the motion does not determine it.
    """

    camera: CameraModel
    sigma: float
    view: float
    read_out: float
    chains: int
    zoomed: float = 0.0
    stated_in: str = ""

    def __str__(self) -> str:
        fisheye = ", fisheye lens" if self.camera.lens == "fisheye" else ""
        stated = f" (from {self.stated_in}, because the motion does not tell it)"
        return (
            f"focal length {self.camera.fx:.1f} px, standard deviation {100 * self.sigma:.1f} %, "
            f"field of view {self.view:.0f} degrees{fisheye}{stated if self.stated_in else ''}"
        )

    def warnings(self) -> list[str]:
        found = []
        if self.zoomed:
            found.append(
                f"the lens zooms: the focal length changes by {100 * self.zoomed:+.0f} % from the "
                "first to the second half; film without zoom and without autofocus."
            )
        if abs(self.read_out) > _ROLLING:
            found.append(
                "the camera has a rolling shutter, whose rows are read within "
                f"{self.read_out:.1f} frame intervals; turn it slowly."
            )
        return found


def camera_from_motion(
    images: Iterable[tuple[float, Image]],
    size: tuple[int, int],
    source: str,
    stated: StatedFocalLength | None = None,
) -> MotionFit:
    """Estimate a camera from the images of a moving camera. The same images give the same camera.

    Args:
        images: time in seconds and ``(H, W)`` uint8 image of each frame.
        size: width and height of the images.
        source: name of the images, for error messages.
        stated: focal length that a file states, which is used if the motion does not determine it.
            None if there is none.

    Raises:
        InputError: the motion does not determine the focal length.
    """
    try:
        return camera_from_chains(list(chains_of(images)), size, source)
    except InputError:
        if stated is None:
            raise
    centre = round((size[0] - 1) / 2.0, 3), round((size[1] - 1) / 2.0, 3)
    camera = CameraModel(stated.focal, stated.focal, *centre, *size)
    return MotionFit(camera, stated.sigma, _view(camera), 0.0, 0, stated_in=stated.where)


def camera_from_chains(chains: Sequence[Chain], size: tuple[int, int], source: str) -> MotionFit:
    """Estimate a camera from the corners that were followed through its images.

    Args:
        chains: in the order of their times.
        size: width and height of the images.
        source: name of the images, for error messages.

    Raises:
        InputError: the motion does not determine the focal length.
    """
    if not chains:
        raise InputError(
            f"{source}: corners cannot be followed through the images, or the camera hardly moves, "
            f"so the focal length is unknown; {_FIX}."
        )
    chosen = [chains[k] for k in _spread(len(chains), _MOST_CHAINS)]
    fit = _best_fit(_stacked(chosen, size), size)
    sigma = focal_sigma(fit.found)
    if not sigma <= _LEAST_KNOWN or _is_flat(fit, sigma):
        raise InputError(f"{source}: {_reason(fit.found)}, so the focal length is unknown; {_FIX}.")
    camera = _rounded(fit.found.camera)
    return MotionFit(
        camera, sigma, _view(camera), fit.found.read_out, len(fit.found.costs), _zoom(fit)
    )


_FIX = (
    "film again while walking sideways and turning, or write the focal length into a calibration "
    "file (docs/howto/cameras.md)"
)


def _spread(n: int, most: int) -> list[int]:
    return sorted(set(np.linspace(0, n - 1, min(n, most)).round().astype(int).tolist()))


def _stacked(chains: Sequence[Chain], size: tuple[int, int]) -> Corners:
    xy = np.full((len(chains), KEYFRAMES, _MOST_POINTS, 2), np.nan)
    late = np.zeros_like(xy)
    for k, chain in enumerate(chains):
        rows = _spread(chain.xy.shape[1], _MOST_POINTS)
        xy[k, :, : len(rows)], late[k, :, : len(rows)] = chain.xy[:, rows], chain.flow[:, rows]
    row = (xy[..., 1:] - (size[1] - 1) / 2.0) / size[1]
    return Corners(xy, np.nan_to_num(row * late), NOISE_PX * max(1.0, max(size) / LARGEST))


@dataclass(frozen=True)
class _Fit:
    """The result of a bundle adjustment, and its input."""

    found: Adjusted
    corners: Corners
    turning: bool

    def again(self, chains: NDArray[np.int64], log_focal: float, free: Sequence[int]) -> Adjusted:
        """Adjust some of the chains again, from a focal length that is longer by ``log_focal``."""
        old, longer = self.found, float(np.exp(log_focal))
        k1, k2, *rest = old.camera.distortion
        camera = replace(
            old.camera, fx=longer * old.camera.fx, fy=longer * old.camera.fy,
            distortion=(k1 * longer**2, k2 * longer**4, *rest),
        )  # fmt: skip
        scenes = Scenes(*(part[chains] for part in (old.scenes.R, old.scenes.t, old.scenes.points)))
        return adjust(
            camera, scenes, self.corners.of(chains), _CHECK_ITERATIONS,
            read_out=old.read_out, free=free, turning=self.turning,
        )  # fmt: skip


def _best_fit(corners: Corners, size: tuple[int, int]) -> _Fit:
    few = corners.of(np.array(_spread(len(corners.xy), _SCANNED)), every=2)
    fits: list[_Fit] = []
    for lens, views in _VIEWS.items():
        tried = [
            adjust(camera, begin(camera, few), few, _SCAN_ITERATIONS, free=())
            for camera in (_camera(lens, view, size) for view in views)
        ]
        best = min(tried, key=lambda one: one.cost).camera
        fits.append(_Fit(adjust(best, begin(best, corners), corners, _ITERATIONS), corners, False))
    pinhole, fisheye = fits
    wide = _view(fisheye.found.camera) > _WIDE
    better = wide and fisheye.found.cost < _WIDER * pinhole.found.cost
    moving = fisheye if better else pinhole
    moving = _without_local_minima(moving)
    start = moving.found
    turning = adjust(start.camera, start.scenes, corners, _ITERATIONS, turning=True)
    if turning.cost < _NO_PARALLAX * start.cost:
        return _Fit(turning, corners, True)
    return moving


def _without_local_minima(fit: _Fit) -> _Fit:
    """Adjust again from shorter and longer focal lengths, as long as that reduces the cost."""
    everything = np.arange(len(fit.found.costs))
    for _ in range(_MOST_MINIMA):
        tried = [fit.again(everything, step, range(UNKNOWNS)) for step in (-_OTHER, _OTHER)]
        best = min(tried, key=lambda one: one.cost)
        if best.cost > (1.0 - _BETTER) * fit.found.cost:
            break
        fit = replace(fit, found=best)
    return fit


def _is_flat(fit: _Fit, sigma: float) -> bool:
    """Return whether other focal lengths explain the images nearly as well, although the error
    grows quickly near the best one: with noise, some focal length is always the best."""
    everything = np.arange(len(fit.found.costs))
    others = [k for k in range(UNKNOWNS) if k != LOG_FOCAL]
    for log_focal in (-_OTHER, _OTHER):
        cost = fit.again(everything, log_focal, others).cost
        if cost - fit.found.cost < _LEAST_RISE * (_OTHER / sigma) ** 2 * fit.found.variance:
            return True
    return False


def _camera(lens: Lens, view: float, size: tuple[int, int]) -> CameraModel:
    half = np.radians(view) / 2.0
    focal = float(max(size) / 2.0 / (half if lens == "fisheye" else np.tan(half)))
    centre = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    return CameraModel(focal, focal, *centre, *size, lens, (0.0,) * 4)


def focal_sigma(found: Adjusted) -> float:
    """Return the relative standard deviation of the focal length, infinite for a single chain.

    It is the sum of what the chains disagree by, of what the noise of the corners causes, and of
    what is not exactly known before. Differences between chains contain that noise, too, but not
    the errors that are common to all chains, which follow the same things in the same kind of
    motion: counting the noise twice stands for them. [own]

    The chains are left out one after the other (jackknife), because the estimate follows those that
    tell most: cluster-robust variance CV3 of MacKinnon, Nielsen and Webb, "Cluster-robust
    inference: a guide to empirical practice", 2023, to first order. A few chains may agree by
    chance: twice the result is the distance of Student's distribution within which 95 % lie, with
    the degrees of freedom of Bell and McCaffrey, "Bias reduction in standard errors for linear
    regression with multi-stage samples", 2002.
    """
    H, C = found.information, len(found.gradient)
    if C < 2:
        return float("inf")
    total = H.sum(axis=0) + np.diag(found.prior)
    covariance = np.linalg.inv(total)
    known = (found.prior_variance * found.prior) @ covariance[LOG_FOCAL] ** 2
    formal = _DRIFT * found.variance * (covariance @ H.sum(axis=0) @ covariance)[LOG_FOCAL]
    without = np.linalg.inv(total - H + _LITTLE * np.diag(np.diag(total)))[:, LOG_FOCAL]
    moved = np.einsum("ca,ca->c", without, found.gradient)
    # The covariance of the steps by which the estimate moves, if all corners had the same noise.
    through = np.einsum("ca,cab->cb", without, H)
    steps = np.diag(np.einsum("ca,ca->c", through, without)) - through @ covariance @ through.T
    freedom = np.trace(steps) ** 2 / np.sum(steps**2)
    few = stdtrit(freedom, _TWO_SIGMAS) / ndtri(_TWO_SIGMAS)
    between = few**2 * (moved @ moved) * (C - 1) / C
    return float(np.sqrt(between + formal[LOG_FOCAL] + known))


def _zoom(fit: _Fit) -> float:
    """Compare the focal length of the first half of the chains with that of the second half."""
    C = len(fit.found.costs)
    if C < _FEWEST_FOR_ZOOM:
        return 0.0
    halves = [fit.again(part, 0.0, range(UNKNOWNS)) for part in np.array_split(np.arange(C), 2)]
    first, second = (half.camera.fx for half in halves)
    change = float(np.log(second / first))
    sigma = float(np.linalg.norm([focal_sigma(half) for half in halves]))
    return second / first - 1.0 if abs(change) > max(_ZOOM, _ZOOM_SIGMAS * sigma) else 0.0


def _reason(found: Adjusted) -> str:
    """Say why the motion does not determine the focal length."""
    R, t = found.scenes.R[:, -1], found.scenes.t[:, -1]
    angle = np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    ahead = np.abs(t[:, 2]) / np.maximum(np.linalg.norm(t, axis=1), 1e-12)
    if np.median(ahead) > 0.95 and np.median(angle) < 3.0:
        return "the camera moves straight ahead and hardly turns"
    return "the camera turns and moves too little, or sees only a plane"


def _view(camera: CameraModel) -> float:
    edges = np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]])
    rays = unproject(camera, edges)
    if np.isnan(rays).any():
        rays = unproject(replace(camera, distortion=(0.0,) * 4), edges)
    return float(
        np.degrees(np.arctan2(rays[1, 0], rays[1, 2]) - np.arctan2(rays[0, 0], rays[0, 2]))
    )


def _rounded(camera: CameraModel) -> CameraModel:
    focal = round(camera.fx, 3)
    return replace(
        camera, fx=focal, fy=focal, cx=round(camera.cx, 3), cy=round(camera.cy, 3),
        distortion=tuple(round(k, 6) for k in camera.distortion),
    )  # fmt: skip
