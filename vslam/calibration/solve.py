"""Estimation of cameras, and of the transformation between two, from views of a board.

OpenCV estimates the cameras. This module selects views, drops those that do not fit, and measures
residuals with vslam's own camera models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vslam.calibration.boards import Board, View, board_points
from vslam.calibration.models import Array, Calibration, CameraModel, Lens, project
from vslam.errors import InputError, counted
from vslam.geometry import inverse, se3_exp, transform

Size = tuple[int, int]
Frame = tuple[View | None, ...]  # the view of each camera; None if it does not see the board

_MOST_FRAMES = 60
_FEWEST_VIEWS = 3  # for 8 unknowns of the camera and 6 of each view
_OUTLIER = 3.0  # times the median error of all views
_NO_FIT = 0.01  # RMS in image widths; the corners must be those of another board
_FEWEST_COMMON = 6  # corners that both images of a pair show
_SAME_VIEW = 0.02  # image sizes by which the outline of the board moves at least


@dataclass(frozen=True)
class CameraFit:
    """A camera, estimated from V views.

    Attributes:
        model: the camera.
        views: the V views.
        residuals: for each view, ``(N, 2)`` float64 pixels: the corners in the image minus the
            projected corners of the board.
        T_camera_board: ``(V, 4, 4)`` float64.
        dropped: names of views that do not fit, with their RMS errors in pixels.
    """

    model: CameraModel
    views: tuple[View, ...]
    residuals: tuple[Array, ...]
    T_camera_board: Array
    dropped: tuple[tuple[str, float], ...] = ()

    @property
    def errors(self) -> Array:
        """``(V,)`` float64, the RMS error of each view in pixels."""
        return np.array([rms(residuals) for residuals in self.residuals])


@dataclass(frozen=True)
class PairFit:
    """The transformation between two cameras, estimated from P pairs of views.

    Attributes:
        T_left_right: ``(4, 4)`` float64, maps points of the right camera to the left one.
        errors: ``(P,)`` float64, for each pair the RMS distance in pixels between the corners in
            the right image and those predicted from the left image.
        dropped: names of pairs that do not fit, with their errors.
    """

    T_left_right: Array
    errors: Array
    dropped: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Estimate:
    """One camera, or the two of a stereo pair (left first) and the transformation between them."""

    cameras: tuple[CameraFit, ...]
    pair: PairFit | None = None

    @property
    def calibration(self) -> Calibration:
        """The cameras without the data that they were estimated from."""
        models = [fit.model for fit in self.cameras]
        return Calibration(
            *models, T_left_right=None if self.pair is None else self.pair.T_left_right
        )


def rms(residuals: Array) -> float:
    """Root mean square of the lengths of ``(N, 2)`` residuals."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def estimate(board: Board, frames: Sequence[Frame], sizes: Sequence[Size], lens: Lens) -> Estimate:
    """Estimate one camera, or a stereo pair if there are two ``sizes``.

    Args:
        board: the board in the images.
        frames: the views of every image or pair of images; corners of a pair must be numbered
            alike (`vslam.calibration.boards.same_order`).
        sizes: width and height of each camera's images.
        lens: the model of all cameras.

    Raises:
        InputError: a camera does not see the board, or as for `fit_camera` and `fit_pair`.
    """
    sides = range(len(sizes))
    n_seen = [sum(views[side] is not None for views in frames) for side in sides]
    if not any(n_seen):
        raise InputError(
            f"no {board} in any of {len(frames)} images; no other board is recognised either, so "
            "check that this is the right video or folder, and that the board is sharp and not cut "
            "off."
        )
    for side, n in enumerate(n_seen):
        if not n:
            raise InputError(
                f"the {('left', 'right')[side]} camera never sees the {board}, which the other one "
                f"sees in {max(n_seen)} of {len(frames)} images; hold it where both cameras see "
                "it, or give --sensor mono."
            )
    chosen = diverse(board, frames, sizes, _MOST_FRAMES)
    cameras = tuple(
        fit_camera(board, [v for views in chosen if (v := views[side])], sizes[side], lens)
        for side in sides
    )
    return Estimate(cameras, fit_pair(board, *cameras) if len(cameras) == 2 else None)


def diverse(board: Board, frames: Sequence[Frame], sizes: Sequence[Size], n: int) -> list[Frame]:
    """Select at most ``n`` frames in which the board is in places that differ most.

    Each frame selected is the one farthest from those selected before. Frames without the board
    are left out, and of a board at rest, all frames but one.
    """
    frames = [views for views in frames if any(views)]
    outlines = np.array(
        [
            np.concatenate([_outline(board, *seen) for seen in zip(views, sizes, strict=True)])
            for views in frames
        ]
    )
    median = np.median(outlines, axis=0)
    chosen = [int(np.linalg.norm(outlines - median, axis=1).argmin())]
    far = np.linalg.norm(outlines - outlines[chosen[0]], axis=1)
    while len(chosen) < n and far.max() > _SAME_VIEW:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(outlines - outlines[chosen[-1]], axis=1))
    return [frames[k] for k in sorted(chosen)]


def _outline(board: Board, view: View | None, size: Size) -> Array:
    """The corners of the board's outline, ``(8,)`` in image sizes. A homography finds those that
    are out of sight; they count as at most half an image away."""
    import cv2

    points = board_points(board)[:, :2]
    H = None if view is None else cv2.findHomography(points[view.ids], view.xy)[0]
    if H is None:
        return np.full(8, -0.5)
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    box = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]])
    return np.asarray((cv2.perspectiveTransform(box, H)[0] / size).clip(-0.5, 1.5).ravel())


