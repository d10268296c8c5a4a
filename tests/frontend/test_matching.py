"""Matching kernels, compared with plain Python on random data."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.frontend.matching import (
    Projections,
    Searchable,
    consistent_orientation,
    count_elsewhere,
    search_all,
    search_windows,
)
from vslam.support.kernels import hamming as hamming_intrinsic
from vslam.support.kernels import kernel
from vslam.types.features import CELL, FeatureGrid, nearest_features

WIDTH, HEIGHT = 330, 170  # not multiples of a cell


def random_descriptors(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(0, 2**64, (n, 4), dtype=np.uint64)


def with_flips(rng: np.random.Generator, descriptors: np.ndarray, bits: int) -> np.ndarray:
    flat = np.unpackbits(descriptors.view(np.uint8), axis=1)
    for row in flat:
        row[rng.choice(256, bits, replace=False)] ^= 1
    return np.packbits(flat, axis=1).view(np.uint64)


def hamming_table(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    bits_a, bits_b = (np.unpackbits(x.view(np.uint8), axis=1).astype(np.int64) for x in (a, b))
    return bits_a @ (1 - bits_b).T + (1 - bits_a) @ bits_b.T


@kernel
def hamming_of_rows(a, b):
    out = np.empty(len(a), np.int64)
    for i in range(len(a)):
        out[i] = hamming_intrinsic(a[i], b[i])
    return out


def test_hamming_counts_differing_bits():
    rng = np.random.default_rng(0)
    a, b = random_descriptors(rng, 200), random_descriptors(rng, 200)
    np.testing.assert_array_equal(hamming_of_rows(a, b), np.diag(hamming_table(a, b)))
    assert hamming_of_rows(a, ~a).tolist() == [256] * 200
    assert hamming_of_rows(a, with_flips(rng, a, 7)).tolist() == [7] * 200


# -- grid -----------------------------------------------------------------------------------------


def test_grid_holds_each_feature_in_the_cell_of_its_position():
    rng = np.random.default_rng(1)
    xy = rng.uniform([0, 0], [WIDTH, HEIGHT], (500, 2)).astype(np.float32)
    grid = FeatureGrid.of_positions(xy, WIDTH, HEIGHT)
    rows = (len(grid.start) - 1) // grid.columns
    assert (grid.columns, rows) == (21, 11)
    assert sorted(grid.items.tolist()) == list(range(500))
    for cell in range(grid.columns * rows):
        x0, y0 = CELL * (cell % grid.columns), CELL * (cell // grid.columns)
        inside = (xy >= [x0, y0]).all(axis=1) & (xy < [x0 + CELL, y0 + CELL]).all(axis=1)
        held = grid.items[grid.start[cell] : grid.start[cell + 1]]
        assert held.tolist() == np.flatnonzero(inside).tolist()


def test_grid_puts_positions_off_the_image_into_the_nearest_cell():
    xy = np.array([[-5, -5], [WIDTH + 90, 3], [4, HEIGHT + 90]], np.float32)
    grid = FeatureGrid.of_positions(xy, WIDTH, HEIGHT)
    cells = {
        int(item): cell
        for cell in range(len(grid.start) - 1)
        for item in grid.items[grid.start[cell] : grid.start[cell + 1]]
    }
    assert cells == {0: 0, 1: 20, 2: 21 * 10}


def test_grid_of_nothing():
    grid = FeatureGrid.of_positions(np.empty((0, 2), np.float32), WIDTH, HEIGHT)
    assert len(grid.items) == 0
    assert not grid.start.any()


# -- search by projection -------------------------------------------------------------------------


def search_windows_by_hand(scene: dict, max_distance: int, ratio: float):
    """Compare every landmark with every feature, without a grid."""
    distance = hamming_table(scene["descriptors"], scene["frame_descriptors"])
    xy, uvr = scene["xy"].astype(float), scene["uvr"]
    claims: dict[int, list[tuple[int, int]]] = {}
    for i, r in enumerate(scene["radius"]):
        in_window = (
            (r > 0)
            & scene["free"]
            & (np.abs(xy[:, 0] - uvr[i, 0]) <= r)
            & (np.abs(xy[:, 1] - uvr[i, 1]) <= r)
            & (scene["octave"] >= scene["octave_low"][i])
            & (scene["octave"] <= scene["octave_high"][i])
            & ~(np.abs(scene["u_right"] - uvr[i, 2]) > r)  # NaN passes
        )
        candidates = sorted(
            (int(distance[i, j]), xy[j, 1] // CELL, xy[j, 0] // CELL, int(j))
            for j in np.flatnonzero(in_window)
        )
        if not candidates or candidates[0][0] > max_distance:
            continue
        if len(candidates) > 1 and candidates[0][0] > ratio * candidates[1][0]:
            continue
        claims.setdefault(candidates[0][3], []).append((candidates[0][0], i))
    matches = np.full(len(scene["radius"]), -1)
    for feature, rivals in claims.items():
        matches[min(rivals)[1]] = feature
    return matches, distance


def scene(seed: int, *, octaves: int = 8, n: int = 400, m: int = 300) -> dict:
    """Make landmarks that are projected near features that they resemble.

    Some of the landmarks are near the same feature.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform([0, 0], [WIDTH, HEIGHT], (n, 2)).astype(np.float32)
    frame_descriptors = random_descriptors(rng, n)
    # Similar neighbours exercise the ratio test.
    frame_descriptors[1::4] = with_flips(rng, frame_descriptors[::4], 30)
    xy[1::4] = xy[::4] + rng.uniform(-4, 4, (n // 4, 2))
    octave = rng.integers(0, octaves, n).astype(np.uint8)
    octave[1::4] = octave[::4]
    disparity = rng.uniform(2, 40, n)
    u_right = (xy[:, 0] - disparity).astype(np.float32)
    u_right[rng.random(n) < 0.4] = np.nan
    target = rng.integers(0, n, m)
    uvr = np.empty((m, 3))
    uvr[:, :2] = xy[target] + rng.normal(0, 4, (m, 2))
    uvr[:, 2] = uvr[:, 0] - disparity[target] + rng.normal(0, 4, m)
    radius = rng.uniform(2, 25, m)
    radius[rng.random(m) < 0.1] = 0.0
    low = np.maximum(octave[target].astype(np.int64) - 1, 0)
    return {
        "uvr": uvr,
        "radius": radius,
        "octave_low": low,
        "octave_high": low + rng.integers(0, 3, m),
        "descriptors": np.concatenate(
            [with_flips(rng, frame_descriptors[t : t + 1], rng.integers(0, 70)) for t in target]
        ),
        "xy": xy,
        "octave": octave,
        "u_right": u_right,
        "frame_descriptors": frame_descriptors,
        "free": rng.random(n) < 0.85,
    }


def run_search(scene: dict, max_distance: int, ratio: float):
    projections = Projections(
        scene["uvr"],
        scene["radius"],
        scene["octave_low"],
        scene["octave_high"],
        scene["descriptors"],
    )
    features = Searchable(
        scene["xy"],
        scene["octave"],
        scene["u_right"],
        scene["frame_descriptors"],
        FeatureGrid.of_positions(scene["xy"], WIDTH, HEIGHT),
    )
    return search_windows(projections, features, scene["free"], max_distance, ratio)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("max_distance", "ratio"), [(100, 1.0), (50, 1.0), (256, 1.0)])
def test_search_windows_agrees_with_a_search_of_everything(seed, max_distance, ratio):
    data = scene(seed)
    matches, distances = run_search(data, max_distance, ratio)
    expected, table = search_windows_by_hand(data, max_distance, ratio)
    np.testing.assert_array_equal(matches, expected)
    hit = np.flatnonzero(matches >= 0)
    assert len(hit) > 60
    np.testing.assert_array_equal(distances[hit], table[hit, matches[hit]])


@pytest.mark.parametrize("ratio", [0.5, 0.8])
def test_ratio_test_of_features_on_one_level(ratio):
    data = scene(11, octaves=1)
    matches, _ = run_search(data, 256, ratio)
    expected, _ = search_windows_by_hand(data, 256, ratio)
    np.testing.assert_array_equal(matches, expected)
    without, _ = run_search(data, 256, 1.0)
    assert 20 < np.count_nonzero(matches >= 0) < np.count_nonzero(without >= 0)


def test_ratio_test_spares_a_rival_of_another_level():
    """The ratio test of ORB-SLAM applies only to matches on the same pyramid level."""
    rng = np.random.default_rng(0)
    descriptor = random_descriptors(rng, 1)
    features = np.concatenate([with_flips(rng, descriptor, 20), with_flips(rng, descriptor, 22)])

    def found(octaves: list[int]) -> int:
        data = {
            "uvr": np.array([[50.0, 50.0, 40.0]]),
            "radius": np.array([10.0]),
            "octave_low": np.array([0]),
            "octave_high": np.array([7]),
            "descriptors": descriptor,
            "xy": np.array([[51.0, 51.0], [48.0, 49.0]], np.float32),
            "octave": np.array(octaves, np.uint8),
            "u_right": np.full(2, np.nan, np.float32),
            "frame_descriptors": features,
            "free": np.ones(2, bool),
        }
        return int(run_search(data, 100, 0.8)[0][0])

    assert found([3, 3]) == -1
    assert found([3, 2]) == 0


def test_no_feature_is_matched_twice_and_the_closest_landmark_keeps_it():
    rng = np.random.default_rng(3)
    frame = random_descriptors(rng, 1)
    rivals = np.concatenate([with_flips(rng, frame, bits) for bits in (20, 5, 5, 30)])
    data = {
        "uvr": np.tile([50.0, 50.0, 0.0], (4, 1)),
        "radius": np.full(4, 8.0),
        "octave_low": np.zeros(4, np.int64),
        "octave_high": np.zeros(4, np.int64),
        "descriptors": rivals,
        "xy": np.array([[52.0, 49.0]], np.float32),
        "octave": np.zeros(1, np.uint8),
        "u_right": np.full(1, np.nan, np.float32),
        "frame_descriptors": frame,
        "free": np.ones(1, bool),
    }
    assert run_search(data, 100, 1.0)[0].tolist() == [-1, 0, -1, -1]


def test_windows_off_the_image_find_nothing():
    data = scene(5)
    for shift in ([-500, 0, -500], [500, 0, 500], [0, -500, 0], [0, 500, 0]):
        moved = {**data, "uvr": data["uvr"] + shift}
        assert (run_search(moved, 256, 1.0)[0] == -1).all()


# -- search of everything -------------------------------------------------------------------------


@pytest.mark.parametrize(("max_distance", "ratio"), [(50, 0.7), (256, 1.0), (60, 0.9)])
def test_search_all_finds_the_mutual_nearest_neighbours(max_distance, ratio):
    rng = np.random.default_rng(7)
    b = random_descriptors(rng, 150)
    b[100:] = with_flips(rng, b[:50], 40)
    a = np.concatenate(
        [with_flips(rng, b[:80], 15), with_flips(rng, b[:60], 25), random_descriptors(rng, 40)]
    )
    table = hamming_table(a, b)
    nearest = table.argmin(axis=1)
    closest, second = np.sort(table, axis=1)[:, :2].T
    good = (closest <= max_distance) & (closest <= ratio * second)
    good &= table.argmin(axis=0)[nearest] == np.arange(len(a))
    expected = np.where(good, nearest, -1)
    np.testing.assert_array_equal(search_all(a, b, max_distance, ratio), expected)
    assert np.count_nonzero(expected >= 0) > 40


def test_search_all_of_nothing():
    some = random_descriptors(np.random.default_rng(0), 5)
    nothing = some[:0]
    assert search_all(some, nothing, 256, 1.0).tolist() == [-1] * 5
    assert search_all(nothing, some, 256, 1.0).tolist() == []


# -- orientation ----------------------------------------------------------------------------------


def test_consistent_orientation_keeps_the_common_rotation_and_drops_the_others():
    rng = np.random.default_rng(0)
    before = rng.uniform(-np.pi, np.pi, 200).astype(np.float32)
    turn = np.full(200, 0.3)
    wrong = np.arange(200) % 10 == 0
    turn[wrong] += np.linspace(1.0, 5.0, 20)
    after = np.angle(np.exp(1j * (before - turn))).astype(np.float32)  # wraps around
    np.testing.assert_array_equal(consistent_orientation(before, after), ~wrong)


def test_second_and_third_bin_count_from_a_tenth_of_the_first():
    bin_width = 2 * np.pi / 30
    sizes = {0: 100, 7: 10, 12: 9, 20: 30, 25: 29}
    bins = np.repeat(list(sizes), list(sizes.values()))
    a = (bins * bin_width).astype(np.float32)
    kept = consistent_orientation(a, np.zeros_like(a))
    assert set(bins[kept].tolist()) == {0, 20, 25}
    few = np.isin(bins, [0, 7, 12])
    kept = consistent_orientation(a[few], np.zeros_like(a[few]))
    assert set(bins[few][kept].tolist()) == {0, 7}


def test_consistent_orientation_of_nothing():
    nothing = np.empty(0, np.float32)
    assert consistent_orientation(nothing, nothing).shape == (0,)


# -- spread over the image ------------------------------------------------------------------------


def test_elsewhere_is_outside_the_fullest_third():
    assert count_elsewhere(np.array([10.0, 20, 50, 100, 111, 200, 280]), 300) == 3
    assert count_elsewhere(np.array([150.0] * 9 + [40.0]), 300) == 1
    assert count_elsewhere(np.empty(0), 300) == 0
    u = np.random.default_rng(0).uniform(0, WIDTH, 200)
    fullest = max(np.count_nonzero((u >= c) & (u <= c + WIDTH / 3)) for c in u)
    assert count_elsewhere(u, WIDTH) == 200 - fullest


def test_each_feature_takes_the_nearest_pixel():
    xy = np.array([[10.0, 10.0], [50.0, 10.0], [80.0, 10.0]], np.float32)
    uv = np.array([[11.0, 10.0], [10.2, 10.0], [48.5, 10.0], [84.0, 10.0]])
    octave, scales = np.zeros(3, np.uint8), 1.2 ** np.arange(8.0)
    feature, index = nearest_features(uv, xy, octave, scales, 2.0)
    assert sorted(zip(feature.tolist(), index.tolist(), strict=True)) == [(0, 1), (1, 2)]
    one, _ = nearest_features(uv[:1], xy[[0, 0]], octave[:2], scales, 2.0)
    assert one.tolist() == [0]  # the finer one of two at the same pixel
    none = nearest_features(uv[:0], xy, octave, scales, 2.0)
    assert [len(x) for x in none] == [0, 0]
