"""Estimation of camera models and of the transformation of a pair from views of a board.

OpenCV estimates; this module chooses views, drops those that do not fit, and measures residuals
with vslam's own camera models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from vslam.calibration.boards import Board, Corners, board_points
from vslam.calibration.models import Array, CameraModel, Lens, project
from vslam.errors import InputError, counted

Size = tuple[int, int]

FEWEST_VIEWS = 3  # an estimate has 8 unknowns of the camera and 6 of each view
_OUTLIER = 3.0  # medians of the views' errors
_NO_FIT = 0.01  # of the image width: RMS of a board that is another one
_FEWEST_COMMON = 6  # corners that both images of a pair show
_SAME_VIEW = 0.02  # of the image size, by which the board's outline moved between two views


@dataclass(frozen=True)
class View:
    """An image in which a camera sees the board; ``name`` identifies it to the user."""

    name: str
    corners: Corners


@dataclass(frozen=True)
class CameraFit:
    """A camera, estimated from V views.

    Attributes:
        model: the camera.
        views: those that it was estimated from.
        residuals: for each, ``(N, 2)`` float64, where a corner is seen minus where the model puts
            it, in pixels.
        T_camera_board: ``(V, 4, 4)`` float64.
        dropped: views that do not fit, and their RMS error in pixels.
    """

    model: CameraModel
    views: tuple[View, ...]
    residuals: tuple[Array, ...]
    T_camera_board: Array
    dropped: tuple[tuple[str, float], ...]

    @property
    def errors(self) -> Array:
        """``(V,)`` float64, the RMS error of each view in pixels."""
        return np.array([rms(residuals) for residuals in self.residuals])


@dataclass(frozen=True)
class PairFit:
    """The transformation between two cameras, estimated from P pairs of views.

    Attributes:
        T_left_right: ``(4, 4)`` float64, maps points of the right camera to the left one.
        names: of the pairs.
        errors: ``(P,)`` float64, how far the right camera sees the corners from where the board's
            pose in the left camera puts them: RMS in pixels.
        dropped: pairs that do not fit, and their errors.
    """

    T_left_right: Array
    names: tuple[str, ...]
    errors: Array
    dropped: tuple[tuple[str, float], ...]


def rms(residuals: Array) -> float:
    """Root mean square of the lengths of ``(N, 2)`` residuals."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def diverse(
    board: Board, views: Sequence[Sequence[View]], sizes: Sequence[Size], n: int
) -> list[int]:
    """At most ``n`` views that differ most, in their order; those of a board that stands still
    count once.

    Each next view is the one whose board lies farthest from those chosen before.

    Args:
        views: what is seen at a time, of one camera or of both.
        sizes: width and height of each camera's images.
    """
    if not views:
        return []
    outlines = np.array(
        [
            [_outline(board, v.corners, size) for v, size in zip(seen, sizes, strict=True)]
            for seen in views
        ]
    ).reshape(len(views), -1)
    chosen = [int(np.argmin(np.linalg.norm(outlines - np.median(outlines, axis=0), axis=1)))]
    far = np.linalg.norm(outlines - outlines[chosen[0]], axis=1)
    while len(chosen) < n and far.max() > _SAME_VIEW:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(outlines - outlines[chosen[-1]], axis=1))
    return sorted(chosen)


def fit_camera(board: Board, views: Sequence[View], size: Size, lens: Lens) -> CameraFit:
    """Estimate a camera: ``k1 k2 p1 p2`` of a pinhole camera, ``k1 k2 k3 k4`` of a fisheye camera.

    Views whose error is more than three times the median are dropped, and the estimate repeated.

    Raises:
        InputError: too few views, views that fix no camera, or corners that are not of this board.
    """
    points = board_points(board)

    def fit(kept: Sequence[View]) -> tuple[CameraFit, Array]:
        found = _fit(points, kept, size, lens)
        return found, found.errors

    fix = "film it in 20 or more different places and directions"
    found, dropped = _without_outliers(views, fit, f"the {board} is found", fix)
    error = rms(np.concatenate(found.residuals))
    if not error <= _NO_FIT * size[0]:
        raise InputError(
            f"the corners do not fit a flat {board} ({error:.0f} px RMS); check --size, --square "
            "and --marker, or try the other --lens."
        )
    return replace(found, dropped=dropped)


def fit_pair(board: Board, left: CameraFit, right: CameraFit) -> PairFit:
    """Estimate the transformation between two cameras from their views of the same names, whose
    corners are numbered alike (`vslam.calibration.boards.same_order`).

    Raises:
        InputError: fewer than three pairs.
    """
    points = board_points(board)
    right_views = zip(right.views, right.T_camera_board, strict=True)
    of_right = {view.name: (view.corners, T) for view, T in right_views}
    pairs = []
    for view, T_left_board in zip(left.views, left.T_camera_board, strict=True):
        if view.name in of_right:
            other, T_right_board = of_right[view.name]
            ids, _, seen = np.intersect1d(view.corners.ids, other.ids, return_indices=True)
            if len(ids) >= _FEWEST_COMMON:
                start = T_right_board @ np.linalg.inv(T_left_board)
                pairs.append(_Pair(view.name, points[ids], other.xy[seen], T_left_board, start))

    def fit(kept: Sequence[_Pair]) -> tuple[PairFit, Array]:
        T = _transformation(right.model, kept)
        errors = np.array([rms(pair.residuals(right.model, T)) for pair in kept])
        T_left_right = np.asarray(np.linalg.inv(T).round(9), np.float64)
        return PairFit(T_left_right, tuple(pair.name for pair in kept), errors, ()), errors

    fix = "film it where both cameras see it"
    found, dropped = _without_outliers(pairs, fit, f"both cameras see the {board}", fix)
    return replace(found, dropped=dropped)


