"""Tracks a frame against a ``MapView``, a copy of the map for tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.frontend.images import Images
from vslam.frontend.patch_tracking import (
    NO_PATCHES_FOUND,
    PatchTrack,
    track_patches,
    track_standing,
)
from vslam.frontend.pose import MIN_TRUSTED
from vslam.frontend.pose_alignment import align_pose
from vslam.frontend.prediction import Prediction
from vslam.frontend.rig import corrected
from vslam.frontend.tracking import (
    MIN_INLIERS_FRAME,
    MIN_INLIERS_LOST,
    judge,
    track_local_map,
    track_previous_frame,
)
from vslam.support.machine import StageClock
from vslam.types.context import Context
from vslam.types.features import Extracted, TrackingState, nearest_features
from vslam.types.geometry import Matrix, inverse, transform
from vslam.types.map_view import MapView
from vslam.types.track import By, Standstill, Track

# If the features of a frame do not match either, its pose is nevertheless found by patches if at
# least this fraction of the patches agree with it. The frame is then WEAK. [own]
_PATCH_FALLBACK_RATIO = 0.5
# If too few descriptors of a new keyframe match, each landmark whose patch was found is matched
# to the nearest feature. The distance is at most this value, in pixels of the feature's octave.
# [own]
_PATCH_FEATURE_REACH = 2.0

# The prediction of the motion is wrong by at most this acceleration, m/s^2, in ordinary drives. A
# pose that implies a larger one needs IMPLAUSIBLE^-1 times as many landmarks that agree with it.
ACCELERATION = 10.0
IMPLAUSIBLE = 0.5


class Tracker:
    """Tracks frames. It has no state: a ``Prediction`` contains what earlier frames tell."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._config = context.config

    def track(
        self, images: Images, predicted: Prediction, view: MapView, clock: StageClock
    ) -> Track:
        """Track a frame by patches or, if this fails, by features."""
        by_patches = self.track_patches(images, predicted, view)
        clock.lap("track")
        if by_patches.state == TrackingState.OK:
            return by_patches
        track = self.extract(images, predicted, view)
        clock.lap("extract")
        track = self.track_features(track, images, predicted, view)
        clock.lap("track")
        return by_patches if track.is_lost and not by_patches.is_lost else track

    def extract(self, images: Images, predicted: Prediction, view: MapView) -> Track:
        """Return the frame at its predicted pose with its features, which are not matched yet."""
        extracted = self._corrected(images.extracted, predicted.twist, view)
        return replace(predicted.lost, coarse=images.coarse).with_features(extracted)

    def _corrected(self, extracted: Extracted, twist: Matrix | None, view: MapView) -> Extracted:
        return corrected(extracted, view.disparity_offset, twist, self._context.camera)

    # Tracking by patches

    def track_patches(self, images: Images, predicted: Prediction, view: MapView) -> Track:
        """Track a frame using the image patches of landmarks, without extracting features.

        The frame is OK if it can be tracked by patches alone, WEAK if it can be tracked by patches
        only if its features do not match either, and otherwise LOST.
        """
        still = predicted.standstill(view)
        found = self._find_patches(images, predicted, _trusting(view, still), still)
        state = judge_patches(found, still, self._context)
        if state == TrackingState.LOST:
            return predicted.lost
        return replace(
            predicted.lost,
            T_cw=found.T_cw,
            extracted=Extracted(found.features),
            landmark=found.ids,
            xyz=found.xyz,
            state=state,
            by=By.STANDSTILL if found.stands_still else By.PATCHES,
            n_matches=found.n_matches,
            n_inliers=len(found.ids),
            visible=found.visible,
            support=found.trusted_share,
            coarse=images.coarse,
        )

    def _find_patches(
        self, images: Images, predicted: Prediction, view: MapView, still: Standstill | None
    ) -> PatchTrack:
        """Return the best pose by patches. The result has no landmarks if the frame cannot be
        tracked in this way, for example because the previous frame was not tracked."""
        last, pyramid, T_cw = predicted.last, images.pyramid, predicted.T_cw
        if pyramid is None or last is None or not len(view.patches.ids):
            return NO_PATCHES_FOUND
        if still is not None:
            track = track_standing(pyramid, last.T_cw, still, view, self._context, images.mask)
            if track.stands_still:
                return track
        if last.twist is None or not predicted.is_tracking:
            return NO_PATCHES_FOUND
        if self._context.awaits_scale(metric=view.metric):
            return NO_PATCHES_FOUND

        def track_from(T_start: Matrix) -> PatchTrack:
            return track_patches(pyramid, T_start, view, self._context, images.mask)

        def support(track: PatchTrack) -> float:
            return (1.0 if is_plausible(track) else IMPLAUSIBLE) * track.support

        def is_plausible(track: PatchTrack) -> bool:
            if self._context.camera.monocular:  # the unit of the map is not a metre
                return True
            jump = np.linalg.norm((track.T_cw @ inverse(T_cw))[:3, 3])
            return bool(jump <= ACCELERATION * predicted.seconds**2)

        T_aligned = self._align(images, last, last.landmark >= 0, T_cw)
        track = track_from(T_aligned)
        doubtful = track.share < self._config.tracking.patch_retry_ratio or track.lacks_support
        if (doubtful or not is_plausible(track)) and T_aligned is not T_cw:
            # Image alignment may have followed moving objects.
            track = max(track, track_from(T_cw), key=support)
        if track.lacks_support:
            confirmed = view.local_landmarks.confirms(last.landmark)
            if np.count_nonzero(confirmed) >= MIN_TRUSTED:
                T_aligned = self._align(images, last, confirmed, T_cw)
                track = max(track, track_from(T_aligned), key=support)
        if track.lacks_support and not is_plausible(track):
            return NO_PATCHES_FOUND
        return track

    def _align(
        self, images: Images, last: Track, chosen: NDArray[np.bool_], T_cw: Matrix
    ) -> Matrix:
        """Correct a predicted pose by sparse image alignment to the last frame.

        Args:
            chosen: ``(N,)`` bool, the features of the last frame whose landmarks are used.
        """
        if images.coarse is None or last.coarse is None:
            return T_cw
        camera, xyz = self._context.camera, last.xyz[chosen]
        if images.mask is not None:
            uv = camera.project(transform(T_cw, xyz))[:, :2]
            coarsest = np.full(len(xyz), self._config.orb.n_levels - 1)
            xyz = xyz[images.mask.shows(uv, coarsest)]
        size = camera.height, camera.width
        return align_pose(images.coarse, last.coarse, xyz, last.T_cw, T_cw, camera.intrinsics, size)

    def match_features(self, track: Track, images: Images, view: MapView) -> Track | None:
        """Match the landmarks of the local map to the features of a frame that was tracked by
        patches.

        Where the patch of a landmark was found, a feature is extracted even if the detector finds
        no corner there. If too few descriptors match, each landmark whose patch was found is first
        matched to the nearest feature. This happens, for example, when the fog suddenly becomes so
        dense that the contrast of the image is raised before features are extracted.

        Returns:
            The frame with its features, or None if too few features match.
        """
        seen = track.features
        extracted = images.extracted_with((seen.xy, seen.octave))
        frame = track.with_features(self._corrected(extracted, track.twist, view))
        matched = self._match_local_map(frame, images, view)
        if matched is not None:
            return matched
        found = np.flatnonzero(track.landmark >= 0)
        feature, index = nearest_features(
            seen.xy[found],
            frame.features.xy,
            frame.features.octave,
            self._context.scales,
            _PATCH_FEATURE_REACH,
        )
        found = found[index]
        frame = frame.matching(feature, track.landmark[found], track.xyz[found])
        return self._match_local_map(frame, images, view)

    def _match_local_map(self, track: Track, images: Images, view: MapView) -> Track | None:
        """The counts of the result are those of ``track``, by which it was judged."""
        context, local = self._context, view.local_landmarks
        found = track_local_map(track, local, context, images.mask, patches=view.patches)
        if judge(found.n_matches, found.n_inliers, context) == TrackingState.LOST:
            return None
        return replace(
            found,
            by=By.FEATURES,
            n_matches=track.n_matches,
            n_inliers=track.n_inliers,
            visible=track.visible,
        )

    # Tracking by features

    def track_features(
        self, track: Track, images: Images, predicted: Prediction, view: MapView
    ) -> Track:
        """Track a frame using its features, first against the last frame or the reference keyframe,
        and then against all landmarks of the local map.

        Args:
            track: the frame with its features, which are not matched yet.
        """
        still = predicted.standstill(view)
        view, context = _trusting(view, still), self._context
        first = track_previous_frame(track, images.mask, predicted, view, context)
        if first.n_inliers < MIN_INLIERS_FRAME:
            return replace(track, n_matches=first.n_inliers)
        local, patches = view.local_landmarks, view.patches
        found = track_local_map(first, local, context, images.mask, patches=patches)
        state = judge(found.n_matches, found.n_inliers, context)
        n_trusted = np.count_nonzero(local.confirms(found.landmark))
        if still is not None and (state != TrackingState.OK or n_trusted < MIN_TRUSTED):
            # Something covers the image of a standing camera. The matches may be wrong, or belong
            # to a moving object.
            state = TrackingState.LOST
        if state == TrackingState.LOST:
            return replace(track, n_matches=found.n_matches, n_inliers=found.n_inliers)
        doubtful = self._is_doubtful(found.n_inliers, predicted, view)
        return replace(found, state=state, by=By.FEATURES, is_doubtful=doubtful)

    def _is_doubtful(self, n_inliers: int, predicted: Prediction, view: MapView) -> bool:
        """Return whether a frame has few inliers and there is another reason why its matches may be
        wrong.

        There are three such reasons. The first is a gap in time. The second is an unknown motion,
        because the pose was then not predicted. The third is a sudden drop in the number of
        inliers, for example after the camera was carried away.
        """
        last, config = predicted.last, self._config.relocalization
        if last is None:
            return False
        since = predicted.timestamp - last.timestamp
        gap = since > config.doubtful_gap * predicted.interval > 0.0
        old = view.n_keyframes > self._config.tracking.young_keyframes
        unpredicted = last.twist is None and old
        few = n_inliers < config.doubtful_share * view.n_reference
        sudden = n_inliers < config.doubtful_share * last.n_inliers and old
        return few and (gap or unpredicted or sudden)


