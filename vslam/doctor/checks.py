"""Checks of a data set, which examine its images, its stereo matches and its timestamps.

The checks are short and share this file, so that their thresholds are in one place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import StereoConfig
from vslam.datasets.times import (
    GAP,
    JITTER,
    Timing,
    in_order,
    is_frame_rate,
    jitter,
    rate_text,
)
from vslam.doctor.findings import Finding, judge
from vslam.doctor.focal_length import FocalFit
from vslam.run.matching import Matches, count_views
from vslam.run.pair import ROWS_PX, find_lag, judge_sides, row_error
from vslam.run.side_delay import SideDelay
from vslam.support.errors import counted
from vslam.types.camera import Camera, Image, calibration_doubts, field_of_view

Times = NDArray[np.float64]
Depth = NDArray[Any]  # any type of number; 0 or NaN means that the depth is missing

EXPOSURE = 0.25  # largest relative difference in brightness, because matching compares grey values
FEATURES = 0.5  # least share of the requested number of features
# Contrast of pixels with their neighbours, relative to the contrast with a wider neighbourhood. It
# is 0.43 for KITTI, 0.25 for TUM and 0.27 for EuRoC. After a Gaussian blur of 1.5 px, it is at most
# 0.17.
SHARP = 0.18
# Largest share of steps with a gap. Two standard deviations are added, because the share is
# uncertain if there are few steps.
GAPS = 0.05
LONG_GAP = 3.5  # a longer step, in intervals, means that several frames in a row are missing
DEPTH_PX = 4.0  # largest shift; depth edges of structured light are off by 2 to 3 px
DEPTH_SHARE = 0.3  # smallest share of pixels with a depth
# Misregistered depth is reported only if the fit has one clear peak away from shift 0. Heights are
# measured above the median of the fit, relative to the highest peak. The limits were measured in
# nine parts of TUM fr1/desk. With correct depth, the height near shift 0 was at least 0.67, or the
# second peak had the height 0.85. With depth that was shifted by 20 px, the height near shift 0 was
# 0.25 to 0.66. The height of the second peak was then mostly 0.65 to 0.77.
DEPTH_AT_ZERO = 0.6
DEPTH_SECOND = 0.8
_ANOTHER_PX = 8.0  # smallest distance of the second peak from the highest peak
DEPTH_VIEWS = 2  # least number of different views; a single view may fit a wrong shift by chance
NEAREST_M, FARTHEST_M = 0.01, 3.0  # plausible baselines of a stereo pair on a vehicle
# With the right calibration, the fitted factor of the focal length is 0.975 to 1.026. This was
# measured on KITTI 00, three parts of fr1/desk and six rendered drives. If the calibrated focal
# length is 10 % too long, the factor is 0.89 to 0.93.
FOCAL = 0.05
FOCAL_SIGMA = 0.01  # largest sigma of a fit that is used; on straight roads, it is 0.05 or more
TURNED = 2.0  # least rotation in degrees; a straight road has up to 1.6 within four frames
NEAREST_DEPTH_M, FARTHEST_DEPTH_M = 0.05, 100.0  # plausible median depths of a sensor
_FIX_SIDES = {
    "same": "both images are the same: give the right camera's images",
    "swapped": "left and right are swapped, or the baseline has the wrong sign: swap the cameras",
    "outwards": "many disparities are negative: the cameras are turned outwards; calibrate again",
}
_BORDER = 2  # px; if a peak is this near the end of the search range, the true peak may lie outside
_REACH = 16, 48  # px, vertical and horizontal search range; the sensors are side by side


def check_rectification(matches: Matches) -> Finding:
    """Check that both points of a stereo match lie in the same row, as in a rectified pair."""
    rows = row_error(matches)
    return judge(
        "rectification",
        rows > ROWS_PX,
        f"median vertical error {rows:.2f} px of {len(matches)} matches",
        "the pair is not rectified: give its calibration with --calib, or calibrate again",
    )


def check_sides(matches: Matches) -> Finding:
    """Check that left and right images are not swapped, which would make disparities negative."""
    disparity = matches.left[:, 0] - matches.right[:, 0]
    in_front = 100.0 * float(np.mean(disparity > -ROWS_PX))
    measured = f"median disparity {np.median(disparity):.1f} px, {in_front:.0f} % not negative"
    sides = judge_sides(matches)
    return judge("sides", sides != "good", measured, _FIX_SIDES.get(sides, ""))


def check_scale(camera: Camera, matches: Matches | None) -> Finding:
    """Report the field of view, the baseline, and the median depth of the scene.

    The user must compare these numbers with the real scene, because images do not reveal a wrong
    baseline. Only a baseline that seems to be in a wrong unit is reported as a fault.

    Args:
        matches: matches of the stereo pair. None for a monocular or RGB-D camera.
    """
    across, down = field_of_view(camera)
    measured = f"{camera.width}x{camera.height} pixels see {across:.0f} x {down:.0f} degrees"
    if matches is None:
        return Finding("scale", "good", measured)
    disparity = matches.left[:, 0] - matches.right[:, 0]
    measured += f"; baseline {camera.baseline:.3f} m"
    if (disparity > 0).any():
        middle = camera.fx * camera.baseline / float(np.median(disparity[disparity > 0]))
        measured += f", half of the matches are nearer than {middle:.3g} m"
    return judge(
        "scale",
        not NEAREST_M <= camera.baseline <= FARTHEST_M,
        measured,
        "give the baseline in metres: calibration with a board gives it in the unit of its squares",
    )


def check_calibration(camera: Camera) -> Finding:
    """Check whether the principal point and the focal lengths are plausible for the image size."""
    doubts = calibration_doubts(camera)
    measured = (
        f"principal point ({camera.cx:.1f}, {camera.cy:.1f}), focal lengths ({camera.fx:.1f}, "
        f"{camera.fy:.1f}) for {camera.width}x{camera.height} images"
        f"{', turned by 90 degrees' if camera.quarter_turns else ''}"
    )
    return judge(
        "calibration",
        bool(doubts),
        "; ".join(doubts) or measured,
        "give the calibration of these images with --calib, and write their size into it",
    )


def check_focal_length(fit: FocalFit | None, camera: Camera) -> Finding:
    """Check whether observed rotations of the camera agree with the calibrated focal length.

    Args:
        fit: the focal length that fits the motion of the camera best. None if too few frames have
            points in common.
    """
    if fit is None:
        return Finding("focal length", "unknown", "too few frames have points in common")
    if fit.turned < TURNED or fit.sigma > FOCAL_SIGMA:
        return Finding("focal length", "unknown", "the camera hardly turns in the frames examined")
    return judge(
        "focal length",
        abs(np.log(fit.factor)) > FOCAL,
        f"turns of up to {fit.turned:.0f} degrees fit {fit.factor * camera.fx:.0f} px; the "
        f"calibration has {camera.fx:.0f} px",
        "the calibration is for another zoom, size or crop of the images: calibrate again",
    )


def check_exposure(pairs: Sequence[tuple[Image, Image]], several: Sequence[Matches]) -> Finding:
    """Check whether the same points have the same brightness in both images of a stereo pair."""
    ratios = []
    for (left, right), matches in zip(pairs, several, strict=True):
        greys = [
            cv2.blur(image, (7, 7))[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)]
            for image, xy in ((left, matches.left), (right, matches.right))
        ]
        ratios.append((greys[1] + 1.0) / (greys[0] + 1.0))
    ratio = float(np.median(np.concatenate(ratios)))
    return judge(
        "exposure",
        abs(np.log(ratio)) > np.log1p(EXPOSURE),
        f"the right image is {ratio:.2f} times as bright as the left one",
        "let one camera set the exposure and gain of both cameras",
    )


def check_synchronisation(rows_of_lag: Mapping[int, float]) -> tuple[Finding, int]:
    """Check whether the two cameras are synchronised.

    The cameras are not synchronised if left images fit the right images of other frames better than
    the right images of the same frames.

    Args:
        rows_of_lag: median vertical error of stereo matches (px) for each lag, which is the delay
            of the right image in frames. The dictionary is empty if no frame has matches for all
            lags.

    Returns:
        The finding, and the best lag. The lag is 0 if the camera hardly moves.
    """
    if not rows_of_lag:
        return Finding("synchronisation", "unknown", "too few frames with matches"), 0
    errors = ", ".join(f"{lag:+d}: {error:.2f} px" for lag, error in sorted(rows_of_lag.items()))
    measured = f"vertical error by lag in frames: {errors}"
    best = find_lag(rows_of_lag)
    if best is None:
        return Finding("synchronisation", "unknown", f"{measured}; the camera hardly moves"), 0
    finding = judge(
        "synchronisation",
        best != 0,
        measured,
        f"the right image is {counted(abs(best), 'frame')} "
        f"{'late' if best > 0 else 'early'}: trigger both cameras together, or shift the "
        "timestamps of one camera",
    )
    return finding, best


def check_delay(found: SideDelay, camera: Camera, config: StereoConfig) -> Finding:
    """Check whether the right image has the delay that the calibration gives."""
    sigma = f"(standard deviation {1e3 * found.sigma:.1f} ms)"
    wrong = found.is_wrong(camera, config)
    return judge("delay", wrong, f"{found.description()} {sigma}", found.remedy())


def check_features(counts: Sequence[int], requested: int) -> Finding:
    """Check the number of features that a run extracts from each examined frame.

    Args:
        requested: the number of features that the extraction is asked for.
    """
    middle = int(np.median(counts))
    return judge(
        "features",
        middle < FEATURES * requested,
        f"median {middle}, least {min(counts)} of {requested} requested features",
        "too little texture or light: use more light, a longer exposure, or a lower threshold "
        "(docs/reference/thresholds.md)",
    )


def check_sharpness(images: Sequence[Image]) -> Finding:
    """Check that images are not blurred, using the median of their `sharpness`."""
    values = [sharpness(image) for image in images]
    middle = float(np.median(values))
    return judge(
        "sharpness",
        middle < SHARP,
        f"median {middle:.2f}, least {min(values):.2f}; features are blurred below {SHARP}",
        "focus the lens, clean it, or use a shorter exposure",
    )


def sharpness(image: Image) -> float:
    """Return the contrast of neighbouring pixels relative to that of a wider neighbourhood.

    The ratio is 0 for an image without fine detail, and about 1 for white noise.
    """
    grey = image.astype(np.float32)
    fine, wide = (grey - cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, 4.0))
    return float(np.std(fine) / max(float(np.std(wide)), 1e-6))


def check_times(timestamps: Times, timing: Timing | None = None) -> list[Finding]:
    """Check timestamps, in seconds, for wrong order, an impossible rate, gaps and jitter.

    Args:
        timing: how the reader put the times in order. None if the times are as they were recorded.
    """
    if timing is None:
        timing = Timing("")
        found = in_order(((time, None) for time in timestamps.tolist()), timing)
        timestamps = np.array([time for time, _ in found])
    order = judge(
        "order of times",
        bool(timing.measured),
        timing.measured or f"the times of {counted(len(timestamps), 'frame')} increase",
        "do not set the camera's clock during a recording"
        if timing.set_back
        else "record each frame once, with the time at which it was taken",
    )
    steps = np.diff(timestamps)
    if len(steps) < 3:
        few = Finding("times", "unknown", f"{len(timestamps)} frames are too few")
        return [order, few] if timing.measured else [few]
    interval = float(np.median(steps))
    rate = judge(
        "frame rate",
        not is_frame_rate(interval),
        "; ".join([rate_text(interval), *(remark.rstrip(".") for remark in timing.remarks)]),
        "correct the unit of the times, or record 0.2 to 1250 frames per second",
    )
    gaps = steps > GAP * interval
    longest = int(np.argmax(steps))
    n = len(steps)
    most = GAPS * n + 2.0 * np.sqrt(GAPS * (1.0 - GAPS) * n)
    gap = judge(
        "gaps",
        bool(gaps.sum() > most or steps[longest] > LONG_GAP * interval),
        f"{int(gaps.sum())} intervals with missing frames, the longest {steps[longest]:.3f} s "
        f"after frame {longest}",
        "frames were lost during recording, or have no partner of the same time: use a faster "
        "disk, a lower rate, or synchronised cameras",
    )
    spread = jitter(timestamps)
    steady = judge(
        "jitter",
        spread > JITTER,
        f"standard deviation {100 * spread:.1f} % of the interval of {1e3 * interval:.1f} ms",
        "stamp frames when they are exposed, not when they arrive",
    )
    return [order, rate, gap, steady]


def check_depth(images: Sequence[Image], depths: Sequence[Depth]) -> list[Finding]:
    """Check the range of depth images, and whether they are registered to the colour images.

    If they are registered, depth edges fit the image edges best without a shift.
    """
    depths = [np.nan_to_num(depth.astype(np.float32)) for depth in depths]
    share = float(np.mean([np.mean(depth > 0) for depth in depths]))
    middle = float(np.median(np.concatenate([d[d > 0].ravel() for d in depths]))) if share else 0.0
    measured = f"{100 * share:.0f} % of the pixels have a depth, half of them below {middle:.3g} m"
    if share and not NEAREST_DEPTH_M <= middle <= FARTHEST_DEPTH_M:
        fix = "the depth scale is wrong: give the value of one metre with --depth-scale"
        return [Finding("depth", "fault", measured, fix)]
    in_range = judge(
        "depth",
        share < DEPTH_SHARE,
        measured,
        "few points lie within the sensor's range: check the depth scale, or move closer",
    )
    fit = np.sum([_edge_fit(*pair) for pair in zip(images, depths, strict=True)], axis=0)
    contrast = float((fit.max() - np.median(fit)) / max(float(np.std(fit)), 1e-12))
    if not fit.any() or contrast < 2.0:
        return [in_range, Finding("registration", "unknown", "no depth edges in these images")]
    return [in_range, _registration(fit, lambda: count_views(images))]


def _registration(fit: NDArray[np.float32], views: Callable[[], int]) -> Finding:
    """Check whether depth edges fit the image edges best without a shift.

    A different best shift is a fault only under two conditions. It must be the single clear peak
    inside the search range, and more than one view must have been examined.
    """
    reach = np.array(_REACH)
    best = np.array(np.unravel_index(np.argmax(fit), fit.shape)) - reach
    shifts = np.moveaxis(np.indices(fit.shape), 0, -1) - reach
    height = (fit - np.median(fit)) / (fit.max() - np.median(fit))
    at_zero = float(height[np.linalg.norm(shifts, axis=2) <= DEPTH_PX].max())
    second = float(height[np.linalg.norm(shifts - best, axis=2) > _ANOTHER_PX].max())
    off = float(np.linalg.norm(best))
    measured = f"depth edges fit best when shifted by {off:.0f} px ({best[1]:+d}, {best[0]:+d})"
    clear = at_zero < DEPTH_AT_ZERO and second < DEPTH_SECOND
    if off > DEPTH_PX and not (clear and (np.abs(best) <= reach - _BORDER).all()):
        return Finding("registration", "unknown", f"{measured}, but other shifts fit as well")
    if off > DEPTH_PX and views() < DEPTH_VIEWS:
        reason = "but the images show only one view, which may fit there by chance"
        return Finding("registration", "unknown", f"{measured}, {reason}")
    return judge(
        "registration",
        off > DEPTH_PX,
        measured,
        "the depth is not registered to the image: switch on registration in the driver, or "
        "register the files",
    )


def _edge_fit(image: Image, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute how well the depth edges fit the image edges, for each shift in the search range.

    Returns:
        ``(33, 97)`` mean edge strength of the image at the shifted depth edges.
    """
    down, across = _REACH
    grey = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    strength /= cv2.blur(strength, (65, 65)) + 1.0
    inner = depth_edges(depth)[down:-down, across:-across].astype(np.float32)
    if not inner.any():
        return np.zeros((2 * down + 1, 2 * across + 1), np.float32)
    fit = cv2.matchTemplate(strength, inner, cv2.TM_CCORR) / float(inner.sum())
    return np.asarray(fit, np.float32)


def depth_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the ``(H, W)`` bool pixels at which the depth changes by more than a tenth.

    A depth of 0 means that the depth is unknown.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.where(depth > 0, np.log(depth), np.nan)
        jump = np.zeros(depth.shape, bool)
        jump[:, 1:] |= np.abs(np.diff(log, axis=1)) > 0.1
        jump[1:] |= np.abs(np.diff(log, axis=0)) > 0.1
    return jump
