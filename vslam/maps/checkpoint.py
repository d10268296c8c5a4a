"""Stores a checkpoint of SLAM (``vslam.states.Checkpoint``) in a map file."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_PIXELS, Features, FramePatches, KeyframePatches
from vslam.loops import ResembledPlace, loop_entry, loop_of
from vslam.map import Map
from vslam.odometry import N_STATE
from vslam.states import (
    Checkpoint,
    ClosingState,
    ConsistencyState,
    MapperState,
    PolicyState,
    RigState,
    TrackerState,
    VerifierState,
)

# N is the number of features of the last tracked frame. M is the number of keyframes with patches,
# which have R rows in total. S is the number of landmarks that a standing camera saw.
ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "xy": (np.float32, ("N", 2)),
    "octave": (np.uint8, ("N",)),
    "angle": (np.float32, ("N",)),
    "descriptors": (np.uint8, ("N", 32)),
    "u_right": (np.float32, ("N",)),
    "landmark": (np.int32, ("N",)),
    "coarse": (np.uint8, ("Q",)),
    "still_ids": (np.int32, ("S",)),
    "still_xy": (np.float32, ("S", 2)),
    "patch_keyframe": (np.int64, ("M",)),
    "patch_pixels": (np.uint8, ("R", PATCH_PIXELS)),
    "patch_shift": (np.float32, ("R", 2)),
}
# The patches of a frame at a known place, which tracks P landmarks. Present only if there is one.
KNOWN_PLACE_ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "place_landmark": (np.int32, ("P",)),
    "place_octave": (np.uint8, ("P",)),
    "place_angle": (np.float32, ("P",)),
    "place_pixels": (np.uint8, ("P", PATCH_PIXELS)),
    "place_shift": (np.float32, ("P", 2)),
}
FEATURES = ("xy", "octave", "angle", "descriptors", "u_right")
_TRACKER_FIELDS = ("index", "timestamp", "lost_frames", "n_tracked", "still_keyframes")
_MOST = 1e12  # metres, pixels or seconds
_MOST_FRAMES = 2**31
_MAPPER_FIELDS = ("reference", "last_frame", "last_timestamp")


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray]:
    """Return the arrays of a checkpoint, under their names in ``arrays_of``."""
    tracker, patches = checkpoint.tracker, checkpoint.mapper.patches
    known_place = checkpoint.mapper.known_place
    no_pixels, no_shift = np.empty((0, PATCH_PIXELS), np.uint8), np.empty((0, 2), np.float32)
    return {
        **{name: getattr(tracker.features, name) for name in FEATURES},
        "landmark": tracker.landmark,
        "coarse": tracker.coarse,
        "still_ids": tracker.still_ids,
        "still_xy": tracker.still_xy,
        "patch_keyframe": np.array([one.keyframe for one in patches], np.int64),
        "patch_pixels": np.concatenate([no_pixels, *(one.pixels for one in patches)]),
        "patch_shift": np.concatenate([no_shift, *(one.shift for one in patches)]),
        **{
            name: getattr(known_place, name.removeprefix("place_"))
            for name in KNOWN_PLACE_ARRAYS
            if known_place is not None
        },
    }


def arrays_of(entry: dict[str, Any]) -> dict[str, tuple[type, tuple[str | int, ...]]]:
    """Return the type and shape of each array of a checkpoint with this JSON entry."""
    return ARRAYS if entry["mapper"].get("known_place") is None else ARRAYS | KNOWN_PLACE_ARRAYS


def checkpoint_entry(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the data of a checkpoint that are not arrays, as a JSON object. JSON preserves float64
    numbers exactly."""
    tracker, closing = checkpoint.tracker, checkpoint.closing
    consistency, known_place = closing.consistency, checkpoint.mapper.known_place
    return {
        "tracker": {name: getattr(tracker, name) for name in _TRACKER_FIELDS}
        | {
            "T_cw": tracker.T_cw.tolist(),
            "twist": None if tracker.twist is None else tracker.twist.tolist(),
            "T_cw_still": None if tracker.T_cw_still is None else tracker.T_cw_still.tolist(),
        },
        "mapper": {name: getattr(checkpoint.mapper, name) for name in _MAPPER_FIELDS}
        | {"known_place": None if known_place is None else known_place.frame},
        "policy": asdict(checkpoint.policy),
        "odometry": checkpoint.odometry,
        "rig": {"delay": checkpoint.rig.delay, "sides": checkpoint.rig.sides},
        "closing": {
            "places": [[sorted(one.keyframes), one.length, one.age] for one in consistency.places],
            "verified": [[turn, loop_entry(edge)] for turn, edge in consistency.verified],
            "turn": consistency.turn,
            "resting_until": closing.verifier.resting_until,
            "in_vain": closing.verifier.failed_similarity,
            "followed": closing.followed,
            "new_revisits": closing.new_revisits,
        },
    }


