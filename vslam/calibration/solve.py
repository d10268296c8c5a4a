"""Estimates one camera, or two cameras and the transformation between them, from views of a board.

OpenCV estimates the cameras. This module selects views, drops views that do not fit, and measures
residuals using vslam's own camera models. A *view* contains the corners of the board that one image
shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.optimize import least_squares

from vslam.calibration.boards import Board, View, board_points
from vslam.calibration.models import Array, Calibration, CameraModel, Lens, project
from vslam.support.errors import InputError, counted
from vslam.types.geometry import inverse, orthonormalised, se3_exp, transform

Size = tuple[int, int]
Frame = tuple[View | None, ...]  # the view of each camera; None for a camera that sees no board
_Fit = TypeVar("_Fit", "CameraFit", "PairFit")

_MOST_FRAMES = 60
_FEWEST_VIEWS = 3  # the unknowns are 8 of the camera and 6 of each view
_OUTLIER = 3.0  # error above which a view is dropped, as a multiple of the median error
_NO_FIT = 0.01  # RMS error in image widths; if it is larger, the corners are those of another board
_FEWEST_COMMON = 6  # corners that both images of a pair must show
_SAME_VIEW = 0.02  # in image sizes; if the outline moves less, the board is at rest


@dataclass(frozen=True)
class CameraFit:
    """A camera that was estimated from V views of a board.

    Attributes:
        residuals: ``(N, 2)`` float64 residuals of the N corners in each view, in pixels: the
            position of a corner in the image minus the projected corner of the board.
        T_camera_board: ``(V, 4, 4)`` float64 pose of the board in each view.
        dropped: names of the views that were dropped because they do not fit, with their RMS errors
            in pixels.
    """

    model: CameraModel
    views: tuple[View, ...]
    residuals: tuple[Array, ...]
    T_camera_board: Array
    dropped: tuple[tuple[str, float], ...] = ()

    @property
    def errors(self) -> Array:
        """``(V,)`` float64 RMS errors of the views in pixels."""
        return np.array([rms(residuals) for residuals in self.residuals])


@dataclass(frozen=True)
class PairFit:
    """The transformation between two cameras, which was estimated from P pairs of views.

    Attributes:
        T_left_right: ``(4, 4)`` float64. It maps points from the right camera's frame to the left
            camera's frame.
        errors: ``(P,)`` float64 RMS errors of the pairs in pixels. The error of a corner is its
            distance in the right image from the position that is predicted from the left image.
        dropped: names of the pairs that were dropped because they do not fit, with their RMS errors
            in pixels.
    """

    T_left_right: Array
    errors: Array
    dropped: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Estimate:
    """The estimate of one camera, or of two cameras (left first) and the transformation between
    them."""

    cameras: tuple[CameraFit, ...]
    pair: PairFit | None = None

    @property
    def calibration(self) -> Calibration:
        """The calibration, without the data from which it was estimated."""
        left, right = self.cameras[0].model, self.cameras[-1].model
        if self.pair is None:
            return Calibration(left)
        return Calibration(left, right, self.pair.T_left_right)


def rms(residuals: Array) -> float:
    """Return the root mean square of the lengths of ``(N, 2)`` residuals."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def estimate(board: Board, frames: Sequence[Frame], sizes: Sequence[Size], lens: Lens) -> Estimate:
    """Estimate one camera, or a stereo pair if ``sizes`` has two entries.

    Args:
        frames: one view of the board for each image, or two views for each pair of images. In the
            two views of a pair, a corner must have the same number
            (`vslam.calibration.boards.same_order`).
        sizes: width and height of each camera's images.

    Raises:
        InputError: a camera does not see the board, or `fit_camera` or `fit_pair` fails.
    """
    seen = [sum(views[side] is not None for views in frames) for side in range(len(sizes))]
    if not any(seen):
        raise InputError(
            f"no {board} in any of {len(frames)} images, and no other board that vslam recognises; "
            "check that this is the right video or folder and that the board is sharp and complete."
        )
    if not all(seen):
        raise InputError(
            f"the {'right' if seen[0] else 'left'} camera never sees the {board}, which the other "
            f"one sees in {max(seen)} of {len(frames)} images; hold it where both cameras see it, "
            "or give --sensor mono."
        )
    chosen = diverse(board, frames, sizes, _MOST_FRAMES)
    cameras = tuple(
        fit_camera(board, [v for views in chosen if (v := views[side])], size, lens)
        for side, size in enumerate(sizes)
    )
    return Estimate(cameras, fit_pair(board, *cameras) if len(cameras) == 2 else None)


def diverse(board: Board, frames: Sequence[Frame], sizes: Sequence[Size], n: int) -> list[Frame]:
    """Select at most ``n`` frames in which the positions of the board differ most (farthest-point
    selection). If the board is at rest, only one frame is selected. Frames without the board are
    left out."""
    frames = [views for views in frames if any(views)]
    outlines = np.array(
        [[_outline(board, *seen) for seen in zip(views, sizes, strict=True)] for views in frames]
    ).reshape(len(frames), -1)
    chosen = [0]
    far = np.linalg.norm(outlines - outlines[0], axis=1)
    while len(chosen) < n and far.max() > _SAME_VIEW:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(outlines - outlines[chosen[-1]], axis=1))
    return [frames[k] for k in sorted(chosen)]


def _outline(board: Board, view: View | None, size: Size) -> Array:
    """Return the four corners of the board's outline, as ``(8,)`` multiples of the image size.

    Corners that are out of view are extrapolated by a homography, and clipped to half an image size
    beyond the image.
    """
    points = board_points(board)[:, :2]
    H = None if view is None else cv2.findHomography(points[view.ids], view.xy)[0]
    if H is None:
        return np.full(8, -0.5)
    box = np.array([list(product(*zip(points.min(axis=0), points.max(axis=0), strict=True)))])
    return np.asarray((cv2.perspectiveTransform(box, H)[0] / size).clip(-0.5, 1.5).ravel())


