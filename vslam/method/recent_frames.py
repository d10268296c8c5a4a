"""Finds the poses of the newest frames of a monocular camera again when the map has been adjusted.

A frame is tracked against landmarks whose depths are still uncertain, because only few views of
them exist. Bundle adjustment of the next keyframes corrects these landmarks and the keyframes, but
not the frames between them. Their errors then appear as jumps at each keyframe. Therefore, what a
frame observed is kept until two more keyframes have been mapped, and then gives its final pose.

Tracking does not use these poses, so that the map does not depend on them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.pose import optimise_pose
from vslam.frontend.tracking import observed_points
from vslam.types.context import Context
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import Matrix, orthonormalised, transform
from vslam.types.map import Map
from vslam.types.map_kernels import resolve
from vslam.types.states import FrameObservations
from vslam.types.track import By, Track

# Number of keyframes that must have been mapped since the frame. In five rendered drives, errors of
# the rotation were 12 % larger after one keyframe, and 4 % larger after four. [own]
_KEYFRAMES = 2
# Greatest number of frames that are kept; each takes about 10 kB. A camera that hardly moves has no
# keyframe for a long time. [own]
_MOST_FRAMES = 200
# The new pose is used only if at least this fraction of the landmarks, and at least
# `tracking.min_inliers` of them, agree with it. [own]
_MIN_SHARE = 0.5
# Aligned matches are usually better than the standard deviation that tracking assumes, which must
# allow for a wrong map. It is therefore estimated from the median error (Rousseeuw and Leroy,
# *Robust Regression and Outlier Detection*, 1987, section 5.1), but is at least this fraction of
# what tracking assumes. In five rendered drives, errors of the rotation became 9 to 32 % smaller.
# [own]
_LEAST_SIGMA = 0.2
_MEDIAN = np.sqrt(2.0 * np.log(2.0))  # median length of a standard normal vector in two dimensions


class RecentFrames:
    """The newest frames of a monocular camera whose poses are not final yet."""

    def __init__(
        self, context: Context, poses: FramePoses, frames: tuple[FrameObservations, ...] = ()
    ) -> None:
        """
        Args:
            poses: the recorded poses of all frames, which are changed.
            frames: what a checkpoint contains (``all``).
        """
        self._context = context
        self._poses = poses
        self._frames = {one.index: one for one in frames}

    def all(self) -> tuple[FrameObservations, ...]:
        """Return what is kept, for a checkpoint."""
        return tuple(self._frames.values())

    def add(self, track: Track, n_keyframes: int) -> None:
        """Keep what a frame observed, whose pose has been recorded.

        Nothing is kept of a frame whose pose was found in another way than by its landmarks alone:
        while the camera stands still, or together with the samples of an IMU.

        Args:
            n_keyframes: number of keyframes of the map.
        """
        if track.is_lost or track.inertial is not None or track.by is By.STANDSTILL:
            return
        seen = np.flatnonzero(track.landmark >= 0)
        _, uvr, weight, *_ = observed_points(track, seen, self._context)
        self._frames[track.index] = FrameObservations(
            track.index,
            n_keyframes,
            *self._poses.relative(track.index),
            track.landmark[seen],
            uvr[:, :2].astype(np.float32),
            (weight**-0.5).astype(np.float32),
        )
        if len(self._frames) > _MOST_FRAMES:
            del self._frames[next(iter(self._frames))]

    def forget(self, index: int) -> None:
        """Forget a frame, which became a keyframe."""
        self._frames.pop(index, None)

    def renumber(self, new_id: NDArray[np.int32]) -> None:
        """Replace the ids of landmarks (``Map.drop_culled_landmarks``)."""
        self._frames = {
            index: one.observing(np.where(one.landmark >= 0, new_id[one.landmark], -1))
            for index, one in self._frames.items()
        }

    def settle(self, map_: Map) -> None:
        """Find the final poses of the frames after which enough keyframes have been mapped."""
        for one in self.all():
            if map_.n_keyframes - one.n_keyframes >= _KEYFRAMES:
                self._find(one, map_)
                del self._frames[one.index]

    def conclude(self, map_: Map) -> None:
        """Find the poses of the other frames at the end of a drive, except that of the last frame.

        The drive may go on nevertheless. It then does so as if this had not been called: the last
        frame is the one that tracking continues from, and the others are kept.
        """
        for one in self.all():
            if one.index < len(self._poses) - 1:
                self._find(one, map_)

    def _find(self, frame: FrameObservations, map_: Map) -> None:
        """Find the pose of a frame relative to its landmarks in the map. The pose as it was tracked
        is the first guess, and is used if too few landmarks agree."""
        T_cw = self._poses.in_map(frame.keyframe, frame.T_c_keyframe, frame.unit_scale)
        found = _optimised(frame, T_cw, map_, self._context)
        reference = self._poses.relative(frame.index).keyframe
        self._poses.follow(frame.index, reference, T_cw if found is None else found)


def _optimised(
    frame: FrameObservations, T_cw: Matrix, map_: Map, context: Context
) -> Matrix | None:
    ids = resolve(map_.arrays, frame.landmark)
    seen = np.flatnonzero(ids >= 0)
    least = max(context.config.tracking.min_inliers, _MIN_SHARE * len(seen))
    if len(seen) < least:
        return None
    xyz, uvr = map_.arrays.xyz[ids[seen]], np.full((len(seen), 3), np.nan)
    uvr[:, :2] = frame.xy[seen]
    sigma, camera, found = frame.sigma[seen].astype(np.float64), context.camera, None
    for _ in range(2):
        T_cw, inlier = optimise_pose(T_cw, xyz, uvr, sigma**-2.0, camera.intrinsics)
        if np.count_nonzero(inlier) < least:
            break
        found = orthonormalised(T_cw)
        errors = camera.project(transform(T_cw, xyz[inlier]))[:, :2] - uvr[inlier, :2]
        usual = np.median(np.linalg.norm(errors, axis=1) / sigma[inlier]) / _MEDIAN
        sigma = sigma * np.clip(usual, _LEAST_SIGMA, 1.0)
    return found
