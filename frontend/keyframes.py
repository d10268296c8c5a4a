"""Decides when a frame becomes a keyframe, following section III-E of the ORB-SLAM2 paper. For
monocular cameras, the rules follow section V-E of the ORB-SLAM paper."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vslam.config import KeyframeConfig
from vslam.frontend.tracking import feature_depth
from vslam.types.context import Context
from vslam.types.geometry import transform
from vslam.types.map_view import MapView
from vslam.types.states import PolicyState
from vslam.types.track import Track

# If keyframes add on average fewer close points than `min_tracked_close`, this fraction of the
# average replaces `min_tracked_close` (docs/research/motorway.md). [own]
_MIN_KEPT_CLOSE = 0.2
# Before the first observation, the number of close points that a keyframe adds is assumed to be
# this multiple of `min_tracked_close`. [own]
_FIRST_GAIN = 2.0
# Weight of the latest keyframe in the running mean of the number of close points that a keyframe
# adds. A larger weight adapts faster to the scene. [own]
_GAIN_WEIGHT = 0.2
# When frames are tracked by patches, a keyframe is planned up to this many frames ahead, so that
# its features can be extracted in advance. [own]
_PATCH_LEAD_FRAMES = 2
# A keyframe is inserted, even while local mapping is busy, if the frame tracks less than this
# fraction of the landmarks of the reference keyframe. [OS1 V-E, customary]
_URGENT_RATIO = 0.25
# With a monocular camera, a keyframe is also inserted while local mapping is busy if fewer
# landmarks than this are tracked. If the frame was tracked by patches, it is inserted afterwards.
# [own]
_MONOCULAR_MIN_TRACKED = 100
# The same fraction for a monocular camera. [own]
_MONOCULAR_URGENT_RATIO = 0.5
# A monocular frame that was tracked by patches becomes a keyframe if it tracks less than this
# fraction of the landmarks that were tracked when those of the last keyframe had been triangulated.
# With a smaller fraction, the map has too few landmarks for a fast turn. [own]
_MONOCULAR_PATCH_KEPT = 0.8


@dataclass(frozen=True)
class KeyframeEvidence:
    """The quantities that a keyframe decision depends on. Close points have a depth that stereo
    measures accurately. With a monocular camera, all points that are tracked count as close.

    Attributes:
        seconds_since_keyframe: time since the last keyframe, seconds.
        n_inliers: number of landmarks that this frame tracks. If not all patches were searched
            for (``MapView.patch_stride``), this and the numbers of close points are estimates.
        n_reference: number of landmarks of the reference keyframe that enough keyframes observe
            (``MapView.n_reference``).
        tracked_close: number of close stereo features of this frame that track a landmark.
        untracked_close: number of close stereo features that track no landmark. None for a frame
            that was tracked by patches and has no features; the number is then assumed to be large
            enough.
        mapping_idle: whether local mapping of the last keyframe is finished, and its result is
            visible to tracking.
        gained_close: number of close points that the first frame after a keyframe tracks, as a
            running mean over the last keyframes. It is infinite if unknown.
        first_close: number of close points that the first frame after the last keyframe tracks.
            With a monocular camera, it is the first frame that sees the landmarks that were
            triangulated at the last keyframe. It is 0 before.
        close_ratio: factor, at most 1, by which the number of tracked close points has changed per
            frame since the first frame after the last keyframe.
    """

    seconds_since_keyframe: float
    n_inliers: int
    n_reference: int
    tracked_close: int
    untracked_close: int | None
    mapping_idle: bool
    gained_close: float = np.inf
    first_close: int = 0
    close_ratio: float = 1.0

    def ahead(self, frames: int) -> KeyframeEvidence:
        """Predict the evidence some frames later, if the number of tracked close points continues
        to change by the factor ``close_ratio`` per frame."""
        close = round(self.tracked_close * self.close_ratio**frames)
        n_inliers = self.n_inliers + close - self.tracked_close
        return replace(self, tracked_close=close, n_inliers=n_inliers)


def needs_keyframe(
    evidence: KeyframeEvidence, config: KeyframeConfig, *, depth: bool = False
) -> bool:
    """Return whether a stereo or RGB-D frame should become a keyframe.

    There are three reasons: the last keyframe is old, the view has changed enough, or too few close
    points are tracked. For the last two reasons, a keyframe is made only if local mapping is idle
    or the need is urgent.

    A lack of close points counts only if a new keyframe would provide more of them. On a motorway,
    even the first frame after a keyframe tracks too few close points. In that case, a lower
    threshold applies: a fraction of the number that such a first frame tracks on average
    (``gained_close``). The lower threshold applies only if enough far points constrain the pose. In
    fog, there are no far points.

    Args:
        depth: whether the camera is RGB-D. The maximum time between keyframes is then shorter,
            because the counts alone would lead to too few keyframes: nearly all points are close
            and are mapped at once.
    """
    max_interval_s = config.depth_max_interval_s if depth else config.max_interval_s
    required: float = config.min_tracked_close
    tracked_far = evidence.n_inliers - evidence.tracked_close
    if evidence.gained_close < required <= tracked_far:
        required = _MIN_KEPT_CLOSE * evidence.gained_close
    gains = evidence.untracked_close is None or evidence.untracked_close > config.min_new_close
    lacks_close = evidence.tracked_close < required and gains
    moved_on = evidence.n_inliers < config.max_tracked_ratio * evidence.n_reference
    if evidence.untracked_close is None:
        # Patches are tracked longer than features. The number of inliers alone therefore reveals a
        # change of view too late, so the number of close points is tested as well.
        moved_on |= evidence.tracked_close < config.patch_kept_close * evidence.first_close
    if evidence.seconds_since_keyframe >= max_interval_s:
        return True
    if not (moved_on or lacks_close):
        return False
    urgent = lacks_close or evidence.n_inliers < _URGENT_RATIO * evidence.n_reference
    return evidence.mapping_idle or urgent


def needs_monocular_keyframe(evidence: KeyframeEvidence, config: KeyframeConfig) -> bool:
    """Return whether a monocular frame should become a keyframe (section V-E of the ORB-SLAM
    paper).

    Keyframes are made early, because a point can be mapped only after two keyframes have seen it
    from different positions. Redundant keyframes are culled later. The time since the last keyframe
    is not a reason by itself, because nothing new can be triangulated while the camera stands
    still.

    A frame that was tracked by patches is compared with the first frame that tracked the landmarks
    of the last keyframe. Landmarks are lost because they leave the image, or because they look
    different after a large motion. In both cases, it is time to triangulate new ones. They are
    visible only after mapping, so there is no reason to insert another keyframe before.
    """
    tracked, reference = evidence.n_inliers, evidence.n_reference
    if evidence.untracked_close is None:
        least = max(_MONOCULAR_PATCH_KEPT * evidence.first_close, _MONOCULAR_MIN_TRACKED)
        return evidence.mapping_idle and tracked < least
    if tracked >= config.monocular_ratio * reference:
        return False
    # In a sharp turn, the view changes faster than it is mapped, so the keyframe cannot wait.
    urgent = tracked < max(_MONOCULAR_URGENT_RATIO * reference, _MONOCULAR_MIN_TRACKED)
    late = evidence.seconds_since_keyframe >= config.max_interval_s
    return evidence.mapping_idle or urgent or late


def count_close(state: PolicyState, tracked_close: int, frame: int) -> PolicyState:
    """Update the running mean of the number of close points that the first frame after a keyframe
    tracks. Returns the new state, which is unchanged if this frame is not the first after a
    keyframe.

    A single frame may track few close points by chance. Therefore, the mean is an exponential
    moving average that starts at a high value.

    Args:
        tracked_close: number of close points that the frame tracks.
        frame: index of the frame.
    """
    if not state.gain_awaited:
        return state
    mean = state.gained_close + _GAIN_WEIGHT * (tracked_close - state.gained_close)
    return PolicyState(mean, False, tracked_close, frame, state.due)


def close_ratio(state: PolicyState, tracked_close: int, frame: int) -> float:
    """Compute the factor by which the number of tracked close points has changed per frame since
    the first frame after the last keyframe. It is 1 if the number has not fallen.

    Args:
        tracked_close: number of close points that the current frame tracks.
        frame: index of the current frame.
    """
    if not 0 < tracked_close < state.first_close:
        return 1.0
    share = tracked_close / state.first_close
    return float(share ** (1 / max(1, frame - state.first_frame)))


class KeyframePolicy:
    """Decides whether a tracked frame becomes a keyframe.

    Attributes:
        state: what is known from the frames so far.
    """

    def __init__(self, context: Context, state: PolicyState | None = None) -> None:
        self._context = context
        self._config = context.config.keyframes
        first = _FIRST_GAIN * self._config.min_tracked_close
        self.state = PolicyState(first, gain_awaited=False) if state is None else state

    @property
    def due(self) -> int:
        """Index of the frame that is planned to become a keyframe; -1 if none is planned."""
        return self.state.due

    def observe(
        self, track: Track, view: MapView, *, seconds_since_keyframe: float, mapping_idle: bool
    ) -> KeyframeEvidence:
        """Update the state with a tracked frame. Returns the evidence for ``wants_keyframe``."""
        tracked = track.landmark >= 0
        untracked_close = None
        if track.by_patches:
            close = transform(track.T_cw, track.xyz)[:, 2] < self._context.close_depth
        else:
            depth = feature_depth(track.features, self._context.camera)
            close = depth < self._context.close_depth
            untracked_close = int(np.count_nonzero(close & ~tracked))
        monocular = self._context.camera.monocular
        if monocular:
            close = tracked
        stride = view.patch_stride if track.by_patches else 1
        tracked_close = stride * int(np.count_nonzero(close & tracked))
        if mapping_idle or not monocular:
            self.state = count_close(self.state, tracked_close, track.index)
        state = self.state
        return KeyframeEvidence(
            seconds_since_keyframe=seconds_since_keyframe,
            n_inliers=stride * int(np.count_nonzero(tracked)),
            n_reference=view.n_reference,
            tracked_close=tracked_close,
            untracked_close=untracked_close,
            mapping_idle=mapping_idle,
            gained_close=state.gained_close,
            first_close=0 if state.gain_awaited else state.first_close,
            close_ratio=close_ratio(state, tracked_close, track.index),
        )

    def wants_keyframe(self, evidence: KeyframeEvidence) -> bool:
        """Return whether the frame should become a keyframe. The method ``is_known`` tests whether
        the place is already mapped."""
        camera = self._context.camera
        if camera.monocular:
            return needs_monocular_keyframe(evidence, self._config)
        return needs_keyframe(evidence, self._config, depth=camera.depth)

    def is_known(self, *, n_inliers: int, n_shared: int, n_place: int) -> bool:
        """Return whether the place that the frame shows is already mapped, so that a new keyframe
        would repeat an old one.

        Two conditions must hold. The frame must track as many landmarks as is expected of a frame
        next to the old keyframe. It must also share enough of these landmarks with the old
        keyframe. A lack of close points is not a reason to map a known place again.

        In addition, the frame must have a minimum number of inliers. The last keyframe of a map has
        few landmarks that at least three keyframes observe. Without the minimum, no keyframe would
        be made when the camera moves beyond the end of the map.

        Args:
            n_inliers: number of landmarks that the frame tracks.
            n_shared: number of these landmarks that the old keyframe observes. The old keyframe is
                the keyframe that observes the largest number of these landmarks.
            n_place: number of landmarks that the old keyframe and at least two other keyframes
                observe.
        """
        return (
            n_inliers >= self._config.known_min_inliers
            and n_inliers >= self._config.max_tracked_ratio * n_place
            and n_shared >= self._config.known_ratio * n_place
        )

    def is_due(self, index: int, evidence: KeyframeEvidence) -> bool:
        """Return whether a frame that was tracked by patches must now become a keyframe as planned.

        A keyframe is planned a few frames before it is expected to be needed, so that its features
        can be extracted in the background.
        """
        if self.due < 0:
            soon = range(_PATCH_LEAD_FRAMES + 1)
            planned = (index + k for k in soon if self.wants_keyframe(evidence.ahead(k)))
            self.state = replace(self.state, due=next(planned, -1))
        elif evidence.n_inliers < self._config.min_tracked_close and self.wants_keyframe(evidence):
            self.state = replace(self.state, due=index)  # the plan came too late
        if not 0 <= self.due <= index:
            return False
        self.state = replace(self.state, due=-1)
        return True

    def reference_renewed(self) -> None:
        """Note that a keyframe was inserted, or that an existing one became the reference."""
        self.state = replace(self.state, gain_awaited=True, due=-1)
