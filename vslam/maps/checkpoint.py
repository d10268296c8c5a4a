"""What SLAM remembers between two frames besides the map, and what of it a file holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.features import PATCH_PIXELS, Features, KeyframePatches
from vslam.geometry import Matrix
from vslam.loops import (
    ClosingState,
    ConsistencyState,
    ResembledPlace,
    VerifierState,
    loop_entry,
    loop_of,
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
_NUMBERS = ("index", "timestamp", "reference", "last_frame", "last_timestamp", "lost_frames",
            "n_tracked", "gained_close", "gain_awaited")  # fmt: skip


@dataclass(frozen=True)
class Checkpoint:
    """What tracking and loop closing remember between two frames: with it, and with the map as it
    was, a run goes on to the byte as if it had not stopped.

    Attributes:
        index, timestamp: of the last frame tracked.
        features: its N features.
        landmark: ``(N,)`` int32, the landmark that each of them tracks, or -1.
        T_cw: ``(4, 4)`` its pose.
        velocity: ``(6,)`` twist per second; None if unknown.
        reference: the keyframe that frames are tracked and placed by.
        last_frame, last_timestamp: when the last keyframe was made.
        lost_frames: since the last frame tracked.
        n_tracked: landmarks in it when it was tracked.
        gained_close, gain_awaited: close points that a keyframe brings (``CloseGain``).
        closing: what loop closing remembers.
        patches: of the newest keyframes, oldest first.
        side_delay: what was learned of the delay between the sides (``SideDelay``).
    """

    index: int
    timestamp: float
    features: Features
    landmark: NDArray[np.int32]
    T_cw: Matrix
    velocity: Matrix | None
    reference: int
    last_frame: int
    last_timestamp: float
    lost_frames: int
    n_tracked: int
    gained_close: float
    gain_awaited: bool
    closing: ClosingState
    patches: tuple[KeyframePatches, ...]
    side_delay: tuple[float, ...] = ()


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray]:
    """Those of ``ARRAYS``."""
    patches = checkpoint.patches
    none = KeyframePatches(-1, np.empty((0, PATCH_PIXELS), np.uint8), np.empty((0, 2), np.float32))
    arrays: dict[str, NDArray] = {
        **{name: getattr(checkpoint.features, name) for name in FEATURES},
        "landmark": checkpoint.landmark,
        "patch_keyframe": np.array([one.keyframe for one in patches], np.int64),
        "patch_pixels": np.concatenate([one.pixels for one in (none, *patches)]),
        "patch_shift": np.concatenate([one.shift for one in (none, *patches)]),
    }
    return arrays


def checkpoint_entry(checkpoint: Checkpoint) -> dict[str, Any]:
    """All else of a checkpoint, for JSON, which keeps every bit of a number."""
    consistency, closing = checkpoint.closing.consistency, checkpoint.closing
    return {name: getattr(checkpoint, name) for name in _NUMBERS} | {
        "T_cw": checkpoint.T_cw.tolist(),
        "velocity": None if checkpoint.velocity is None else checkpoint.velocity.tolist(),
        "side_delay": list(checkpoint.side_delay),
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
    landmark = arrays["landmark"]
    closing = _closing_of(entry["closing"], n_keyframes)
    T_cw = np.array(entry["T_cw"], np.float64)
    velocity = entry["velocity"]
    velocity = None if velocity is None else np.array(velocity, np.float64)
    numbers = {name: entry[name] for name in _NUMBERS}
    sound = (
        T_cw.shape == (4, 4)
        and (velocity is None or velocity.shape == (6,))
        and all(np.isfinite(x).all() for x in (T_cw, 0.0 if velocity is None else velocity))
        and np.isfinite(arrays["xy"]).all()
        and all(isinstance(number, int | float) for number in numbers.values())
        and np.isfinite(np.array(entry["side_delay"], np.float64)).all()
        and 0 <= numbers["reference"] < n_keyframes
        and ((landmark >= -1) & (landmark < n_landmarks)).all()
    )
    if not sound:
        raise ValueError("the last frame is out of range")
    features = Features(
        xy=arrays["xy"],
        octave=arrays["octave"],
        angle=arrays["angle"],
        descriptors=arrays["descriptors"],
        u_right=arrays["u_right"],
    )
    return Checkpoint(
        **numbers,
        features=features,
        landmark=landmark,
        T_cw=T_cw,
        velocity=velocity,
        closing=closing,
        patches=_patches_of(arrays, first_row),
        side_delay=tuple(map(float, entry["side_delay"])),
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