@dataclass(frozen=True)
class _Pair:
    """A board's ``(N, 3)`` points, where the right camera sees them, its pose in the left camera,
    and the transformation that the fits of both cameras give."""

    name: str
    points: Array
    right: Array
    T_left_board: Array
    T_right_left: Array

    def residuals(self, model: CameraModel, T_right_left: Array) -> Array:
        return self.right - project(model, _moved(T_right_left @ self.T_left_board, self.points))


_V = TypeVar("_V", View, _Pair)
_F = TypeVar("_F", CameraFit, PairFit)


def _without_outliers(
    views: Sequence[_V], fit: Callable[[Sequence[_V]], tuple[_F, Array]], seen: str, fix: str
) -> tuple[_F, tuple[tuple[str, float], ...]]:
    """What ``fit`` makes of the views without those whose error is large, and their names and
    errors; ``fit`` returns its result and the error of each view.

    Raises:
        InputError: too few views are left; ``seen`` and ``fix`` are parts of the sentence.
    """
    kept = list(views)
    dropped: list[tuple[str, float]] = []
    while len(kept) >= FEWEST_VIEWS:
        found, errors = fit(kept)
        out = ~(errors <= _OUTLIER * np.nanmedian(errors))  # NaN: a board behind the camera
        if not out.any():
            return found, tuple(dropped)
        dropped += [(kept[k].name, float(errors[k])) for k in np.flatnonzero(out)]
        kept = [view for view, bad in zip(kept, out, strict=True) if not bad]
    raise InputError(
        f"{seen} in only {counted(len(kept), 'usable image')}, and {FEWEST_VIEWS} are the least; "
        f"{fix}."
    )


def _fit(points: Array, views: Sequence[View], size: Size, lens: Lens) -> CameraFit:
    import cv2

    own = [points[view.corners.ids] for view in views]
    xy = [view.corners.xy for view in views]
    try:
        if lens == "fisheye":
            names: Any = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye  # OpenCV 5, 4
            flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
            calibrate: Any = cv2.fisheye.calibrate  # its types know no None
            _, K, D, turns, shifts = calibrate(
                [p[None] for p in own], [p[None] for p in xy], size, None, None, flags=flags
            )
        else:
            _, K, D, turns, shifts = cv2.calibrateCamera(
                [p.astype(np.float32) for p in own], [p.astype(np.float32) for p in xy], size,
                None, None, flags=cv2.CALIB_FIX_K3,
            )  # fmt: skip
    except cv2.error as error:
        raise InputError(
            f"the {len(views)} views fix no {lens} camera; film the board in more places and "
            "tilted in more directions, or try the other --lens."
        ) from error
    # OpenCV's threads add up in any order; rounded, equal images give equal numbers.
    fx, fy, cx, cy = (round(float(K[at]), 5) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    distortion = tuple(round(k, 8) for k in np.ravel(D)[:4].tolist())
    model = CameraModel(fx, fy, cx, cy, *size, lens, distortion)
    T_camera_board = np.tile(np.eye(4), (len(views), 1, 1))
    for T, turn, shift in zip(T_camera_board, turns, shifts, strict=True):
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    residuals = tuple(
        seen - project(model, _moved(T, p))
        for T, p, seen in zip(T_camera_board, own, xy, strict=True)
    )
    return CameraFit(model, tuple(views), residuals, T_camera_board, ())


def _transformation(right: CameraModel, pairs: Sequence[_Pair]) -> Array:
    """``T_right_left`` that minimises the residuals of the right images.

    ``cv2.fisheye.stereoCalibrate`` takes only views with equally many corners, and those of a board
    that an image shows in part are not. Here both lenses are solved in the same way.
    """
    import cv2
    from scipy.optimize import least_squares

    def residuals(T_right_left: Array) -> Array:
        return np.concatenate([pair.residuals(right, T_right_left) for pair in pairs])

    def transformation(x: Array) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(x[:3])[0], x[3:]
        return T

    starts = [pair.T_right_left for pair in pairs]
    start = min(starts, key=lambda T: float(np.median(np.linalg.norm(residuals(T), axis=1))))
    x = np.concatenate([cv2.Rodrigues(start[:3, :3])[0].ravel(), start[:3, 3]])
    return transformation(least_squares(lambda x: residuals(transformation(x)).ravel(), x).x)


def _moved(T: Array, points: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _outline(board: Board, corners: Corners, size: Size) -> Array:
    """Where the corners of the board's outline are, ``(8,)`` in image sizes, by a homography; those
    that are not seen lie at most half an image outside."""
    import cv2

    points = board_points(board)[:, :2]
    H, _ = cv2.findHomography(points[corners.ids], corners.xy)
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    box = np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]])
    at = np.zeros((4, 2)) if H is None else cv2.perspectiveTransform(box, H)[0]
    return np.asarray((at / size).clip(-0.5, 1.5).ravel())
