"""Examines a sequence with the checks of ``vslam doctor``.

The examination checks all timestamps, and a few frames that are spread over the sequence. The
result consists of the findings of the checks, and of pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.datasets.frames import Source
from vslam.doctor import checks
from vslam.doctor.findings import Finding, judge, sections
from vslam.doctor.focal_length import Moved, fit_focal_length
from vslam.doctor.imu import examine_imu
from vslam.doctor.start import examine_start
from vslam.frontend.extraction import find_corners
from vslam.frontend.masks import Mask
from vslam.report.page import Figure, Page, Section
from vslam.report.render import html
from vslam.run.matching import Matches, joined, match_images
from vslam.run.pair import ROWS_PX, row_error
from vslam.run.side_delay import measure_delay
from vslam.support.errors import UnreadableImageError, counted, write_file
from vslam.types.camera import Camera, DepthImage, Image
from vslam.types.context import Context

_FRAMES = 8  # number of examined frames, which are spread over the sequence
_LAGS = range(-2, 3)  # delays of the right image that are tried, in frames
# For the check of the focal length: the number of pairs of frames, the number of frames from the
# first to the second frame of a pair, and the least and largest number of common points.
_TURNS, _LATER = 16, 4
_FEWEST, _MOST = 30, 200
_PICTURES = 2
_LEAST_DISPARITY = 1.0  # px
_DRAWN = 60  # number of matches that are drawn in a picture
_GAP = 48  # px between the two images of a picture
_GREEN, _RED = (80, 200, 60), (60, 60, 230)  # BGR


@dataclass(frozen=True)
class Picture:
    """A picture for the HTML page. ``image`` is ``(H, W, 3)`` uint8 in BGR order."""

    caption: str
    image: Image


@dataclass(frozen=True)
class Diagnosis:
    """The result of an examination: the findings in the order of the checks, and pictures."""

    findings: list[Finding]
    pictures: list[Picture] = field(default_factory=list)

    @property
    def faults(self) -> list[Finding]:
        return [finding for finding in self.findings if finding.verdict == "fault"]


def examine(sequence: Source, config: Config) -> Diagnosis:
    """Run all checks that apply to a stereo, RGB-D or monocular sequence, and to its IMU.

    The checks examine rectified images, as a run uses them. Features are extracted as in a run on
    the left images.
    """
    found = _examine_images(sequence, config)
    return replace(found, findings=[*found.findings, *examine_imu(sequence, config)])


def _examine_images(sequence: Source, config: Config) -> Diagnosis:
    frames = np.unique(np.linspace(0, len(sequence) - 1, _FRAMES).round().astype(int)).tolist()
    read: dict[int, tuple[Image, Image | DepthImage | None]] = {}
    problems = []
    for frame in frames:
        try:
            read[frame] = sequence.read(frame)
        except UnreadableImageError as error:
            problems.append(f"frame {frame}: {error}")
    findings = [
        judge(
            "images",
            bool(problems),
            f"{len(frames) - len(problems)} of {len(frames)} examined frames can be read"
            + "".join(f"; {problem.rstrip('.')}" for problem in problems[:1]),
            "replace the damaged files",
        ),
        checks.check_calibration(sequence.camera),
    ]
    lefts = {frame: left for frame, (left, _) in read.items()}
    if lefts:
        images = list(lefts.values())
        counts = _count_features(sequence, lefts, config)
        findings.append(checks.check_features(counts, config.orb.n_features))
        findings.append(checks.check_sharpness(images))
    findings += checks.check_times(sequence.timestamps, sequence.timing)
    if (pairing := sequence.pairing) is not None:
        findings.append(judge("partners", pairing.is_poor, pairing.measured, pairing.fix))
    masked, hidden = _examine_mask(sequence, lefts)
    findings += masked
    seconds = [second for _, second in read.values() if second is not None]
    if not seconds:
        findings.append(checks.check_scale(sequence.camera, None))
        if lefts and sequence.camera.monocular:
            findings.append(examine_start(sequence, config))
        return Diagnosis(findings, hidden)
    if seconds[0].dtype == np.uint8:
        few_features = any(f.check == "features" and f.verdict == "fault" for f in findings)
        found, pictures = _examine_stereo(sequence, lefts, config, few_features=few_features)
    else:
        found = [*checks.check_depth(images, seconds), checks.check_scale(sequence.camera, None)]
        found += _examine_focal_length(sequence, found)
        pictures = [_depth_picture(images[0], seconds[0])]
    return Diagnosis(findings + found, hidden + pictures)


def _count_features(sequence: Source, lefts: dict[int, Image], config: Config) -> list[int]:
    context = Context.create(sequence.camera, config)
    return [
        len(find_corners(left, None, context, mask=_mask_of(sequence, frame, config)).found.xy)
        for frame, left in lefts.items()
    ]


def _mask_of(sequence: Source, frame: int, config: Config) -> Mask | None:
    stored = sequence.stored[frame].mask
    try:
        return None if stored is None else Mask.of(stored(), config.orb)
    except UnreadableImageError:  # another check reports the mask
        return None


def _examine_mask(sequence: Source, lefts: dict[int, Image]) -> tuple[list[Finding], list[Picture]]:
    """Measure how much of the image the mask hides, and draw this part of it in red."""
    frame = next(iter(lefts), None)
    read = None if frame is None else sequence.stored[frame].mask
    if frame is None or read is None:
        return [], []
    try:
        masked = read() == 0
    except UnreadableImageError as error:
        return [Finding("mask", "fault", str(error).rstrip("."), "repair this mask")], []
    drawn = cv2.cvtColor(lefts[frame], cv2.COLOR_GRAY2BGR)
    drawn[masked] = (drawn[masked] + np.array(_RED)) // 2
    measured = f"the mask hides {100.0 * masked.mean():.1f} % of the image"
    caption = f"Frame {frame}: the mask hides the red part, from which no features are taken."
    return [Finding("mask", "good", measured)], [Picture(caption, np.asarray(drawn, np.uint8))]


@dataclass(frozen=True)
class _Pair:
    frame: int
    lag: int
    left: Image
    right: Image
    matches: Matches

    @property
    def rows(self) -> float:
        """Median vertical error of the stereo matches (px)."""
        return row_error(self.matches)


def _pairs_with_lag(sequence: Source, lefts: dict[int, Image], lag: int) -> list[_Pair]:
    """Match each left image with the right image that was taken ``lag`` frames later."""
    found = []
    for frame, left in lefts.items():
        try:
            right = sequence.read(frame + lag)[1] if 0 <= frame + lag < len(sequence) else None
        except UnreadableImageError:
            continue
        if right is not None:
            right = np.asarray(right, np.uint8)
            found.append(_Pair(frame, lag, left, right, match_images(left, right)))
    return found


def _examine_stereo(
    sequence: Source, lefts: dict[int, Image], config: Config, *, few_features: bool
) -> tuple[list[Finding], list[Picture]]:
    inner = dict(list(lefts.items())[1:-1:2])  # frames that have frames before and after them
    by_lag = {lag: _pairs_with_lag(sequence, inner if lag else lefts, lag) for lag in _LAGS}
    pairs = by_lag[0]
    if not any(len(pair.matches) for pair in pairs):
        fix = "the images do not overlap: check that they form a pair, and their calibration"
        measured = "no pair of images has 12 matches"
        finding = Finding("stereo", "fault", measured, fix)
        if few_features:
            finding = Finding("stereo", "unknown", f"{measured}: the images have few features")
        return [finding], [_stereo_picture(pair) for pair in pairs[:1]]
    synchronised, lag = checks.check_synchronisation(_rows_by_lag(by_lag))
    pairs = by_lag[lag]  # the other checks need synchronised images
    matches = joined([pair.matches for pair in pairs])
    findings = [
        synchronised,
        checks.check_rectification(matches),
        checks.check_sides(matches),
        checks.check_scale(sequence.camera, matches),
        checks.check_exposure(
            [(pair.left, pair.right) for pair in pairs], [pair.matches for pair in pairs]
        ),
    ]
    delay = None
    if synchronised.verdict == "good":
        delay = measure_delay(sequence.stored, len(sequence.stored))
    if delay is not None:
        findings.insert(1, checks.check_delay(delay, sequence.camera, config.stereo))
    findings += _examine_focal_length(sequence, findings)
    shown = sorted(pairs, key=lambda pair: -len(pair.matches))[:_PICTURES]
    return findings, [_stereo_picture(pair) for pair in shown]


def _examine_focal_length(sequence: Source, found: list[Finding]) -> list[Finding]:
    """Check the focal length, unless a fault that was found earlier would distort the result."""
    if any(finding.verdict == "fault" for finding in found):
        return []
    last = len(sequence) - 1 - _LATER
    frames = np.unique(np.linspace(0, last, _TURNS if last >= 0 else 0).round().astype(int))
    several = [moved for k in frames.tolist() if (moved := _track(sequence, k)) is not None]
    fit = fit_focal_length(several, sequence.camera) if several else None
    return [checks.check_focal_length(fit, sequence.camera)]


def _track(sequence: Source, frame: int) -> Moved | None:
    """Find points in a frame, their disparities, and their positions a few frames later.

    The result is None if there are too few points or if an image cannot be read.
    """
    try:
        left, second = sequence.read(frame)
        later, _ = sequence.read(frame + _LATER)
    except UnreadableImageError:
        return None
    if second is None:
        return None
    matches = match_images(left, later)
    disparity = _disparities(matches.left, left, second, sequence.camera)
    kept = np.flatnonzero(disparity > _LEAST_DISPARITY)
    if len(kept) < _FEWEST:
        return None
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, _MOST).astype(int))]
    before, after = (xy[kept].astype(np.float64) for xy in (matches.left, matches.right))
    return Moved(before, disparity[kept], after)


def _disparities(
    xy: NDArray[np.float32], left: Image, second: Image | DepthImage, camera: Camera
) -> NDArray[np.float64]:
    """Return ``(N,)`` disparities of ``(N, 2)`` keypoints of the left image, 0 where unknown."""
    if second.dtype != np.uint8:
        x, y = np.rint(xy).astype(int).T
        depth = np.asarray(second, np.float64)[y, x]
        near = np.isfinite(depth) & (depth > 0)
        return np.where(near, camera.bf / np.where(near, depth, 1.0), 0.0)
    pair = match_images(left, np.asarray(second, np.uint8))
    of_keypoint = {
        tuple(a): a[0] - b[0]
        for a, b in zip(pair.left.tolist(), pair.right.tolist(), strict=True)
        if abs(a[1] - b[1]) < 2.0 * ROWS_PX
    }
    return np.array([of_keypoint.get(tuple(a), 0.0) for a in xy.tolist()], np.float64)


def _rows_by_lag(by_lag: dict[int, list[_Pair]]) -> dict[int, float]:
    """Return the median row error of stereo matches (px) by delay of the right image (frames).

    Only frames that have matches for all delays are used.
    """
    rows = {
        lag: {pair.frame: pair.rows for pair in pairs if len(pair.matches)}
        for lag, pairs in by_lag.items()
    }
    frames = set.intersection(*(set(found) for found in rows.values()))
    return {
        lag: float(np.median([found[frame] for frame in frames]))
        for lag, found in rows.items()
        if frames
    }


def _stereo_picture(pair: _Pair) -> Picture:
    """Draw a stereo pair side by side. The line of a match is green if its two rows agree."""
    left, right, matches = pair.left, pair.right, pair.matches
    height, width = left.shape
    begin = width + _GAP  # first column of the right image
    canvas = np.full((max(height, right.shape[0]), begin + right.shape[1]), 255, np.uint8)
    canvas[:height, :width] = left
    canvas[: right.shape[0], begin:] = right
    drawn = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR)
    off = np.abs(matches.left[:, 1] - matches.right[:, 1])
    for k in np.linspace(0, len(matches) - 1, min(_DRAWN, len(matches))).astype(int):
        color = _GREEN if off[k] <= ROWS_PX else _RED
        a = np.rint(matches.left[k]).astype(int).tolist()
        b = np.rint(matches.right[k] + (begin, 0)).astype(int).tolist()
        cv2.circle(drawn, a, 4, color, 1, cv2.LINE_AA)
        cv2.circle(drawn, b, 4, color, 1, cv2.LINE_AA)
        cv2.line(drawn, (width, a[1]), (begin - 1, b[1]), color, 1, cv2.LINE_AA)
    other = f" with the right image of frame {pair.frame + pair.lag}" if pair.lag else ""
    caption = (
        f"Frame {pair.frame}{other}: matches whose rows agree to {ROWS_PX} px in green, "
        "others in red. The lines between the images of a rectified pair are horizontal."
    )
    return Picture(caption, np.asarray(drawn, np.uint8))


def _depth_picture(image: Image, depth: checks.Depth) -> Picture:
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    drawn[checks.depth_edges(np.nan_to_num(depth.astype(np.float32)))] = _RED
    caption = "Depth edges in red. They lie on the edges of objects if the depth is registered."
    return Picture(caption, np.asarray(drawn, np.uint8))


def write_page(diagnosis: Diagnosis, title: str, path: Path) -> None:
    """Write the result of an examination as self-contained HTML.

    Raises:
        ResultsError: the file cannot be written.
    """
    faults = len(diagnosis.faults)
    figures = [
        Figure(f"picture-{k}", picture.caption, _jpeg(picture))
        for k, picture in enumerate(diagnosis.pictures)
    ]
    page = Page(
        title,
        [counted(faults, "fault") if faults else "no faults"],
        [*sections(diagnosis.findings), Section("", figures)],
    )
    write_file(path, html(page), "give another file with --out")


def _jpeg(picture: Picture) -> bytes:
    data = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return bytes(data.tobytes())
