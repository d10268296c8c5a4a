"""Stores a checkpoint of SLAM (``vslam.types.states.Checkpoint``) in a map file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.maps.codec import Codec
from vslam.types.features import PATCH_PIXELS
from vslam.types.map import Map
from vslam.types.states import Checkpoint, PublishedState
from vslam.types.track import Track

SCHEMA = 9
_MOST = 1e12  # metres, pixels or seconds
LOOP_SHAPES = {
    "LoopEdge.T_query_match": (4, 4),
    "LoopEdge.covariance": (6, 6),
    # Only the loop that is being closed needs them.
    "LoopEdge.features": None,
    "LoopEdge.landmarks": None,
}
CHECKPOINTS = Codec(
    LOOP_SHAPES
    | {
        "Features.xy": ("N", 2),
        "Features.octave": ("N",),
        "Features.angle": ("N",),
        "Features.descriptors": ("N", 32),
        "Features.u_right": ("N",),
        # Only the pyramid of a new keyframe is needed.
        "Extracted.pyramid": None,
        "Track.inertial": None,
        "Track.T_cw": (4, 4),
        "Track.landmark": ("N",),
        "Track.xyz": ("N", 3),
        "Track.shift": ("N", 2),
        "Track.visible": ("V",),
        "Track.twist": (6,),
        "GravityDirection.direction": (3,),
        "Pyramid.pixels": ("Q",),
        "Pyramid.offsets": ("L",),
        "Pyramid.shapes": ("L", 2),
        "Pyramid.scales": ("L",),
        "Standstill.T_cw": (4, 4),
        "Standstill.ids": ("N",),
        "Standstill.xy": ("N", 2),
        "KeyframePatches.pixels": ("N", PATCH_PIXELS),
        "KeyframePatches.shift": ("N", 2),
        "KeyframePatches.xy": ("N", 2),
        "FramePatches.landmark": ("N",),
        "FramePatches.octave": ("N",),
        "FramePatches.angle": ("N",),
        "FramePatches.pixels": ("N", PATCH_PIXELS),
        "FramePatches.shift": ("N", 2),
        "FrameObservations.T_c_keyframe": (4, 4),
        "FrameObservations.landmark": ("N",),
        "FrameObservations.xy": ("N", 2),
        "FrameObservations.sigma": ("N",),
        "OdometryState.T_odom_camera": (4, 4),
        "PoseUncertainty.local": (6, 6),
        "PoseUncertainty.drift": (6, 6),
        "PoseUncertainty.offset": (6,),
        "PoseUncertainty.gaps": (6, 6),
        "Inertia.samples": ("N", 7),
        "Inertia.times": ("M",),
        "Inertia.poses": ("M", 4, 4),
        "Inertia.gyro_bias": (3,),
        "InertialState.T_world_imu": (4, 4),
        "InertialState.velocity": (3,),
        "InertialState.gravity": (3,),
        "InertialState.bias": (6,),
        "InertialState.covariance": (18, 18),
    },
    most=_MOST,
    unbounded=frozenset(
        (
            "Features.u_right",
            "Track.xyz",
            "Track.shift",
            "PublishedState.last_timestamp",
            "LoopEdge.covariance",
        )
    ),
)


def checked_checkpoint(
    entry: Any, arrays: Mapping[str, NDArray], map_: Map, n_frames: int
) -> Checkpoint:
    """Check the JSON entry and the arrays of an untrusted file, and build a checkpoint from them.

    Args:
        map_: the map of the same file, which has been checked.
        n_frames: number of frames of the drive up to the checkpoint.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, OverflowError: the checkpoint is damaged.
            The message describes the damage in a few words.
    """
    checkpoint = CHECKPOINTS.decode(Checkpoint, entry, arrays)
    consistency = checkpoint.closing.consistency
    edges = [edge for _, edge in consistency.verified]
    ends = [end for edge in edges for end in (edge.query, edge.match)]
    for names, holds in {
        "the last frame": _is_last_frame(checkpoint.last, map_, n_frames),
        "the last keyframe": _is_last_keyframe(checkpoint.published, map_, n_frames),
        "the patches": _are_patches(checkpoint.published, map_, n_frames),
        "a recent frame": _are_recent(checkpoint.published, map_, n_frames),
        "a verified loop": _are_ids(ends, map_.n_keyframes)
        and all(edge.T_query_match is not None and edge.scale > 1 / _MOST for edge in edges),
        "a resembled place": all(
            _are_ids([*place.keyframes], map_.n_keyframes) for place in consistency.places
        ),
    }.items():
        if not holds:
            raise ValueError(f"{names} is out of range")
    return checkpoint


def _is_last_frame(last: Track, map_: Map, n_frames: int) -> bool:
    features, landmark, observed = last.features, last.landmark, last.landmark[:, None] >= 0
    return (
        0 <= last.index < n_frames
        and len(landmark) == len(features)
        and _are_ids(landmark, map_.n_landmarks, least=-1)
        and _are_ids(last.visible, map_.n_landmarks)
        and _are_ids(features.octave, len(map_.scales))
        and not (np.abs(features.u_right) >= _MOST).any()  # it may be NaN
        and bool(((np.abs(last.xyz) < _MOST) | (np.isnan(last.xyz) & ~observed)).all())
        and (last.shift is None or not (np.abs(last.shift) >= _MOST).any())
    )


def _is_last_keyframe(published: PublishedState, map_: Map, n_frames: int) -> bool:
    # A drive that continues in a stored map has the values -1 and -inf until its first keyframe.
    last_timestamp = published.last_timestamp
    return (
        0 <= published.reference < map_.n_keyframes
        and bool(map_.arrays.keyframe_alive[published.reference])
        and published.last_frame < n_frames
        and (last_timestamp == -np.inf or abs(last_timestamp) < _MOST)
    )


def _are_patches(published: PublishedState, map_: Map, n_frames: int) -> bool:
    n_rows, place = np.diff(map_.arrays.first_row[: map_.n_keyframes + 1]), published.known_place
    return all(
        0 <= one.keyframe < len(n_rows) and len(one.shift) == n_rows[one.keyframe]
        for one in published.patches
    ) and (
        place is None
        or (
            0 <= place.frame < n_frames
            and bool((np.diff(place.landmark) > 0).all())
            and _are_ids(place.landmark, map_.n_landmarks)
            and _are_ids(place.octave, len(map_.scales))
        )
    )


def _are_recent(published: PublishedState, map_: Map, n_frames: int) -> bool:
    return all(
        0 <= one.index < n_frames
        and 0 <= one.keyframe < map_.n_keyframes
        and one.unit_scale > 1 / _MOST
        and _are_ids(one.landmark, map_.n_landmarks, least=-1)
        and bool((one.sigma > 1 / _MOST).all())
        for one in published.recent
    )


def _are_ids(ids: Any, n: int, least: int = 0) -> bool:
    return bool(((np.asarray(ids) >= least) & (np.asarray(ids) < n)).all())
