"""Every column of the map's tables survives copying, saving, merging and other transfers.

The tests find the columns automatically, so that a new column needs no new test.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap, appended, selected
from vslam.types.camera import Camera
from vslam.types.features import Features
from vslam.types.map import (
    KEYFRAME_FIELDS,
    LANDMARK_FIELDS,
    PREDICTED,
    ROW_FIELDS,
    UNPREDICTED,
    KeyframeTable,
    Map,
    Scalars,
)
from vslam.types.map_kernels import link_many

CAMERA = Camera(fx=100.0, fy=100.0, cx=50.0, cy=50.0, width=100, height=100, baseline=0.5)
N, PER = 7, 4  # keyframes, and keypoints of each
# Columns that link keyframes, landmarks and rows. They are renumbered when a part of the map is
# selected.
FAMILY = {"parent", "restart"}
LINKS = {
    "first_row", "first_keyframe", "keyframe", "landmark", "next_row", "head", "motion_seconds",
}  # fmt: skip
# Columns in which not every number is valid.
RESTRICTED = FAMILY | LINKS | {
    "T_cw", "T_c_parent", "octave", "keyframe_alive", "landmark_alive", "fused_into",
    "n_observations", "gravity", "motion_rotation", "motion_covariance", "T_imu_camera",
}  # fmt: skip


def assert_same(found: dict[str, NDArray], expected: dict[str, NDArray]) -> None:
    assert found.keys() == expected.keys()
    for name, column in expected.items():
        assert found[name].dtype == column.dtype, name
        assert np.array_equal(found[name], column), name


@pytest.fixture
def map_() -> Map:
    """A map in which every column and every number differs from that of a new map.

    If possible, the entries of a column also differ from each other.
    """
    found, rng = Map(1.2 ** np.arange(8)), np.random.default_rng(0)
    nothing = np.zeros(PER, np.float32)
    features = Features(
        rng.uniform(0, 100, (PER, 2)).astype(np.float32), np.arange(PER, dtype=np.uint8), nothing,
        np.zeros((PER, 32), np.uint8), nothing,
    )  # fmt: skip
    for k in range(N):
        T_cw = np.eye(4)
        T_cw[:3, 3] = k
        found.add_keyframe(features, T_cw, 0.0, 0)
    ids = found.add_landmarks(np.zeros((N + 2, 3)), np.zeros((N + 2, 4), np.uint64), 0)
    for k in range(N):
        link_many(found.arrays, found.rows(k).start + np.arange(3), ids[k : k + 3])
    for name, column in found.columns().items():
        if name not in RESTRICTED:
            numbers = np.arange(1, len(column) + 1).reshape(-1, *[1] * (column.ndim - 1))
            column[:] = np.broadcast_to(numbers, column.shape)
    found.keyframes.parent[:N] = [-1, 0, 1, 1, 3, 2, 4]
    found.keyframes.T_c_parent[:N, 0, 3] = np.arange(1, N + 1)
    found.keyframes.restart[[3, 5]] = PREDICTED, UNPREDICTED
    found.keyframes.gravity[:N] = np.eye(3)[np.arange(N) % 3]
    found.keyframes.motion_seconds[1:N] = np.arange(1, N)
    found.keyframes.motion_rotation[:N] = np.eye(3)
    found.keyframes.motion_covariance[:N] = np.arange(1, N + 1)[:, None, None] * np.eye(9)
    found.keyframes.T_imu_camera[:N] = found.keyframes.T_c_parent[:N]
    names = vars(Scalars())
    found.scalars = Scalars(**{name: type(value)(N - 1) for name, value in names.items()})
    return found


def test_a_copy_holds_all_and_shares_nothing(map_):
    before, copy = map_.columns(), map_.copy()
    assert_same(copy.columns(), before)
    assert copy.scalars == map_.scalars
    for name, column in copy.columns().items():
        assert not np.shares_memory(column, before[name]), name


def test_growing_keeps_all(map_):
    before, grown = map_.columns(), map_.copy()  # the copy has no spare capacity
    grown.add_keyframe(Features.none(), np.eye(4), 0.0, 0)
    grown.add_landmarks(np.zeros((1, 3)), np.zeros((1, 4), np.uint64), N)
    assert len(grown.timestamps) == N + 1
    assert len(grown.keyframes.timestamp) == len(grown.arrays.keyframe_alive)
    assert_same({name: c[: len(before[name])] for name, c in grown.columns().items()}, before)


def test_a_file_holds_all(map_, tmp_path):
    save_map(tmp_path / "map.npz", StoredMap(map_, CAMERA))
    found = load_map(tmp_path / "map.npz").map
    assert_same(found.columns(), map_.columns())
    assert found.scalars == map_.scalars


def test_a_selection_has_all_of_what_is_selected(map_):
    keyframes = np.array([0, 2, 3, 5])
    found = selected(map_, keyframes)
    before, after = map_.columns(), found.columns()
    rows = np.concatenate([np.arange(PER * k, PER * (k + 1)) for k in keyframes])
    landmarks = np.unique(np.concatenate([map_.landmarks_of(k) for k in keyframes]))
    for names, kept in (
        (KEYFRAME_FIELDS + KeyframeTable._fields, keyframes),
        (LANDMARK_FIELDS, landmarks),
        (ROW_FIELDS, rows),
    ):
        names = set(names) - FAMILY - LINKS - {"n_observations"}
        expected = {name: before[name][kept] for name in names}
        assert_same({name: after[name] for name in names}, expected)
    assert after["parent"].tolist() == [-1, 0, 0, 1]
    assert after["restart"].tolist() == [0, 0, PREDICTED, UNPREDICTED]
    assert after["motion_seconds"].tolist() == [0, 0, 3, 0]  # only keyframe 3 follows another
    assert found.scalars == replace(map_.scalars, calibrated_until=len(keyframes) - 1)


def test_maps_that_are_appended_keep_all(map_):
    both = appended(StoredMap(map_, CAMERA), StoredMap(map_.copy(), CAMERA)).map
    before, after = map_.columns(), both.columns()
    for name in before.keys() - FAMILY - LINKS - {"session"}:
        assert np.array_equal(after[name], np.concatenate([before[name]] * 2)), name
    drives = map_.scalars.session + 1
    assert after["session"].tolist() == [*map_.sessions, *(map_.sessions + drives)]
    assert after["parent"].tolist() == [*map_.parents, 0, *(map_.parents[1:] + N)]
    assert both.restarts == [3, 5, N, N + 3, N + 5]
    assert both.unpredicted_restarts == [5, N, N + 5]
    assert both.scalars == replace(map_.scalars, session=2 * drives - 1, calibrated_until=2 * N - 1)
