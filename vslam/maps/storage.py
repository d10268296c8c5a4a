"""Reads and writes map files. A map file is an ``.npz`` file.

A map file is written atomically, and it is checked when it is read. The arrays are not compressed.
Most of the data are descriptors, which do not compress well, and a map should load within a second.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vslam.maps.checked_map import FILE_NAMES, DamagedMapError, camera_of, checked_map
from vslam.maps.checkpoint import CHECKPOINTS
from vslam.maps.checkpoint import SCHEMA as CHECKPOINT_SCHEMA
from vslam.maps.new_output import replaced_file
from vslam.maps.stored_map import StoredMap
from vslam.support.errors import InputError
from vslam.support.machine import versions
from vslam.support.untrusted import ARCHIVE_ERRORS, read_json, require_memory
from vslam.types.camera import Camera
from vslam.types.frame_poses import FrameTable
from vslam.types.map_kernels import gather_observations, resolve

SCHEMA = 15
_UNKNOWN = np.full((6, 6), np.nan)  # covariance
_FOREIGN = "not a map of vslam; give a map.npz or the folder of a run"


def save_map(path: Path | str, stored: StoredMap, *, resumable: bool = False) -> None:
    """Write a map to a file. An existing file is replaced. After an error or a power cut, it is
    unchanged.

    The file contains the JSON text ``header`` and the arrays of ``checked_map.ARRAYS``. The data of
    the loop detector for each keyframe (``PerKeyframe``) are stored as ``detector_NAME_first`` and
    ``detector_NAME_values``. The images of the keyframes are stored as ``image_first`` and
    ``image_values``. Observations are sorted by landmark. The observations of a landmark are in the
    order of its linked list.

    Args:
        resumable: if True and the map has a checkpoint, the checkpoint is written, and culled
            keyframes and landmarks are kept.

    Raises:
        OSError: the file cannot be written.
    """
    with_checkpoint = resumable and stored.checkpoint is not None
    arrays = _as_arrays(stored if with_checkpoint else stored.compact(copy=False))
    with replaced_file(Path(path)) as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_map(path: Path | str) -> StoredMap:
    """Read a map from a file, and remove culled keyframes and landmarks.

    Raises:
        InputError: the file is missing or damaged, is not a map, or has another schema version.
    """
    stored = load_checkpoint(path)
    return stored if stored.checkpoint is None else stored.compact()


def load_checkpoint(path: Path | str) -> StoredMap:
    """Read a map from which a run can be resumed. Culled keyframes and landmarks are kept if the
    map has a checkpoint. All properties of the arrays that compiled kernels rely on are checked.

    Args:
        path: a map file, or the folder of a run that has a map file.

    Raises:
        InputError: the file is missing or damaged, is not a map, or has another schema version.
    """
    path = map_file_of(path)
    data, header = _read(path)
    with _damage_reported(path):
        state = header["checkpoint"]
        if state is not None and state.get("schema") != CHECKPOINT_SCHEMA:
            raise InputError(
                f"{path}: has the state of a run by another version of vslam; resume the run with "
                "that version."
            )
        return checked_map(data, header)


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
    try:
        yield
    except (*ARCHIVE_ERRORS, DamagedMapError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: the map is damaged ({error}); save it again.") from error


def _as_arrays(stored: StoredMap) -> dict[str, NDArray]:
    map_ = stored.map
    state, of_state = CHECKPOINTS.encode(stored.checkpoint, "checkpoint")
    index = np.arange(map_.n_keyframes, dtype=np.int64)
    landmarks = np.arange(map_.n_landmarks, dtype=np.int32)
    first, rows = gather_observations(map_.arrays, landmarks, index)
    columns = map_.columns()
    loops = stored.loops
    T = [loop.T_query_match for loop in loops]
    frames = stored.frames or FrameTable(
        np.zeros(0),
        np.zeros(0, np.int64),
        np.zeros((0, 4, 4)),
        np.zeros(0, np.bool_),
        np.zeros(0),
        np.zeros(0, np.bool_),
    )
    header: dict[str, Any] = {
        "kind": "vslam map",
        "schema": SCHEMA,
        "versions": versions(),
        "camera": asdict(stored.camera),
        "drives": list(stored.drives),
        "thresholds": stored.thresholds,
        "detector": {
            "name": stored.detector.name,
            "fingerprint": stored.detector.fingerprint,
            "tables": sorted(stored.detector.tables),
        },
        "images": stored.images is not None,
        "frames": stored.frames is not None,
        "scalars": asdict(map_.scalars),
        "checkpoint": None if state is None else {"schema": CHECKPOINT_SCHEMA, "state": state},
        "world": None
        if stored.truth_alignment is None
        else {
            "name": stored.truth_alignment.name,
            "S_truth_world": stored.truth_alignment.S_truth_world.tolist(),
        },
    }
    arrays = {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        "scales": map_.scales,
        **{in_file: columns[name] for name, in_file in FILE_NAMES.items()},
        "landmark_first_observation": first,
        "observation_row": rows,
        "loop_ends": np.array([(one.query, one.match) for one in loops], np.int64).reshape(-1, 2),
        "loop_T_query_match": np.array(T, np.float64).reshape(-1, 4, 4),
        "loop_scale": np.array([loop.scale for loop in loops], np.float64),
        "loop_score": np.array([loop.score for loop in loops], np.float64),
        "loop_counts": np.array(
            [(loop.n_matches, loop.n_inliers) for loop in loops], np.int64
        ).reshape(-1, 2),
        "loop_learned": np.array([loop.matched_by == "learned" for loop in loops], np.bool_),
        "loop_covariance": np.array(
            [_UNKNOWN if loop.covariance is None else loop.covariance for loop in loops], np.float64
        ).reshape(-1, 6, 6),
        "revisit_landmark": resolve(map_.arrays, map_.revisits.landmark),
        **of_state,
    }
    for name in vars(map_.revisits):
        arrays.setdefault(f"revisit_{name}", getattr(map_.revisits, name))
    for name in FrameTable._fields:
        arrays[f"frame_{name}"] = getattr(frames, name)
    for name, table in stored.detector.tables.items():
        table = table.select(index)
        arrays[f"detector_{name}_first"] = table.first
        arrays[f"detector_{name}_values"] = table.values
    if stored.images is not None:
        arrays["image_first"], arrays["image_values"] = stored.images.first, stored.images.values
    return arrays


def map_file_of(path: Path | str) -> Path:
    """Return the path of the map file in the folder of a run. Any other path is returned
    unchanged."""
    path = Path(path)
    return path / "map.npz" if path.is_dir() else path


class MadeWith(NamedTuple):
    """The camera, the detector and the non-default thresholds with which a map was made."""

    camera: Camera
    detector: str
    thresholds: dict[str, Any]


def made_with(path: Path | str) -> MadeWith:
    """Read the camera, detector and thresholds of a map without reading its arrays.

    Raises:
        InputError: the file is missing or damaged, is not a map, or has another schema version.
    """
    path = Path(path)
    with _opened(path) as (_, header), _damage_reported(path):
        thresholds = dict(header.get("thresholds", {}))
        return MadeWith(camera_of(header), str(header["detector"]["name"]), thresholds)


def _read(path: Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    with _opened(path) as (file, header):
        return {name: file[name] for name in file.files if name != "header"}, header


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Open a map file of the current schema version, and yield its archive and its header."""
    try:
        require_memory(path, "a map of vslam")
        with np.load(path, allow_pickle=False) as file:
            if "header" not in file.files and "keyframe_first_row" in file.files:
                raise InputError(
                    f"{path}: a map of schema {int(file['schema'])}, but this version of vslam "
                    f"reads schema {SCHEMA}; make the map again with this version."
                )
            header = read_json(file["header"])
            if not isinstance(header, dict) or header.get("kind") != "vslam map":
                raise InputError(f"{path}: {_FOREIGN}.")
            if header.get("schema") != SCHEMA:
                raise InputError(
                    f"{path}: a map of schema {header.get('schema')}, but this version of vslam "
                    f"reads schema {SCHEMA}; use the version that wrote the map."
                )
            yield file, header
    except OSError as error:
        why = error.strerror or error
        raise InputError(
            f"{path}: cannot be read ({why}); give a map.npz or the folder of a run."
        ) from error
    except BadZipFile as error:
        raise InputError(f"{path}: {_FOREIGN}, or the file is damaged ({error}).") from error
    except (*ARCHIVE_ERRORS, TypeError, AttributeError, MemoryError) as error:
        # np.load raises ValueError for pickles and for files that are not npz. zipfile raises
        # RuntimeError for encrypted files. A plain array has no attribute ``files``.
        raise InputError(f"{path}: {_FOREIGN}.") from error