def fit_camera(board: Board, views: Sequence[View], size: Size, lens: Lens) -> CameraFit:
    """Estimate a camera from views of a board.

    The distortion has the coefficients ``k1 k2 p1 p2`` (pinhole) or ``k1 k2 k3 k4`` (fisheye).
    Views whose error exceeds three times the median are dropped, and the camera is estimated again
    from the other views.

    Raises:
        InputError: the views are too few or too similar, or the corners are not those of this
            board.
    """
    points = board_points(board)
    calibrate: Any = cv2.calibrateCamera
    flags, dtype = cv2.CALIB_FIX_K3, "float32"
    if lens == "fisheye":
        names: Any = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye  # OpenCV 5 or 4
        flags, dtype = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW, "float64"
        calibrate = cv2.fisheye.calibrate

    def fit(kept: Sequence[int]) -> CameraFit:
        own = [points[views[k].ids][None].astype(dtype) for k in kept]
        xy = [views[k].xy[None].astype(dtype) for k in kept]
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)  # equal images must give equal files; threads add in varying order
        try:
            _, K, D, turns, shifts = calibrate(own, xy, size, None, None, flags=flags)
        except cv2.error as error:
            raise InputError(
                f"the {len(kept)} views do not determine a {lens} camera; film the board in more "
                "places and tilted in more directions, or try the other --lens."
            ) from error
        finally:
            cv2.setNumThreads(threads)
        fx, fy, cx, cy = (round(float(K[at]), 5) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        distortion = tuple(round(k, 8) for k in np.ravel(D)[:4].tolist())
        model = CameraModel(fx, fy, cx, cy, *size, lens, distortion)
        T_camera_board = np.tile(np.eye(4), (len(kept), 1, 1))
        for T, turn, shift in zip(T_camera_board, turns, shifts, strict=True):
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
        residuals = tuple(
            views[k].xy - project(model, transform(T, points[views[k].ids]))
            for k, T in zip(kept, T_camera_board, strict=True)
        )
        return CameraFit(model, tuple(views[k] for k in kept), residuals, T_camera_board)

    found = _without_outliers(
        [view.name for view in views],
        fit,
        f"the {board} is found in only",
        "film it in 20 or more different places and directions",
    )
    error = rms(np.concatenate(found.residuals))
    if not error <= _NO_FIT * size[0]:
        raise InputError(
            f"the corners do not fit a flat {board} ({error:.0f} px RMS); check --size, --square "
            "and --marker, or try the other --lens."
        )
    return found


def fit_pair(board: Board, left: CameraFit, right: CameraFit) -> PairFit:
    """Estimate the transformation between two cameras from pairs of views with the same name. Pairs
    with large errors are dropped in the same way as `fit_camera` drops views.

    Raises:
        InputError: fewer than three pairs remain.
    """
    points = board_points(board)
    in_left = {v.name: (v, T) for v, T in zip(left.views, left.T_camera_board, strict=True)}
    pairs = []  # the right view of the corners that both see, T_left_board, T_right_left
    for view, T_right_board in zip(right.views, right.T_camera_board, strict=True):
        if view.name in in_left:
            other, T_left_board = in_left[view.name]
            common = np.isin(view.ids, other.ids)
            if np.count_nonzero(common) >= _FEWEST_COMMON:
                both = View(view.name, view.ids[common], view.xy[common])
                pairs.append((both, T_left_board, T_right_board @ inverse(T_left_board)))

    # cv2.fisheye.stereoCalibrate is not used. It needs the same number of corners in every view,
    # but the board may be partly out of view.
    def fit(kept: Sequence[int]) -> PairFit:
        def residuals(T_right_left: Array) -> list[Array]:
            return [
                view.xy - project(right.model, transform(T_right_left @ T, points[view.ids]))
                for view, T, _ in (pairs[k] for k in kept)
            ]

        start = orthonormalised(np.median([pairs[k][2] for k in kept], axis=0))
        found = least_squares(
            lambda x: np.concatenate(residuals(se3_exp(x) @ start)).ravel(), np.zeros(6)
        )
        T_right_left = se3_exp(found.x) @ start
        errors = np.array([rms(each) for each in residuals(T_right_left)])
        return PairFit(inverse(T_right_left).round(9), errors)

    return _without_outliers(
        [view.name for view, *_ in pairs],
        fit,
        f"both cameras see the {board} in only",
        "film it where both cameras see it",
    )


def _without_outliers(
    names: Sequence[str], fit: Callable[[Sequence[int]], _Fit], found_in: str, fix: str
) -> _Fit:
    """Repeat a fit without the views that have large errors, until no error is large. If too few
    views remain, an `InputError` with the texts ``found_in`` and ``fix`` is raised."""
    kept = list(range(len(names)))
    dropped: list[tuple[str, float]] = []
    while len(kept) >= _FEWEST_VIEWS:
        found = fit(kept)
        good = found.errors <= _OUTLIER * np.nanmedian(found.errors)  # NaN: behind the camera
        if good.all():
            return replace(found, dropped=tuple(dropped))
        dropped += [(names[kept[k]], float(found.errors[k])) for k in np.flatnonzero(~good)]
        kept = [kept[k] for k in np.flatnonzero(good)]
    raise InputError(
        f"{found_in} {counted(len(kept), 'usable image')}, but {_FEWEST_VIEWS} are needed; {fix}."
    )