def checked_checkpoint(
    arrays: dict[str, NDArray], entry: dict[str, Any], map_: Map, n_frames: int
) -> Checkpoint:
    """Check the arrays and the JSON entry of an untrusted file, and build a checkpoint from them.

    Args:
        map_: the map of the same file, which has been checked.
        n_frames: number of frames of the drive up to the checkpoint.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: the checkpoint is damaged. The message
            describes the damage in a few words.
    """
    sizes = {
        "N": len(arrays["landmark"]),
        "Q": len(arrays["coarse"]),
        "M": len(arrays["patch_keyframe"]),
        "R": len(arrays["patch_shift"]),
        "P": len(arrays.get("place_landmark", ())),
        "S": len(arrays["still_ids"]),
    }
    for name, (dtype, shape) in arrays_of(entry).items():
        array = arrays[name]
        wanted = tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        if array.dtype != dtype or array.shape != wanted or not array.flags.c_contiguous:
            raise ValueError(f"checkpoint_{name} has type {array.dtype} and shape {array.shape}")
        nan = np.isnan(array) & (name == "u_right")
        if dtype == np.float32 and not (nan | (np.abs(array) < _MOST)).all():
            raise ValueError(f"checkpoint_{name} is out of range")
    tracker, mapper, policy = (dict(entry[name]) for name in ("tracker", "mapper", "policy"))
    T_cw, twist = tracker.pop("T_cw"), tracker.pop("twist")
    T_cw_still = tracker.pop("T_cw_still")
    landmark, reference = arrays["landmark"], _count(mapper["reference"])
    # A drive that continues in a stored map has the values -1 and -inf until its first keyframe.
    last_frame, last_timestamp = _count(mapper["last_frame"], -1), mapper["last_timestamp"]
    valid = (
        ((landmark >= -1) & (landmark < map_.n_landmarks)).all()
        and (arrays["octave"] < len(map_.scales)).all()
        and reference < map_.n_keyframes
        and map_.arrays.keyframe_alive[reference]
        and _count(tracker["index"]) < n_frames
        and last_frame < n_frames
        and isinstance(policy["gain_awaited"], bool)
    )
    if not valid:
        raise ValueError("the last frame is out of range")
    features = Features(**{name: arrays[name] for name in FEATURES})
    return Checkpoint(
        tracker=TrackerState(
            index=tracker.pop("index"),
            timestamp=_number(tracker.pop("timestamp")),
            lost_frames=_count(tracker.pop("lost_frames")),
            n_tracked=_count(tracker.pop("n_tracked")),
            features=features,
            landmark=landmark,
            T_cw=_pose(T_cw),
            twist=None if twist is None else _numbers(twist, 6),
            coarse=arrays["coarse"],
            T_cw_still=None if T_cw_still is None else _pose(T_cw_still),
            still_ids=arrays["still_ids"],
            still_xy=arrays["still_xy"],
            still_keyframes=_count(tracker.pop("still_keyframes")),
            **tracker,
        ),
        mapper=MapperState(
            reference=reference,
            last_frame=last_frame,
            last_timestamp=-np.inf if last_timestamp == -np.inf else _number(last_timestamp),
            patches=_patches_of(arrays, map_.arrays.first_row[: map_.n_keyframes + 1]),
            known_place=_known_place_of(arrays, mapper.get("known_place"), map_, n_frames),
        ),
        policy=PolicyState(
            _number(policy["gained_close"]),
            policy["gain_awaited"],
            _count(policy["first_close"]),
            _count(policy["first_frame"], -1),
            _count(policy["due"], -1),
        ),
        closing=_closing_of(entry["closing"], map_.n_keyframes),
        odometry=tuple(_numbers(entry["odometry"], N_STATE).tolist()),
        rig=RigState(
            **{name: tuple(_numbers(entry["rig"][name]).tolist()) for name in ("delay", "sides")}
        ),
    )


