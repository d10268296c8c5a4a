"""The start of a map, and the start of a sub-map after the camera was lost.

A stereo or RGB-D map begins with one frame that has enough points. A monocular map needs two
frames. The first frame is kept until a later frame forms a pair with it. The poses of the frames
that were offered meanwhile are found as soon as the map has begun.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.two_views import adjust_two_views
from vslam.frontend.alignment import find_patches
from vslam.frontend.images import GivenFeatures
from vslam.frontend.initialization import Align, KnownTurn, match_views, reconstruct
from vslam.frontend.patches import patches_around
from vslam.frontend.prediction import Prediction
from vslam.frontend.tracker import Tracker
from vslam.types.camera import Image
from vslam.types.context import Context
from vslam.types.features import Extracted, LandmarkPatches, TrackingState
from vslam.types.geometry import (
    Matrix,
    inverse,
    orthonormalised,
    se3_exp,
    se3_log,
    transform,
)
from vslam.types.map_view import MapView
from vslam.types.track import Track

# Two pairs of frames give the same scene if the ratios of the depths of at least _MIN_COMMON points
# differ by at most this factor in the median, as a natural logarithm. In rendered halls, rooms and
# towns, it was at most 0.24 for pairs whose translations are wrong by less than 8 degrees. [own]
_MIN_COMMON, _MAX_SPREAD = 30, 0.3
# At most this many frames wait for the map. Each takes about 0.1 MB, and 10 ms when the map begins.
# The newest also keep their images, about 1 MB each, to which matches are aligned. [own]
_MAX_WAITING, _WITH_IMAGES = 300, 60

# Largest angle between the directions in which a camera has moved according to an IMU that carried
# it, and according to two views, in rad. [own]
_MAX_ANGLE = np.radians(10.0)

TurnBetween = Callable[[float, float], KnownTurn | None]


@dataclass(frozen=True)
class TwoViewStart:
    """The start of a monocular map or sub-map from two frames.

    Attributes:
        first, second: the two frames. The map begins at the pose of the first frame. The matches of
            the second are aligned to the first (``Track.shift``).
        images: their ``(H, W)`` uint8 images for loop detectors. None if they are not available.
        T_2_1: ``(4, 4)``, maps points from the camera of the first frame to the camera of the
            second frame.
        features: two ``(N,)`` int64 arrays with the indices of the matched features in the first
            frame and in the second frame.
        points: ``(N, 3)`` points that were triangulated from these features, in the frame of the
            first camera.
        predicted: whether the unit of the map was derived from the speed that the camera had before
            it was lost.
        waiting: the other frames before the second frame that may show the same scene, in the order
            of time. They are not tracked.
    """

    first: Track
    second: Track
    images: tuple[Image | None, Image | None]
    T_2_1: Matrix
    features: tuple[NDArray[np.int64], NDArray[np.int64]]
    points: Matrix
    predicted: bool = False
    waiting: tuple[Track, ...] = ()

    @property
    def twist(self) -> Matrix:
        """``(6,)`` twist per second from the first frame to the second frame."""
        return se3_log(self.T_2_1) / (self.second.timestamp - self.first.timestamp)

    def at_speed(self, twist: Matrix | None, max_rescaling: float) -> TwoViewStart:
        """Scale the start of a sub-map to the speed that the camera had before it was lost.

        The unit of the sub-map is then approximately the unit of the map before the loss.

        Args:
            twist: ``(6,)`` twist per second before the camera was lost. None if it is unknown.
            max_rescaling: nothing is scaled if the factor is larger than this number or smaller
                than its inverse.
        """
        if twist is None:
            return self
        moved = np.linalg.norm(twist[:3]) * (self.second.timestamp - self.first.timestamp)
        factor = float(moved / np.linalg.norm(self.T_2_1[:3, 3]))
        if not 1.0 / max_rescaling < factor < max_rescaling:
            return self
        return self._scaled(factor)

    @property
    def is_carried(self) -> bool:
        """Whether an IMU measured the poses of both frames."""
        return self.first.state == self.second.state == TrackingState.INERTIAL

    def as_carried(self) -> TwoViewStart | None:
        """Scale the start to the distance between the two frames that the IMU measured. None if the
        IMU measured another direction."""
        measured = (self.second.T_cw @ inverse(self.first.T_cw))[:3, 3]
        metres, units = np.linalg.norm(measured), np.linalg.norm(self.T_2_1[:3, 3])
        if not measured @ self.T_2_1[:3, 3] > np.cos(_MAX_ANGLE) * metres * units:
            return None
        return self._scaled(float(metres / units))

    def _scaled(self, factor: float) -> TwoViewStart:
        T_2_1 = self.T_2_1.copy()
        T_2_1[:3, 3] *= factor
        return replace(self, T_2_1=T_2_1, points=factor * self.points, predicted=True)

    def agrees(self, before: TwoViewStart) -> bool:
        """Return whether an earlier start gives the same scene, up to scale. Its first or second
        frame must be the first frame of this start."""
        which = 0 if before.first.index == self.first.index else 1
        points = before.points if which == 0 else transform(before.T_2_1, before.points)
        _, mine, theirs = np.intersect1d(
            self.features[0], before.features[which], return_indices=True
        )
        if len(mine) < _MIN_COMMON:
            return False
        ratio = np.log(self.points[mine, 2] / points[theirs, 2])
        return bool(np.median(np.abs(ratio - np.median(ratio))) <= _MAX_SPREAD)


class Starter:
    """Finds the two frames with which a monocular map or sub-map can begin.

    A pair of frames can be explained by a wrong motion and a wrong scene. Therefore, a map begins
    only if two pairs give the same scene: a later frame must also form a pair with the first or the
    second frame.
    """

    def __init__(
        self,
        context: Context,
        turn_between: TurnBetween | None = None,
    ) -> None:
        """
        Args:
            turn_between: returns the rotation of the camera between two times, in seconds, or None
                if it is unknown. None if there is no IMU.
        """
        self._context, self._turn_between = context, turn_between
        self._first: tuple[Track, Image | None] | None = None
        self._start: TwoViewStart | None = None  # waits for a second pair
        self._waiting: tuple[Track, ...] = ()

    @property
    def is_waiting(self) -> bool:
        """Whether frames are waiting for a monocular map."""
        return len(self._waiting) > 0

    def reset(self) -> None:
        """Discard all frames that are waiting for a monocular map."""
        self._first = self._start = None
        self._waiting = ()

    def wait(self, track: Track) -> None:
        """Let a frame that was not tracked wait for a map, without trying to begin one.

        A frame with so few features that no map can begin ends the wait of all earlier frames.
        """
        if len(track.features) < self._context.config.initialization.min_matches:
            self._waiting = ()
            return
        waiting = [*self._waiting, track][-_MAX_WAITING:]
        if len(waiting) > _WITH_IMAGES:
            old = waiting[-_WITH_IMAGES - 1]
            waiting[-_WITH_IMAGES - 1] = replace(old, extracted=Extracted(old.features))
        self._waiting = tuple(waiting)

    def offer(self, track: Track, image: Image | None) -> TwoViewStart | None:
        """Try to begin a map with a frame that was not tracked and the earlier frame that was kept.

        If the two frames have too few matches or are too far apart in time, the new frame replaces
        the kept frame.

        Args:
            image: the ``(H, W)`` uint8 image of the frame. None if it is not available.

        Returns:
            The two frames with which the map begins, or None if it cannot begin yet.
        """
        start = self._find_start(track, image)
        if start is None:
            self.wait(track)
            return None
        pair = start.first.index, start.second.index
        waiting = tuple(one for one in self._waiting if one.index not in pair)
        return replace(start, waiting=waiting)

    def _find_start(self, track: Track, image: Image | None) -> TwoViewStart | None:
        config, second = self._context.config.initialization, (track, image)
        if self._first is None or track.timestamp - self._first[0].timestamp > config.max_seconds:
            self._keep(second)
            return None
        features = match_views(self._first[0].features, track.features, self._context)
        before, enough = self._start, len(features[0]) >= config.min_matches
        start = self._pair(self._first, second, features) if enough else None
        if start is not None and (before is None or not start.agrees(before)):
            self._start = start
            return None
        if start is None and before is not None:  # the camera may have moved far since the first
            middle = _unaligned(before.second), before.images[1]
            features = match_views(before.second.features, track.features, self._context)
            start = self._pair(middle, second, features)
            if start is not None and not start.agrees(before):
                start = None
        if start is None and not enough:
            self._keep(second)
        return start

    def _keep(self, frame: tuple[Track, Image | None]) -> None:
        self._start = None
        enough = len(frame[0].features) >= self._context.config.initialization.min_features
        self._first = frame if enough else None

    def _pair(
        self,
        first: tuple[Track, Image | None],
        second: tuple[Track, Image | None],
        features: tuple[NDArray, NDArray],
    ) -> TwoViewStart | None:
        config, camera = self._context.config.initialization, self._context.camera
        of_1, of_2 = first[0].features, second[0].features
        xy_1, xy_2 = of_1.xy[features[0]].astype(float), of_2.xy[features[1]].astype(float)
        sigma = self._context.scales[of_1.octave[features[0]]]
        turn = None
        if self._turn_between is not None:
            turn = self._turn_between(first[0].timestamp, second[0].timestamp)
        align = _aligned_to(first[0], second[0], features, self._context)
        found = reconstruct(
            xy_1, xy_2, sigma, camera, config, seed=second[0].index, turn=turn, align=align
        )
        if found is None:
            return None
        match, shift = found.match, found.shift
        aligned = np.isfinite(shift[:, 0])
        certainty = np.where(aligned, self._context.aligned_certainty, 1)
        T_2_1, points, kept = adjust_two_views(
            found.T_2_1,
            found.points,
            np.stack([xy_1[match], xy_2[match] + np.where(aligned[:, None], shift, 0.0)], axis=1),
            sigma[match] / np.sqrt(certainty),
            camera,
            config.median_depth,
        )
        if np.count_nonzero(kept) < config.min_landmarks:
            return None
        match, shift = match[kept], shift[kept]
        features, track = (features[0][match], features[1][match]), second[0]
        if aligned.any():
            all_shifts = np.full(of_2.xy.shape, np.nan, np.float32)
            all_shifts[features[1]] = shift
            track = replace(track, shift=all_shifts)
        images = first[1], second[1]
        return TwoViewStart(first[0], track, images, T_2_1, features, points[kept])


def _unaligned(track: Track) -> Track:
    return track if track.shift is None else replace(track, shift=None)


def _aligned_to(
    first: Track, second: Track, features: tuple[NDArray, NDArray], context: Context
) -> Align | None:
    """Return the function that aligns the matches of two frames; None if their images are not
    available."""
    pyramid_1, pyramid_2 = first.extracted.pyramid, second.extracted.pyramid
    if pyramid_1 is None or pyramid_2 is None:
        return None
    scales, of_1, of_2 = context.scales, first.features, second.features
    n, xy_1, octave_1 = len(features[0]), of_1.xy[features[0]], of_1.octave[features[0]]
    patches = LandmarkPatches(
        np.arange(n, dtype=np.int32),
        np.arange(n),
        np.zeros(n, np.int64),
        scales[octave_1],
        of_1.angle[features[0]],
        patches_around(pyramid_1, xy_1, octave_1),
        np.zeros((n, 2), np.float32),
        np.eye(4)[None],
    )

    def align(T_2_1: Matrix, match: NDArray[np.int64], points: Matrix) -> Matrix:
        xy, octave = of_2.xy[features[1][match]], of_2.octave[features[1][match]]
        intrinsics, config = context.camera.intrinsics, context.config.alignment
        shift = find_patches(
            pyramid_2, xy, octave, T_2_1, points, patches, match, scales, intrinsics, config
        )
        return np.asarray(shift * scales[octave][:, None], np.float64)

    return align


def track_waiting(
    start: TwoViewStart, first: Track, second: Track, view: MapView, tracker: Tracker
) -> list[Track]:
    """Track the frames that waited for a map which has now begun.

    The frames between the first and the second frame are tracked forwards in time, and those before
    the first frame backwards.

    Args:
        first, second: the frames of the start, with their poses and landmarks in the map.
        view: what tracking sees of this map.

    Returns:
        The frames that were tracked. The others show too little of the scene.
    """
    found = []
    between = [one for one in start.waiting if one.index > first.index]
    before = [one for one in reversed(start.waiting) if one.index < first.index]
    for waiting in (between, before):
        last, twist = first, start.twist
        for one in waiting:
            seconds = one.timestamp - last.timestamp
            if one.index > first.index:
                left = orthonormalised(second.T_cw @ inverse(last.T_cw))
                twist = se3_log(left) / (second.timestamp - last.timestamp)
            T_cw = orthonormalised(se3_exp(twist * seconds) @ last.T_cw)
            predicted = Prediction(one.index, one.timestamp, T_cw, twist=twist, last=last)
            images = GivenFeatures(one.extracted)
            track = tracker.track_features(replace(one, T_cw=T_cw), images, predicted, view)
            if track.is_lost:
                twist = np.zeros(6)
                continue
            twist = se3_log(orthonormalised(track.T_cw @ inverse(last.T_cw))) / seconds
            last = track
            found.append(track)
    return found
