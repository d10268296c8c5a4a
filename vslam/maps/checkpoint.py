"""How a map file holds what SLAM remembers between two frames (``vslam.states.Checkpoint``)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_PIXELS, Features, KeyframePatches
from vslam.loops import ResembledPlace, loop_entry, loop_of
from vslam.states import (
    Checkpoint,
    ClosingState,
    ConsistencyState,
    MapperState,
    PolicyState,
    TrackerState,
    VerifierState,
)

# N features of the last frame tracked; M keyframes with patches, R rows in all.
ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "xy": (np.float32, ("N", 2)),
    "octave": (np.uint8, ("N",)),
    "angle": (np.float32, ("N",)),
    "descriptors": (np.uint8, ("N", 32)),
    "u_right": (np.float32, ("N",)),
    "landmark": (np.int32, ("N",)),
    "patch_keyframe": (np.int64, ("M",)),
    "patch_pixels": (np.uint8, ("R", PATCH_PIXELS)),
    "patch_shift": (np.float32, ("R", 2)),
}
FEATURES = ("xy", "octave", "angle", "descriptors", "u_right")
_OF_TRACKER = ("index", "timestamp", "lost_frames", "n_tracked")
_OF_MAPPER = ("reference", "last_frame", "last_timestamp")


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray]:
    """Those of ``ARRAYS``."""
    tracker, patches = checkpoint.tracker, checkpoint.mapper.patches
    none = KeyframePatches(-1, np.empty((0, PATCH_PIXELS), np.uint8), np.empty((0, 2), np.float32))
    return {
        **{name: getattr(tracker.features, name) for name in FEATURES},
        "landmark": tracker.landmark,
        "patch_keyframe": np.array([one.keyframe for one in patches], np.int64),
        "patch_pixels": np.concatenate([one.pixels for one in (none, *patches)]),
        "patch_shift": np.concatenate([one.shift for one in (none, *patches)]),
    }


def checkpoint_entry(checkpoint: Checkpoint) -> dict[str, Any]:
    """All else of a checkpoint, for JSON, which keeps every bit of a number."""
    tracker, closing = checkpoint.tracker, checkpoint.closing
    consistency = closing.consistency
    return {
        "tracker": {name: getattr(tracker, name) for name in _OF_TRACKER}
        | {
            "T_cw": tracker.T_cw.tolist(),
            "twist": None if tracker.twist is None else tracker.twist.tolist(),
        },
        "mapper": {name: getattr(checkpoint.mapper, name) for name in _OF_MAPPER},
        "policy": asdict(checkpoint.policy),
        "rig": list(checkpoint.rig),
        "closing": {
            "places": [[sorted(one.keyframes), one.length, one.age] for one in consistency.places],
            "verified": [[turn, loop_entry(edge)] for turn, edge in consistency.verified],
            "turn": consistency.turn,
            **asdict(closing.verifier),
            "followed": closing.followed,
        },
    }


def checked_checkpoint(
    arrays: dict[str, NDArray],
    entry: dict[str, Any],
    first_row: NDArray[np.int64],
    n_landmarks: int,
) -> Checkpoint:
    """The checkpoint of a file, which may hold anything.

    Args:
        first_row: ``(K + 1,)`` of the map's keyframes.

    Raises:
        KeyError, TypeError, ValueError: in a few words what is wrong with it.
    """
    n_keyframes = len(first_row) - 1
    sizes = {
        "N": len(arrays["landmark"]),
        "M": len(arrays["patch_keyframe"]),
        "R": len(arrays["patch_shift"]),
    }
    for name, (dtype, shape) in ARRAYS.items():
        array = arrays[name]
        wanted = tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        if array.dtype != dtype or array.shape != wanted or not array.flags.c_contiguous:
            raise ValueError(f"checkpoint_{name} is {array.dtype} {array.shape}")
    tracker, mapper = dict(entry["tracker"]), dict(entry["mapper"])
    policy, landmark = PolicyState(**entry["policy"]), arrays["landmark"]
    T_cw, twist = np.array(tracker.pop("T_cw"), np.float64), tracker.pop("twist")
    twist = None if twist is None else np.array(twist, np.float64)
    numbers = [*(tracker[name] for name in _OF_TRACKER), *(mapper[name] for name in _OF_MAPPER)]
    sound = (
        T_cw.shape == (4, 4)
        and (twist is None or twist.shape == (6,))
        and all(np.isfinite(x).all() for x in (T_cw, 0.0 if twist is None else twist))
        and np.isfinite(arrays["xy"]).all()
        and all(isinstance(x, int | float) for x in (*numbers, *vars(policy).values()))
        and np.isfinite(np.array(entry["rig"], np.float64)).all()
        and 0 <= mapper["reference"] < n_keyframes
        and ((landmark >= -1) & (landmark < n_landmarks)).all()
    )
    if not sound:
        raise ValueError("the last frame is out of range")
    features = Features(**{name: arrays[name] for name in FEATURES})
    return Checkpoint(
        tracker=TrackerState(
            **tracker, features=features, landmark=landmark, T_cw=T_cw, twist=twist
        ),
        mapper=MapperState(**mapper, patches=_patches_of(arrays, first_row)),
        policy=policy,
        closing=_closing_of(entry["closing"], n_keyframes),
        rig=tuple(map(float, entry["rig"])),
    )


def _patches_of(
    arrays: dict[str, NDArray], first_row: NDArray[np.int64]
) -> tuple[KeyframePatches, ...]:
    keyframes, shift = arrays["patch_keyframe"], arrays["patch_shift"]
    if not ((keyframes >= 0) & (keyframes < len(first_row) - 1)).all():
        raise ValueError("a keyframe with patches is out of range")
    last = np.cumsum(first_row[keyframes + 1] - first_row[keyframes])
    if len(shift) != (last[-1] if len(last) else 0) or not np.isfinite(shift).all():
        raise ValueError("the patches are not those of their keyframes")
    parts = (np.split(arrays[name], last[:-1]) for name in ("patch_pixels", "patch_shift"))
    return tuple(map(KeyframePatches, keyframes.tolist(), *parts)) if len(last) else ()


def _closing_of(entry: dict[str, Any], n_keyframes: int) -> ClosingState:
    verified = tuple((int(turn), loop_of(edge)) for turn, edge in entry["verified"])
    for _, edge in verified:
        T = edge.T_query_match
        known = min(edge.query, edge.match) >= 0 and max(edge.query, edge.match) < n_keyframes
        if not known or T is None or not np.isfinite(T).all() or not edge.scale > 0:
            raise ValueError("a loop that waits is out of range")
    places = tuple(
        ResembledPlace(frozenset(map(int, keyframes)), int(length), int(age))
        for keyframes, length, age in entry["places"]
    )
    return ClosingState(
        ConsistencyState(places, verified, int(entry["turn"])),
        VerifierState(int(entry["resting_until"]), float(entry["in_vain"])),
        int(entry["followed"]),
    )