def judge_patches(track: PatchTrack, still: Standstill | None, context: Context) -> TrackingState:
    """Decide whether a frame can be tracked by patches alone (OK), only if its features do not
    match either (WEAK), or not at all (LOST).

    Args:
        still: where the camera came to rest; None if it moves.
    """
    config, n_inliers = context.config.tracking, len(track.ids)
    if track.stands_still:
        return TrackingState.OK
    if track.n_expected >= MIN_TRUSTED > track.n_trusted:
        return TrackingState.LOST
    trusted = config.patch_min_inlier_ratio * track.n_matches
    if n_inliers >= max(config.patch_min_inliers, trusted):
        return TrackingState.OK
    plausible = _PATCH_FALLBACK_RATIO * track.n_matches
    if still is None and n_inliers >= max(MIN_INLIERS_LOST, plausible):
        return TrackingState.WEAK
    return TrackingState.LOST


def _trusting(view: MapView, still: Standstill | None) -> MapView:
    """Return the view, in which landmarks that a standing camera saw at rest are confirmed."""
    if still is None:
        return view
    local, with_patches = (
        one._replace(confirmed=one.confirmed | np.isin(one.ids, still.ids))
        for one in (view.local_landmarks, view.with_patches)
    )
    return replace(view, local_landmarks=local, with_patches=with_patches)