def _count(value: Any, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value < _MOST_FRAMES:
        raise ValueError(f"{value!r:.40} is not a count")
    return value


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or not abs(value) < _MOST:
        raise ValueError(f"{value!r:.40} is out of range")
    return float(value)


def _numbers(values: Any, count: int | None = None) -> NDArray[np.float64]:
    found = np.array(values, np.float64)
    if found.ndim != 1 or len(found) != (count or len(found)) or not (np.abs(found) < _MOST).all():
        raise ValueError("numbers are out of range")
    return found


def _pose(values: Any) -> NDArray[np.float64]:
    T = np.array(values, np.float64)
    if T.shape != (4, 4) or not (np.abs(T) < _MOST).all():
        raise ValueError("a pose is out of range")
    return T


def _patches_of(
    arrays: dict[str, NDArray], first_row: NDArray[np.int64]
) -> tuple[KeyframePatches, ...]:
    keyframes, shift = arrays["patch_keyframe"], arrays["patch_shift"]
    if not ((keyframes >= 0) & (keyframes < len(first_row) - 1)).all():
        raise ValueError("a keyframe with patches is out of range")
    last = np.cumsum(first_row[keyframes + 1] - first_row[keyframes])
    if len(shift) != (last[-1] if len(last) else 0) or not np.isfinite(shift).all():
        raise ValueError("the patches do not match their keyframes")
    parts = (np.split(arrays[name], last[:-1]) for name in ("patch_pixels", "patch_shift"))
    return tuple(map(KeyframePatches, keyframes.tolist(), *parts)) if len(last) else ()


def _known_place_of(
    arrays: dict[str, NDArray], frame: int | None, map_: Map, n_frames: int
) -> FramePatches | None:
    if frame is None:
        return None
    landmark = arrays["place_landmark"]
    valid = (
        _count(frame) < n_frames
        and (np.diff(landmark) > 0).all()
        and ((landmark >= 0) & (landmark < map_.n_landmarks)).all()
        and (arrays["place_octave"] < len(map_.scales)).all()
    )
    if not valid:
        raise ValueError("the patches of a known place are out of range")
    return FramePatches(frame, *(arrays[name] for name in KNOWN_PLACE_ARRAYS))


def _closing_of(entry: dict[str, Any], n_keyframes: int) -> ClosingState:
    verified = tuple((_count(turn), loop_of(edge)) for turn, edge in entry["verified"])
    for _, edge in verified:
        if max(_count(edge.query), _count(edge.match)) >= n_keyframes:
            raise ValueError("a verified loop is out of range")
        _pose(edge.T_query_match)
        if _number(edge.scale) <= 1 / _MOST:
            raise ValueError("the scale of a verified loop is out of range")
        _number(edge.score), _count(edge.n_matches), _count(edge.n_inliers)
    places = tuple(
        ResembledPlace(frozenset(map(_count, keyframes)), _count(length), _count(age))
        for keyframes, length, age in entry["places"]
    )
    if max((k for place in places for k in place.keyframes), default=-1) >= n_keyframes:
        raise ValueError("a resembled place is out of range")
    return ClosingState(
        ConsistencyState(places, verified, _count(entry["turn"])),
        VerifierState(_count(entry["resting_until"]), _number(entry["in_vain"])),
        _count(entry["followed"]),
        _count(entry["new_revisits"]),
    )