def fit_camera(board: Board, views: Sequence[View], size: Size, lens: Lens) -> CameraFit:
    """Estimate a camera, with distortion ``k1 k2 p1 p2`` (pinhole) or ``k1 k2 k3 k4`` (fisheye).

    Views whose error exceeds three times the median are dropped, and the estimate is repeated.

    Raises:
        InputError: the views are too few or too similar, or the corners are not of this board.
    """
    fix = "film it in 20 or more different places and directions"
    fit = _without_outliers(
        views, lambda kept: _fit_camera(board, kept, size, lens), f"the {board} is found", fix
    )
    error = rms(np.concatenate(fit.residuals))
    if not error <= _NO_FIT * size[0]:
        raise InputError(
            f"the corners do not fit a flat {board} ({error:.0f} px RMS); check --size, --square "
            "and --marker, or try the other --lens."
        )
    return fit


def fit_pair(board: Board, left: CameraFit, right: CameraFit) -> PairFit:
    """Estimate the transformation between two cameras from their views of the same name.

    Pairs are dropped like the views of `fit_camera`.

    Raises:
        InputError: fewer than three pairs are left.
    """
    points = board_points(board)
    in_right = {v.name: (v, T) for v, T in zip(right.views, right.T_camera_board, strict=True)}
    pairs = []
    for view, T_left_board in zip(left.views, left.T_camera_board, strict=True):
        if view.name in in_right:
            other, T_right_board = in_right[view.name]
            ids, _, rows = np.intersect1d(view.ids, other.ids, return_indices=True)
            if len(ids) >= _FEWEST_COMMON:
                in_left = transform(T_left_board, points[ids])
                T_right_left = T_right_board @ inverse(T_left_board)
                pairs.append(_Pair(view.name, in_left, other.xy[rows], T_right_left))
    fix = "film it where both cameras see it"
    return _without_outliers(
        pairs, lambda kept: _fit_pair(right.model, kept), f"both cameras see the {board}", fix
    )


class _Pair(NamedTuple):
    """The ``(N, 3)`` corners of a board in the left camera's frame and their ``(N, 2)`` pixels in
    the right image; and the transformation according to the fits of both cameras."""

    name: str
    points: Array
    xy: Array
    T_right_left: Array


_V = TypeVar("_V", View, _Pair)
_F = TypeVar("_F", CameraFit, PairFit)


def _without_outliers(
    views: Sequence[_V], fit: Callable[[Sequence[_V]], _F], seen: str, fix: str
) -> _F:
    """Fit the views, and again without those whose error is large, until none is.

    Raises:
        InputError: too few views are left; ``seen`` and ``fix`` are parts of the message.
    """
    kept = list(views)
    dropped: list[tuple[str, float]] = []
    while len(kept) >= _FEWEST_VIEWS:
        found = fit(kept)
        out = ~(found.errors <= _OUTLIER * np.nanmedian(found.errors))  # NaN: behind the camera
        if not out.any():
            return replace(found, dropped=tuple(dropped))
        dropped += [(kept[k].name, float(found.errors[k])) for k in np.flatnonzero(out)]
        kept = [view for view, bad in zip(kept, out, strict=True) if not bad]
    raise InputError(
        f"{seen} in only {counted(len(kept), 'usable image')}, but {_FEWEST_VIEWS} are needed; "
        f"{fix}."
    )


def _fit_camera(board: Board, views: Sequence[View], size: Size, lens: Lens) -> CameraFit:
    import cv2

    points = [board_points(board)[view.ids] for view in views]
    calibrate: Any = cv2.calibrateCamera
    flags, dtype = cv2.CALIB_FIX_K3, np.float32
    if lens == "fisheye":
        names: Any = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye  # OpenCV 5 or 4
        calibrate, dtype = cv2.fisheye.calibrate, np.float64
        flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
    own, seen = ([p[None].astype(dtype) for p in each] for each in (points, [v.xy for v in views]))
    try:
        _, K, D, turns, shifts = calibrate(own, seen, size, None, None, flags=flags)
    except cv2.error as error:
        raise InputError(
            f"the {len(views)} views do not determine a {lens} camera; film the board in more "
            "places and tilted in more directions, or try the other --lens."
        ) from error
    # OpenCV's threads sum in varying order; rounding makes equal images give equal numbers.
    fx, fy, cx, cy = (round(float(K[at]), 5) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    distortion = tuple(round(k, 8) for k in np.ravel(D)[:4].tolist())
    model = CameraModel(fx, fy, cx, cy, *size, lens, distortion)
    T_camera_board = np.tile(np.eye(4), (len(views), 1, 1))
    for T, turn, shift in zip(T_camera_board, turns, shifts, strict=True):
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    residuals = tuple(
        view.xy - project(model, transform(T, p))
        for view, T, p in zip(views, T_camera_board, points, strict=True)
    )
    return CameraFit(model, tuple(views), residuals, T_camera_board)


def _fit_pair(right: CameraModel, pairs: Sequence[_Pair]) -> PairFit:
    """Minimise the residuals of the right images, for both lenses in the same way.

    ``cv2.fisheye.stereoCalibrate`` needs the same number of corners in every view, which a board
    that is partly out of view does not have.
    """
    from scipy.optimize import least_squares

    def residuals(T_right_left: Array) -> list[Array]:
        return [p.xy - project(right, transform(T_right_left, p.points)) for p in pairs]

    starts = np.array([pair.T_right_left for pair in pairs])
    off = np.linalg.norm(starts - np.median(starts, axis=0), axis=(1, 2))
    start = starts[off.argmin()]
    twist = least_squares(
        lambda x: np.concatenate(residuals(se3_exp(x) @ start)).ravel(), np.zeros(6)
    ).x
    T_right_left = se3_exp(twist) @ start
    errors = np.array([rms(each) for each in residuals(T_right_left)])
    return PairFit(inverse(T_right_left).round(9), errors)
