"""Checks whether left and right images are a stereo pair, mostly on the first frames of a run.

``vslam doctor`` uses the same criteria.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Several
from contextlib import suppress
from functools import cached_property
from itertools import count, islice
from typing import Literal

import cv2
import numpy as np

from vslam.datasets.frames import FIRST_FRAMES, Source, TimedFrame
from vslam.datasets.perturbation import Perturbation, perturbed
from vslam.run.matching import Described, Matches, describe, match_described
from vslam.run.options import RunOptions
from vslam.run.rig import is_synchronised
from vslam.run.side_delay import FEWEST_FRAMES, delay_warnings, measure_delay
from vslam.support.errors import InputError, UnreadableImageError, counted
from vslam.support.plugins import reason
from vslam.types.camera import Camera, Image
from vslam.types.map import Map

ROWS_PX = 0.8
"""Largest median vertical error of stereo matches. A run searches for stereo matches within 2 rows.
The error of KITTI's rectification is 0.3 to 0.5 px."""

# Least share of positive disparities. The disparities of distant points scatter around 0.
_IN_FRONT = 0.9
_SAME_PX, _SAME_SHARE = 0.25, 90.0  # largest displacement in a copy, for this percentage of points
# A lag in frames is reported only if it reduces the row error by at least this many pixels, and to
# at most this fraction.
_LAG_GAIN_PX, _LAG_FACTOR = 0.25, 0.6

# Frames at which the checks begin. The later ones are needed only while the images do not allow a
# verdict, for example because the camera stands still or the lens cap is on.
_BEGINS = (0, 6, 12, 20, 50, 120, 300, 700)
_MOST_JUDGED = 4  # number of times that the images are judged, which takes most of the time
_AGREEING = 2  # times that a fault must be found before it is reported
_FEATURES = 500
_FEWEST = 30  # matches
_MANY = 250  # features; if two such images have no match, they show different scenes
_LAGS = 4  # frames
_TITLE = 30  # frames at the start that may show the same picture in both images, such as a title
# Largest mean difference of grey values if the camera is at rest, in images that are scaled to an
# eighth. It is 0.4 to 0.7 at the start of EuRoC's V1_01, and at least 12 on drives.
_AT_REST = 1.5

_OTHER_SCENE = (
    "The left and the right images have no points in common: give images that two cameras took at "
    "the same time in the same direction, or run on one camera with --sensor mono."
)
_SAME_IMAGES = (
    "The left and the right images are the same: give the images of the right camera, or run on "
    "one camera with --sensor mono."
)

Sides = Literal["good", "same", "swapped", "outwards"]


def row_error(matches: Matches) -> float:
    """Return the median vertical error of stereo matches in pixels."""
    return float(np.median(np.abs(matches.left[:, 1] - matches.right[:, 1])))


def judge_sides(matches: Matches) -> Sides:
    """Judge the disparities of a stereo pair.

    Returns:
        ``same`` if both images are the same. ``swapped`` or ``outwards`` if too many disparities
        are negative: left and right are swapped, or the cameras are turned outwards.
    """
    moved = np.linalg.norm(matches.left - matches.right, axis=1)
    if np.percentile(moved, _SAME_SHARE) < _SAME_PX:
        return "same"
    disparity = matches.left[:, 0] - matches.right[:, 0]
    if np.mean(disparity > -ROWS_PX) >= _IN_FRONT:
        return "good"
    return "swapped" if np.median(disparity) < 0 else "outwards"


def find_lag(rows_of_lag: Mapping[int, float]) -> int | None:
    """Find by how many frames right images are late.

    Args:
        rows_of_lag: median vertical error (px) of matches between left images and the right images
            that are this many frames later.

    Returns:
        None if the camera hardly moves. Otherwise 0, unless another lag reduces the error a lot.
    """
    if max(rows_of_lag.values()) - min(rows_of_lag.values()) < _LAG_GAIN_PX:
        return None
    best = min(rows_of_lag, key=lambda lag: (rows_of_lag[lag], abs(lag)))
    now, then = rows_of_lag[0], rows_of_lag[best]
    return best if now - then > _LAG_GAIN_PX and then < _LAG_FACTOR * now else 0


