"""The map on disk: one compressed ``.npz`` with a schema number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.errors import InputError
from vslam.features import Features
from vslam.map import Map
from vslam.map_kernels import link_many, refresh_landmarks
from vslam.maps.validation import check_arrays
from vslam.untrusted import read_npz

SCHEMA = 1


def save_map(path: Path, map_: Map, camera: Camera) -> None:
    """Write the living part of a map, renumbered without gaps.

    Arrays of the file (K keyframes, L landmarks, R keypoints):
        ``schema``; ``camera`` (8,) fx, fy, cx, cy, baseline, width, height, depth;
        ``scales``;
        ``keyframe_T_cw`` (K, 4, 4), ``keyframe_timestamp``, ``keyframe_frame``,
        ``keyframe_parent`` (K,), ``keyframe_first_row`` (K + 1,);
        ``landmark_xyz`` (L, 3), ``landmark_descriptor`` (L, 32);
        ``row_xy`` (R, 2), ``row_u_right``, ``row_octave``, ``row_angle``, ``row_landmark`` (R,)
        with -1 for none, ``row_descriptor`` (R, 32).
    """
    a = map_.arrays
    # Landmarks are in the order of their first keyframe, culled ones included; a map keeps that.
    keyframes, landmarks = map_.living_keyframes(), map_.living_landmarks()
    new_keyframe = _renumbering(keyframes, map_.n_keyframes)
    new_landmark = _renumbering(landmarks, map_.n_landmarks)
    rows = np.concatenate(
        [np.arange(a.first_row[k], a.first_row[k + 1]) for k in keyframes] or [np.empty(0, int)]
    ).astype(np.int64)
    counts = a.first_row[keyframes + 1] - a.first_row[keyframes]
    parents = np.array(map_.parents, np.int64)[keyframes]
    np.savez_compressed(
        path,
        schema=SCHEMA,
        camera=np.array([*vars(camera).values()], np.float64),
        scales=map_.scales,
        keyframe_T_cw=a.T_cw[keyframes],
        keyframe_timestamp=np.array(map_.timestamps)[keyframes],
        keyframe_frame=np.array(map_.frames, np.int64)[keyframes],
        keyframe_parent=np.where(parents >= 0, new_keyframe[parents], -1),
        keyframe_first_row=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        landmark_xyz=a.xyz[landmarks],
        landmark_descriptor=a.landmark_descriptor[landmarks].view(np.uint8),
        row_xy=a.xy[rows],
        row_u_right=a.u_right[rows],
        row_octave=a.octave[rows],
        row_angle=a.angle[rows],
        row_descriptor=a.descriptor[rows].view(np.uint8),
        row_landmark=np.where(a.landmark[rows] >= 0, new_landmark[a.landmark[rows]], -1),
    )


def load_map(path: Path) -> tuple[Map, Camera]:
    """Read a map written by ``save_map``.

    Raises:
        InputError: no such file, no map, of another schema, or damaged.
    """
    data = read_npz(path, "a map of vslam")
    schema = data.get("schema", np.array("none"))
    if schema.shape or schema != SCHEMA:
        raise InputError(
            f"{path}: map schema {schema.ravel()[:1]}, this version reads {SCHEMA}; name a map.npz."
        )
    try:
        check_arrays(data)
    except ValueError as error:
        raise InputError(f"{path}: damaged map ({error}); take another copy.") from error
    values = data["camera"].tolist()
    camera = Camera(*values[:5], *map(int, values[5:7]), *map(bool, values[7:]))
    map_ = Map(data["scales"])
    first = data["keyframe_first_row"]
    for k, T_cw in enumerate(data["keyframe_T_cw"]):
        rows = slice(int(first[k]), int(first[k + 1]))
        features = Features(
            data["row_xy"][rows],
            data["row_octave"][rows],
            data["row_angle"][rows],
            data["row_descriptor"][rows],
            data["row_u_right"][rows],
        )
        timestamp, frame = data["keyframe_timestamp"][k], data["keyframe_frame"][k]
        map_.add_keyframe(features, T_cw, float(timestamp), int(frame))
        map_.parents[k] = int(data["keyframe_parent"][k])
    landmark = data["row_landmark"]
    observed = np.flatnonzero(landmark >= 0)
    descriptors = data["landmark_descriptor"].view(np.uint64)
    ids = map_.add_landmarks(data["landmark_xyz"], descriptors, 0)
    a = map_.arrays
    link_many(a, observed, landmark[observed].astype(np.int32))
    first_seen = np.full(len(ids), map_.n_keyframes, np.int32)
    np.minimum.at(first_seen, landmark[observed], a.keyframe[observed])
    a.first_keyframe[: len(ids)] = first_seen
    refresh_landmarks(a, ids, map_.scales)
    return map_, camera


def _renumbering(living: NDArray[np.int64], total: int) -> NDArray[np.int64]:
    new = np.full(total, -1, np.int64)
    new[living] = np.arange(len(living))
    return new
