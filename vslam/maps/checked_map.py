"""Builds a map from the arrays of an untrusted file.

All properties of the arrays that compiled kernels rely on are checked first, because kernels do not
check their arguments.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.maps.checkpoint import checked_checkpoint
from vslam.maps.stored_map import StoredMap, TruthAlignment, observations
from vslam.types.camera import Camera
from vslam.types.frame_poses import FrameTable
from vslam.types.loops import DetectorMemory, LoopEdge, PerKeyframe
from vslam.types.map import (
    CARRIED,
    KEYFRAME_FIELDS,
    LANDMARK_FIELDS,
    NONE,
    ROW_FIELDS,
    Arrays,
    KeyframeTable,
    Map,
    Scalars,
)
from vslam.types.revisits import Revisits

# These columns are not in the file. They are computed from keyframe_first_row and from the list of
# observations, which is sorted by landmark.
_NOT_IN_FILE = ("head", "n_observations", "keyframe", "landmark", "next_row")
# The columns of the map, and their names in the file.
FILE_NAMES = {
    name: f"{prefix}_{name.removeprefix(f'{prefix}_')}"
    for prefix, fields in (
        ("keyframe", KEYFRAME_FIELDS + KeyframeTable._fields),
        ("landmark", LANDMARK_FIELDS),
        ("row", ROW_FIELDS),
    )
    for name in fields
    if name not in _NOT_IN_FILE
} | {"fused_into": "landmark_merged_into"}
_SIZES = {"keyframe": "K", "landmark": "L", "row": "R"}


def _layout(name: str, in_file: str) -> tuple[type, tuple[str | int, ...]]:
    """Return the type and shape that an array of a map must have in the file."""
    empty = (Arrays()._asdict() | KeyframeTable()._asdict())[name]
    size = "K+1" if name == "first_row" else _SIZES[in_file.partition("_")[0]]
    return empty.dtype.type, (size, *empty.shape[1:])


# K keyframes, L landmarks, R keypoints, O observations, E loops, V revisits with S observations, F
# frames of the last drive. K+1, L+1 and V+1 are the lengths of CSR offsets, which have one element
# more than there are items.
ARRAYS: dict[str, tuple[type, tuple[str | int, ...]]] = {
    "scales": (np.float64, ("levels",)),
    **{in_file: _layout(name, in_file) for name, in_file in FILE_NAMES.items()},
    "landmark_first_observation": (np.int64, ("L+1",)),
    "observation_row": (np.int64, ("O",)),
    "loop_ends": (np.int64, ("E", 2)),
    "loop_T_query_match": (np.float64, ("E", 4, 4)),
    "loop_scale": (np.float64, ("E",)),
    "loop_score": (np.float64, ("E",)),
    "loop_counts": (np.int64, ("E", 2)),
    "loop_learned": (np.bool_, ("E",)),
    "loop_covariance": (np.float64, ("E", 6, 6)),
    "revisit_keyframe": (np.int64, ("V",)),
    "revisit_T_c_keyframe": (np.float64, ("V", 4, 4)),
    "revisit_first": (np.int64, ("V+1",)),
    "revisit_landmark": (np.int32, ("S",)),
    "revisit_uvr": (np.float32, ("S", 3)),
    "revisit_octave": (np.uint8, ("S",)),
    "revisit_certainty": (np.uint8, ("S",)),
    "frame_timestamp": (np.float64, ("F",)),
    "frame_reference": (np.int64, ("F",)),
    "frame_T_c_reference": (np.float64, ("F", 4, 4)),
    "frame_tracked": (np.bool_, ("F",)),
    "frame_carried": (np.bool_, ("F",)),
    "frame_unit_scale": (np.float64, ("F",)),
}
_OF_MOTIONS = ("T_imu_camera", *(name for name in KeyframeTable._fields if "motion" in name))
_MAY_BE_NAN = {"row_u_right", "revisit_uvr", "loop_covariance"}
_MOST = 1e12  # metres, pixels or seconds; the product of a few smaller numbers is finite
_ROTATION_TOLERANCE = 1e-6
_MOST_PIXELS = 1e6  # width, height and focal length of a camera
_MAX_OFFSET = 100.0  # pixels, of the disparity
_MAX_SESSION = 2**31  # it must fit into a column of the map


class DamagedMapError(Exception):
    """The arrays of a file do not describe a valid map."""


def _scalars(entry: dict[str, Any]) -> Scalars:
    names = asdict(Scalars())
    scalars = Scalars(**{name: type(default)(entry[name]) for name, default in names.items()})
    _require(abs(scalars.disparity_offset) < _MAX_OFFSET, "disparity_offset is out of range")
    _require(abs(scalars.offset_mean) < _MAX_OFFSET, "offset_mean is out of range")
    for name in ("offset_sigma", "offset_information", "offset_scatter"):
        _require(0.0 <= getattr(scalars, name) < np.inf, f"{name} is out of range")
    _require(0 <= scalars.offset_windows < _MAX_SESSION, "offset_windows is out of range")
    _require(0 <= scalars.session < _MAX_SESSION, "session is out of range")
    return scalars


def checked_map(data: dict[str, NDArray], header: dict[str, Any]) -> StoredMap:
    """Check the arrays and the header of an untrusted map file, and build a map from them.

    Raises:
        DamagedMapError, KeyError, TypeError, ValueError, AttributeError: the file is damaged. The
            message describes the damage in a few words.
    """
    sizes = _check_shapes(data)
    map_ = _build_map(data, sizes)
    map_.scalars = _scalars(header["scalars"])
    map_.revisits = _revisits(data, sizes)
    checkpoint = None
    if header["checkpoint"] is not None:
        n_frames = sizes["F"] if header["frames"] else 0
        checkpoint = checked_checkpoint(header["checkpoint"]["state"], data, map_, n_frames)
    else:
        a = map_.arrays
        living = bool(a.keyframe_alive.all() and a.landmark_alive.all())
        _require(living, "a culled keyframe or landmark without a checkpoint")
        _require(bool((np.diff(a.first_keyframe) >= 0).all()), "the landmarks are not in order")
    detector, n = header["detector"], sizes["K"]
    tables = {str(name): _per_keyframe(data, f"detector_{name}", n) for name in detector["tables"]}
    images = _per_keyframe(data, "image", n) if header["images"] else None
    if images is not None and (images.values.dtype != np.uint8 or images.values.ndim != 1):
        raise DamagedMapError("the images are not files")
    world = header["world"]
    return StoredMap(
        map=map_,
        camera=camera_of(header),
        loops=_loops(data, n),
        detector=DetectorMemory(str(detector["name"]), str(detector["fingerprint"]), tables),
        images=images,
        frames=_frames(data, n) if header["frames"] else None,
        drives=tuple(str(drive) for drive in header["drives"]),
        thresholds=dict(header.get("thresholds", {})),
        truth_alignment=None if world is None else _truth_alignment(world),
        checkpoint=checkpoint,
    )


def _check_shapes(data: dict[str, NDArray]) -> dict[str, int]:
    """Check that every array exists, is finite and has the right type and shape. Returns the sizes
    of the arrays by name, such as the number of keyframes K."""
    sizes: dict[str, int] = {}
    for name, (dtype, shape) in ARRAYS.items():
        array = data[name]
        plain = array.dtype == dtype and array.flags.c_contiguous
        if not plain or array.ndim != len(shape):
            raise DamagedMapError(f"{name} has type {array.dtype} and {array.ndim} dimensions")
        for size, wanted in zip(array.shape, shape, strict=True):
            if isinstance(wanted, str):
                key, plus, _ = wanted.partition("+")
                size -= bool(plus)
                wanted = sizes.setdefault(key, size)
            if size != wanted:
                raise DamagedMapError(f"{name} has shape {array.shape}")
        if dtype in (np.float32, np.float64):
            nan = np.isnan(array) & (name in _MAY_BE_NAN)
            _require(bool((nan | (np.abs(array) < _MOST)).all()), f"{name} is out of range")
    return sizes


def _all_differ(numbers: NDArray[np.int64]) -> bool:
    return bool((np.diff(np.sort(numbers)) > 0).all())


def _require(holds: bool, fault: str) -> None:
    if not holds:
        raise DamagedMapError(fault)


def _build_map(data: dict[str, NDArray], sizes: dict[str, int]) -> Map:
    n, n_landmarks, n_rows = sizes["K"], sizes["L"], sizes["R"]
    scales, parent = data["scales"], data["keyframe_parent"]
    _require(len(scales) > 1 and bool((np.diff(scales) > 0).all()), "scales do not increase")
    _require(bool(scales[0] > 0), "scales are not positive")
    first_row = data["keyframe_first_row"]
    _check_first("keyframe_first_row", first_row, n_rows)
    for name in ("keyframe_T_cw", "keyframe_T_c_parent"):
        _check_rigid(name, data[name])
    _require(bool((parent[1:] >= 0).all() and (parent < np.arange(n)).all()), "keyframe_parent")
    _check_ids("keyframe_parent", parent, n, least=NONE)
    _require(bool((data["keyframe_unit_scale"] > 1 / _MOST).all()), "keyframe_unit_scale")
    _check_ids("keyframe_restart", data["keyframe_restart"], CARRIED + 1)
    _require(not data["keyframe_restart"][:1].any(), "the first keyframe has a restart")
    direction, sigma = data["keyframe_gravity"], data["keyframe_gravity_sigma"]
    known, length = sigma > 0.0, np.linalg.norm(direction, axis=1)
    is_unit = np.abs(length - known) < _ROTATION_TOLERANCE
    _require(bool((sigma >= 0.0).all() and is_unit.all()), "keyframe_gravity")
    _check_motions({name: data[f"keyframe_{name}"] for name in _OF_MOTIONS})
    _check_ids("row_octave", data["row_octave"], len(scales))
    _require(bool((data["row_certainty"] > 0).all()), "row_certainty")

    first, rows = data["landmark_first_observation"], data["observation_row"]
    _check_first("landmark_first_observation", first, sizes["O"])
    alive = data["landmark_alive"]
    observed = np.diff(first) > 0
    _require(bool(observed[alive].all()), "a landmark without observations that is not culled")
    _require(bool(alive[observed].all()), "a culled landmark with observations")
    _check_fused(data["landmark_merged_into"], alive)
    _check_ids("observation_row", rows, n_rows)
    _require(_all_differ(rows), "a keypoint that observes two landmarks")
    _check_ids("landmark_first_keyframe", data["landmark_first_keyframe"], n)

    keyframe = np.repeat(np.arange(n, dtype=np.int32), np.diff(first_row))
    pairs = np.repeat(np.arange(n_landmarks, dtype=np.int64), np.diff(first)) * n + keyframe[rows]
    _require(_all_differ(pairs), "a keyframe that observes a landmark twice")
    living = data["keyframe_alive"]
    _require(bool(living[keyframe[rows]].all()), "a culled keyframe with observations")
    rooted = bool(living[parent[parent >= 0]].all() and living[parent < 0].all())
    _require(rooted, "a culled keyframe as a parent")
    columns = {name: data[in_file] for name, in_file in FILE_NAMES.items()}
    columns |= observations(rows, first, data["row_u_right"]) | {"keyframe": keyframe}
    return Map(scales).with_columns(columns)


def _revisits(data: dict[str, NDArray], sizes: dict[str, int]) -> Revisits:
    revisits = Revisits(**{name: data[f"revisit_{name}"] for name in vars(Revisits())})
    _check_ids("revisit_keyframe", revisits.keyframe, sizes["K"])
    _check_rigid("revisit_T_c_keyframe", revisits.T_c_keyframe)
    _check_first("revisit_first", revisits.first, sizes["S"])
    _check_ids("revisit_landmark", revisits.landmark, sizes["L"], least=NONE)
    _check_ids("revisit_octave", revisits.octave, len(data["scales"]))
    _require(bool((revisits.certainty > 0).all()), "revisit_certainty")
    _require(bool(np.isfinite(revisits.uvr[:, :2]).all()), "revisit_uvr")
    return revisits


def _check_fused(fused_into: NDArray[np.int32], alive: NDArray[np.bool_]) -> None:
    """Check that every chain of ``fused_into`` ends at a landmark that was not culled, or at
    -1."""
    n = len(fused_into)
    _check_ids("landmark_merged_into", fused_into, n, least=NONE)
    _require(bool((fused_into[alive] == NONE).all()), "a fused landmark that is not culled")
    # This is pointer doubling. Each round follows twice as many fusions as the round before.
    reached = np.append(np.where(fused_into >= 0, fused_into, n), n)
    for _ in range(n.bit_length()):
        reached = reached[reached]
    _require(bool((reached == n).all()), "landmarks fused in a circle")


def _loops(data: dict[str, NDArray], n: int) -> tuple[LoopEdge, ...]:
    _check_ids("loop_ends", data["loop_ends"], n)
    _check_rigid("loop_T_query_match", data["loop_T_query_match"])
    _require(bool((data["loop_scale"] > 1 / _MOST).all()), "loop_scale")
    return tuple(
        LoopEdge(
            query=query,
            match=match,
            score=score,
            accepted=True,
            reason="closed",
            n_matches=n_matches,
            n_inliers=n_inliers,
            T_query_match=T,
            scale=scale,
            matched_by="learned" if learned else "orb",
            covariance=covariance if np.isfinite(covariance).all() else None,
        )
        for (query, match), score, (n_matches, n_inliers), T, scale, learned, covariance in zip(
            data["loop_ends"].tolist(),
            data["loop_score"].tolist(),
            data["loop_counts"].tolist(),
            data["loop_T_query_match"],
            data["loop_scale"].tolist(),
            data["loop_learned"].tolist(),
            data["loop_covariance"],
            strict=True,
        )
    )


def _frames(data: dict[str, NDArray], n: int) -> FrameTable:
    frames = FrameTable(*(data[f"frame_{name}"] for name in FrameTable._fields))
    _check_ids("frame_reference", frames.reference, max(n, 1))
    _check_rigid("frame_T_c_reference", frames.T_c_reference)
    _require(bool((np.diff(frames.timestamp) > 0).all()), "frame_timestamp")
    _require(bool((frames.unit_scale > 1 / _MOST).all()), "frame_unit_scale")
    return frames


def _per_keyframe(data: dict[str, NDArray], name: str, n: int) -> PerKeyframe:
    first, values = data[f"{name}_first"], data[f"{name}_values"]
    _require(first.dtype == np.int64 and first.shape == (n + 1,), f"{name}_first")
    _check_first(f"{name}_first", first, len(values))
    return PerKeyframe(first, values)


def camera_of(header: dict[str, Any]) -> Camera:
    """Read the camera from the header of a map file.

    Raises:
        DamagedMapError, KeyError, TypeError, ValueError: the header is damaged.
    """
    try:
        camera = Camera(**header["camera"])
    except ValueError as error:
        raise DamagedMapError(f"the camera: {error}") from error
    sizes = [camera.fx, camera.fy, camera.width, camera.height]
    places = [camera.cx, camera.cy, camera.baseline, camera.right_delay]
    valid = all(isinstance(x, int | float) and 1 <= x < _MOST_PIXELS for x in sizes)
    valid = valid and all(isinstance(x, int | float) and abs(x) < _MOST for x in places)
    _require(valid and camera.baseline >= 0 and isinstance(camera.depth, bool), "camera")
    return replace(camera, width=int(camera.width), height=int(camera.height))


def _truth_alignment(fields: dict[str, Any]) -> TruthAlignment:
    S = np.array(fields["S_truth_world"], np.float64)
    _require(S.shape == (4, 4) and bool((np.abs(S) < _MOST).all()), "world")
    return TruthAlignment(str(fields["name"]), S)


def _check_first(name: str, first: NDArray[np.int64], end: int) -> None:
    holds = len(first) and first[0] == 0 and first[-1] == end and (np.diff(first) >= 0).all()
    _require(bool(holds), name)


def _check_ids(name: str, ids: NDArray[np.integer], n: int, least: int = 0) -> None:
    _require(bool(((ids >= least) & (ids < n)).all()), f"{name} out of range")


def _check_rigid(name: str, T: NDArray[np.float64]) -> None:
    last = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0)
    rigid = _are_rotations(T[:, :3, :3]) and last == 0.0
    _require(bool(rigid), f"{name} is not a rigid motion")


def _are_rotations(R: NDArray[np.float64]) -> bool:
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    return bool(error < _ROTATION_TOLERANCE and (np.linalg.det(R) > 0.0).all())


def _check_motions(table: dict[str, NDArray[np.float64]]) -> None:
    """Check what an IMU measured between keyframes. The arrays are those of ``KeyframeTable``."""
    seconds = table["motion_seconds"]
    known = seconds > 0.0
    _require(bool((seconds >= 0.0).all()), "keyframe_motion_seconds")
    _require(_are_rotations(table["motion_rotation"][known]), "keyframe_motion_rotation")
    _check_rigid("keyframe_T_imu_camera", table["T_imu_camera"][known])
    covariance = table["motion_covariance"][known]
    positive = (
        np.array_equal(covariance, covariance.transpose(0, 2, 1))
        and (np.linalg.eigvalsh(covariance)[:, :1] > 0.0).all()
    )
    _require(bool(positive), "keyframe_motion_covariance")
    _require(bool((table["motion_walk"][known] > 0.0).all()), "keyframe_motion_walk")