def how_to_swap(dataset: str, options: RunOptions) -> str:
    """Tell the user how to swap the left and the right images."""
    if dataset == "images" and options.right is not None:
        return f"swap them: --data {options.right} --right {options.data}"
    if dataset == "images":
        return "swap the folders of the left and the right images"
    if dataset == "bag" and options.topics:
        return f"swap them: --topics {','.join(reversed(options.topics.split(',')))}"
    if dataset == "bag":
        return "give both topics with --topics, that of the left images first"
    if dataset == "video":
        return "swap the halves of the images: the left camera's half must be on the left"
    folders = {"kitti": "image_0 and image_1", "euroc": "cam0 and cam1"}
    return f"swap {folders.get(dataset, 'the images of both cameras')}"


class PairCheck:
    """Checks a few of the first frames before they are perturbed.

    The checks end as soon as the images of a moving camera are found to be in order. A fault that
    ends the run is found in one pair, except that images are only the same if later ones are, too.
    Any other fault is reported only if it is found at two different times. Images with few matches
    prove nothing.
    """

    def __init__(self, camera: Camera, dataset: str, options: RunOptions) -> None:
        self._camera, self._config = camera, options.thresholds.stereo
        self._open = camera.sensor == "stereo"
        self._fix_sides = how_to_swap(dataset, options)
        self._n_judged = 0
        self._found: dict[str, list[str]] = {}
        self._late: list[str] = []

    def warnings(self) -> list[str]:
        """Return a sentence about a fault that was found, with a remedy."""
        return [said[-1] for said in self._found.values() if len(said) == _AGREEING] + self._late

    def end(
        self, source: Source, perturbation: Perturbation, n_frames: int, map_: Map | None = None
    ) -> None:
        """Measure the delay of the right image in the ``n_frames`` frames of the run, unless there
        is another fault or the map of the run shows that there is no delay. The frames of a live
        camera cannot be read again."""
        if self._camera.sensor != "stereo" or source.live or self.warnings():
            return
        try:
            if n_frames < FEWEST_FRAMES or (
                map_ is not None and is_synchronised(map_, self._camera)
            ):
                return
            n_measured = n_frames if source.seekable else min(n_frames, FIRST_FRAMES)
            found = measure_delay(perturbed(source.frames(), perturbation), n_measured)
            self._late = delay_warnings(found, self._camera, self._config)
        except Exception as error:  # a failed check must not end the run
            self._late = [f"The delay of the right image could not be measured ({reason(error)})."]

    def watch(self, frames: Iterator[TimedFrame]) -> Iterator[TimedFrame]:
        """Yield all frames. For a check, some frames are read in advance.

        Raises:
            InputError: the left and the right images are the same, or left and right are swapped.
        """
        ahead: deque[TimedFrame] = deque()
        for index in count():
            if self._open and index in _BEGINS:
                with suppress(UnreadableImageError):  # the run counts this frame
                    self._check(ahead, frames)
            frame = ahead.popleft() if ahead else next(frames, None)
            if frame is None:
                return
            yield frame

    def _check(self, ahead: deque[TimedFrame], frames: Iterator[TimedFrame]) -> None:
        """Check the pair of the next frame. ``ahead`` holds the frames that have been read."""
        views: list[_View] = []
        for n in (2, 1 + _LAGS):  # if there is a fault, more frames tell whether one side is late
            ahead.extend(islice(frames, max(n - len(ahead), 0)))
            views += [_View(ahead[k]) for k in range(len(views), len(ahead))]
            if not views or (self._n_judged and not self._found and _at_rest(views)):
                return
            fault, said = _judge(views, self._fix_sides)
            if fault in ("", "good"):
                break
        self._n_judged += 1
        if fault == "swapped" or (fault == "same" and _stays_the_same(ahead, frames)):
            raise InputError(said)
        if fault not in ("", "good", "same"):
            self._found.setdefault(fault, []).append(said)
        decided = fault == "good" or bool(self.warnings())
        self._open = not decided and self._n_judged < _MOST_JUDGED


