"""A map file is checked before kernels see it: they trust its numbers as indices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
# Kind of the numbers and shape: K keyframes, L landmarks, R rows, S levels of the image pyramid.
_TABLES: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "scales": ("f", ("S",)),
    "keyframe_T_cw": ("f", ("K", 4, 4)),
    "keyframe_timestamp": ("f", ("K",)),
    "keyframe_frame": ("i", ("K",)),
    "keyframe_parent": ("i", ("K",)),
    "keyframe_first_row": ("i", ("K+1",)),
    "landmark_xyz": ("f", ("L", 3)),
    "landmark_descriptor": ("u1", ("L", 32)),
    "row_xy": ("f", ("R", 2)),
    "row_u_right": ("f", ("R",)),
    "row_octave": ("i", ("R",)),
    "row_angle": ("f", ("R",)),
    "row_descriptor": ("u1", ("R", 32)),
    "row_landmark": ("i", ("R",)),
}
_MAY_BE_NAN = {"row_u_right"}


def check_arrays(data: Arrays) -> None:
    """Check shapes, kinds and every number that is an index.

    Args:
        data: the arrays of :func:`vslam.maps.storage.save_map` by name; others are passed over.

    Raises:
        ValueError: what is wrong, in a few words.
    """
    missing = sorted({*_TABLES, "camera"} - data.keys())
    if missing:
        raise ValueError(f"{missing[0]} is missing")
    _check_tables(data)
    _check_camera(data["camera"])
    _check_indices(data)


def _check_tables(data: Arrays) -> None:
    length = {
        "S": len(np.atleast_1d(data["scales"])),
        "K": len(np.atleast_1d(data["keyframe_frame"])),
        "L": len(np.atleast_1d(data["landmark_xyz"])),
        "R": len(np.atleast_1d(data["row_landmark"])),
    }
    length["K+1"] = length["K"] + 1
    for name, (kind, shape) in _TABLES.items():
        array = data[name]
        wanted = tuple(length[n] if isinstance(n, str) else n for n in shape)
        fits = {"f": array.dtype.kind == "f", "i": array.dtype.kind in "iu"}
        if array.shape != wanted or not fits.get(kind, array.dtype == np.uint8):
            raise ValueError(f"{name} is {array.dtype} {array.shape}, not of shape {wanted}")
        if kind == "f" and name not in _MAY_BE_NAN and not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity")


def _check_camera(camera: NDArray[Any]) -> None:
    if camera.dtype.kind != "f" or camera.ndim != 1 or not 7 <= len(camera) <= 8:
        raise ValueError(f"camera is {camera.dtype} {camera.shape}")
    fx, fy, _, _, baseline, width, height = camera[:7].tolist()
    sizes = width, height
    if not np.isfinite(camera).all() or min(fx, fy, *sizes) <= 0 or baseline < 0:
        raise ValueError("camera has a focal length, size or baseline that no camera can have")
    if max(sizes) > 2**16 or any(x != int(x) for x in sizes):
        raise ValueError(f"camera has images of {width:g}x{height:g} pixels")


def _check_indices(data: Arrays) -> None:
    scales, first = data["scales"], data["keyframe_first_row"].astype(np.int64)
    counts = first[1:] - first[:-1]
    n_rows, n_landmarks = len(data["row_landmark"]), len(data["landmark_xyz"])
    if not len(scales) or (scales <= 0).any():
        raise ValueError("scales are no positive numbers")
    if first[0] != 0 or first[-1] != n_rows or (counts < 0).any():
        raise ValueError("keyframe_first_row does not lead through the rows")
    _check_within("row_octave", data["row_octave"], 0, len(scales))
    _check_within("row_landmark", data["row_landmark"], -1, n_landmarks)
    _check_within("keyframe_frame", data["keyframe_frame"], 0, 2**31)
    _check_within("keyframe_parent", data["keyframe_parent"], -1, len(counts))
    _check_tree(data["keyframe_parent"].astype(np.int64))
    owner = np.repeat(np.arange(len(counts)), counts)
    seen = data["row_landmark"].astype(np.int64)
    pairs = (owner * (n_landmarks + 1) + seen)[seen >= 0]
    if len(np.unique(pairs)) != len(pairs):
        raise ValueError("a keyframe observes a landmark twice")


def _check_within(name: str, values: NDArray[Any], least: int, end: int) -> None:
    if len(values) and not (least <= int(values.min()) and int(values.max()) < end):
        raise ValueError(f"{name} leads out of the map")


def _check_tree(parent: NDArray[np.int64]) -> None:
    """Whoever follows parents must come to an end."""
    at = parent.copy()
    for _ in range(len(parent)):
        inside = at >= 0
        if not inside.any():
            return
        at[inside] = parent[at[inside]]
    if (at >= 0).any():
        raise ValueError("keyframe_parent goes round in a circle")
