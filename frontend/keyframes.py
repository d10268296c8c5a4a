"""When a frame becomes a keyframe (ORB-SLAM2, section III-E; monocular: ORB-SLAM, V-E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vslam.config import KeyframeConfig
from vslam.frontend.frame import Frame
from vslam.frontend.tracking import TrackingContext, feature_depth
from vslam.map_view import MapView
from vslam.states import PolicyState


@dataclass(frozen=True)
class KeyframeEvidence:
    """What the decision rests on.

    Attributes:
        seconds_since_keyframe: since the last one.
        n_inliers: landmarks tracked in this frame.
        n_reference: landmarks of the reference keyframe that at least three keyframes see
            (all of them in a young map).
        tracked_close: close stereo features of this frame that track a landmark.
        untracked_close: close stereo features that do not.
        gained_close: how many close points the first frame after a keyframe tracks, a running
            mean over the last keyframes; infinite if unknown.
        mapping_idle: the last keyframe's local mapping is finished and merged.
    """

    seconds_since_keyframe: float
    n_inliers: int
    n_reference: int
    tracked_close: int
    untracked_close: int
    mapping_idle: bool
    gained_close: float = np.inf


def needs_keyframe(
    evidence: KeyframeEvidence, config: KeyframeConfig, *, depth: bool = False
) -> bool:
    """Decide. Enough new must be visible, and either mapping is free or it is urgent.

    Few close points ask for a keyframe only if keyframes usually bring enough. On a motorway
    they are few by nature and leave the view before they are seen twice, so that even the frame
    after a keyframe tracks too few. There a share of what that frame tracks is all that is asked
    for, provided that far points hold the pose: as many of them as the close points that are
    wanted. In fog there are none.

    Args:
        depth: of an RGB-D camera. Nearly all it sees is close and mapped at once, so that the
            counts ask for few keyframes; a hand turns it faster than a car turns.
    """
    max_interval_s = config.depth_max_interval_s if depth else config.max_interval_s
    wanted: float = config.min_tracked_close
    tracked_far = evidence.n_inliers - evidence.tracked_close
    if evidence.gained_close < wanted <= tracked_far:
        wanted = config.min_kept_close * evidence.gained_close
    starved = evidence.tracked_close < wanted and evidence.untracked_close > config.min_new_close
    moved_on = evidence.n_inliers < config.max_tracked_ratio * evidence.n_reference
    if evidence.seconds_since_keyframe >= max_interval_s:
        return True
    if not (moved_on or starved):
        return False
    urgent = starved or evidence.n_inliers < config.urgent_ratio * evidence.n_reference
    return evidence.mapping_idle or urgent


def needs_monocular_keyframe(evidence: KeyframeEvidence, config: KeyframeConfig) -> bool:
    """Decide without stereo (ORB-SLAM, V-E): early, since a point is mapped only once two keyframes
    have seen it from different places; keyframes that prove redundant are culled.

    Not by time: while the camera stands still, nothing new can be triangulated.
    """
    tracked, reference = evidence.n_inliers, evidence.n_reference
    if tracked >= config.monocular_ratio * reference:
        return False
    # In a sharp turn the view is new before it is mapped: there every frame counts.
    urgent = tracked < max(config.monocular_urgent_ratio * reference, config.monocular_min_tracked)
    late = evidence.seconds_since_keyframe >= config.max_interval_s
    return evidence.mapping_idle or urgent or late


class CloseGain:
    """What the last keyframes gained: how many close points the first frame after one tracks.

    One such frame may track few by chance; that they are few by nature takes several to show. So
    this is a mean that forgets, and it begins with plenty.

    Attributes:
        mean: of those frames.
        awaited: whether the next frame is the first one after a keyframe.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self.mean = config.first_gain * config.min_tracked_close
        self.awaited = False
        self._weight = config.gain_weight

    def begin(self) -> None:
        """A keyframe was made."""
        self.awaited = True

    def add(self, tracked_close: int) -> None:
        """A frame was tracked."""
        if self.awaited:
            self.mean += self._weight * (tracked_close - self.mean)
            self.awaited = False


@dataclass(frozen=True)
class PlaceEvidence:
    """How well a place is known that a frame has come back to.

    Attributes:
        n_inliers: landmarks tracked in the frame.
        n_shared: of these, landmarks of the old keyframe that shares the most.
        n_place: landmarks of that keyframe that at least three keyframes see.
    """

    n_inliers: int
    n_shared: int
    n_place: int


def is_known_place(evidence: PlaceEvidence, config: KeyframeConfig) -> bool:
    """Whether a keyframe here would repeat an old one: the frame tracks enough landmarks for one
    next to the old keyframe, and shares enough of them with it.

    Few close points are no reason to map the place once more, since mapping it did not make them
    more. At the end of a map the last keyframe has few landmarks that three keyframes observe, and
    the camera would count as being at a known place until it is lost; so a minimum is asked for.
    """
    return (
        evidence.n_inliers >= config.known_min_inliers
        and evidence.n_inliers >= config.max_tracked_ratio * evidence.n_place
        and evidence.n_shared >= config.known_ratio * evidence.n_place
    )


class KeyframePolicy:
    """Decides whether a tracked frame becomes a keyframe. Only ``observe``, ``keyframe_made`` and
    ``restore`` change what it remembers."""

    def __init__(self, context: TrackingContext) -> None:
        self._context = context
        self._config = context.config.keyframes
        self._gain = CloseGain(self._config)

    def observe(
        self, frame: Frame, view: MapView, *, seconds_since_keyframe: float, mapping_idle: bool
    ) -> KeyframeEvidence:
        """Take in a tracked frame; returns what speaks for and against making it a keyframe."""
        depth = feature_depth(frame.features, self._context.camera)
        close, tracked = depth < self._context.close_depth, frame.landmark >= 0
        tracked_close = int(np.count_nonzero(close & tracked))
        self._gain.add(tracked_close)
        return KeyframeEvidence(
            seconds_since_keyframe=seconds_since_keyframe,
            n_inliers=int(np.count_nonzero(tracked)),
            n_reference=view.n_reference,
            tracked_close=tracked_close,
            untracked_close=int(np.count_nonzero(close & ~tracked)),
            mapping_idle=mapping_idle,
            gained_close=self._gain.mean,
        )

    def wants_keyframe(self, evidence: KeyframeEvidence) -> bool:
        """Whether the frame should become a keyframe, unless its place is known."""
        camera = self._context.camera
        if camera.monocular:
            return needs_monocular_keyframe(evidence, self._config)
        return needs_keyframe(evidence, self._config, depth=camera.depth)

    def is_known(self, evidence: PlaceEvidence) -> bool:
        """Whether an old keyframe serves in place of a new one."""
        return is_known_place(evidence, self._config)

    def keyframe_made(self) -> None:
        """Expect the first frame after a keyframe."""
        self._gain.begin()

    def state(self) -> PolicyState:
        """What is remembered of earlier keyframes."""
        return PolicyState(self._gain.mean, self._gain.awaited)

    def restore(self, state: PolicyState) -> None:
        """Remember what ``state`` gave."""
        self._gain.mean, self._gain.awaited = state.gained_close, state.gain_awaited