class _View:
    """The left and the right image of a frame, with their features."""

    def __init__(self, frame: TimedFrame) -> None:
        self._frame = frame

    @cached_property
    def left(self) -> Image:
        sides = self._frame.sides
        return self._frame.read(map)[0] if sides is None else sides[0]()

    @cached_property
    def left_features(self) -> Described:
        return describe(self.left, _FEATURES)

    @cached_property
    def right_features(self) -> Described:
        sides = self._frame.sides
        right = self._frame.read(map)[1] if sides is None else sides[1]()
        return describe(np.asarray(right, np.uint8), _FEATURES)


def _judge(views: Several[_View], fix_sides: str) -> tuple[str, str]:
    """Judge the pair of the first of several consecutive frames by the images of all of them.

    Returns:
        The name of the fault, and a sentence about it. The name is ``good`` if there is no fault,
        and empty if the images do not allow a verdict.
    """
    first = views[0]
    by_lag = {0: match_described(first.left_features, first.right_features)}
    if len(by_lag[0]) < _FEWEST:
        few = min(len(first.left_features.xy), len(first.right_features.xy)) < _MANY
        return ("", "") if few else ("scenes", _OTHER_SCENE)
    if judge_sides(by_lag[0]) == "same":
        return "same", _SAME_IMAGES
    for k, view in enumerate(views[1:], start=1):
        by_lag[k] = match_described(first.left_features, view.right_features)
        by_lag[-k] = match_described(view.left_features, first.right_features)
    by_lag = {lag: matches for lag, matches in by_lag.items() if len(matches) >= _FEWEST}
    rows = {lag: row_error(matches) for lag, matches in by_lag.items()}
    best = by_lag[min(rows, key=lambda lag: (rows[lag], abs(lag)))]
    disparity = best.left[:, 0] - best.right[:, 0]
    if row_error(best) <= ROWS_PX and np.mean(disparity < -ROWS_PX) > _IN_FRONT:
        return "swapped", (
            f"Left and right are swapped: disparities are negative (median "
            f"{np.median(disparity):.1f} px); {fix_sides}."
        )
    lag = find_lag(rows)
    if lag and rows[lag] <= ROWS_PX:
        frames, late = counted(abs(lag), "frame"), lag > 0
        return f"lag {lag}", (
            f"The right images seem to be {frames} {'late' if late else 'early'}: left images fit "
            f"the right images of {frames} {'later' if late else 'earlier'} better (vertical error "
            f"{rows[lag]:.1f} px) than their own ({rows[0]:.1f} px). Trigger both cameras "
            "together, or correct the times or numbers of the right images."
        )
    sides = judge_sides(by_lag[0])
    if rows[0] > ROWS_PX:
        swapped = f", or left and right are swapped ({fix_sides})" * (sides == "swapped")
        return "rows", (
            f"The rows of the same point in the left and the right image differ by {rows[0]:.1f} "
            "px (median): the pair is not rectified, or its images were not taken at the same "
            f"time{swapped}. Give the calibration of these images with --calib, or calibrate "
            "again; vslam doctor tells more."
        )
    if sides != "good":
        return "outwards", (
            "Many disparities are negative, as if the cameras were turned outwards: calibrate "
            "them again, and check with vslam doctor."
        )
    others = [error for other, error in rows.items() if other]
    return ("good" if min(others, default=0.0) > rows[0] + _LAG_GAIN_PX else ""), ""


def _stays_the_same(ahead: deque[TimedFrame], frames: Iterator[TimedFrame]) -> bool:
    """Return whether no later pair differs from a pair of the same images. ``ahead`` holds the
    frames that have been read. More frames are read."""
    ahead.extend(islice(frames, max(_TITLE - len(ahead), 0)))
    for view in (_View(ahead[len(ahead) // 2]), _View(ahead[-1])):
        matches = match_described(view.left_features, view.right_features)
        if len(matches) >= _FEWEST and judge_sides(matches) != "same":
            return False
    return True


def _at_rest(views: Several[_View]) -> bool:
    """Return whether the left images of the first two frames are the same except for noise."""
    small = [
        cv2.resize(view.left, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
        for view in views[:2]
    ]
    return len(small) < 2 or float(np.mean(cv2.absdiff(small[0], small[1]))) < _AT_REST
