"""Maps that were made with and without an IMU are continued, localised in, and joined."""

from __future__ import annotations

import numpy as np
import pytest
from test_inertia import CALIBRATION, CAMERA, LAST, TRUTH, samples, walk

from vslam.config import Config
from vslam.loopclosure.registry import create_detector
from vslam.maps.storage import load_map
from vslam.method.joining import join_maps
from vslam.slam import Slam
from vslam.types.geometry import inverse

CONFIG = Config.model_validate({"keyframes": {"max_interval_s": 0.25}})
CUT = 36  # the frame at which the second drive begins
BOTH_WAYS = pytest.mark.parametrize("second", [True, False], ids=["then-imu", "then-none"])


def driven(imu: bool, first: int, last: int, slam: Slam | None = None) -> tuple[Slam, list]:
    calibration = CALIBRATION if imu else None
    slam = slam or Slam(CAMERA, CONFIG, "bow", imu=calibration, threads=1)
    results = walk(slam, samples() if imu else None, first=first, last=last)
    slam.finish()
    return slam, results


@pytest.fixture(scope="module", params=[True, False], ids=["imu", "none"])
def made(request, tmp_path_factory):
    """Return whether a map was made with an IMU, and its file."""
    path = tmp_path_factory.mktemp("maps") / "first.npz"
    driven(request.param, 0, CUT)[0].save(path)
    return request.param, path


def known_motions(map_) -> np.ndarray:
    return map_.keyframes.motion_seconds[: map_.n_keyframes] > 0.0


def apart(results) -> float:
    """Return the largest distance of a frame from the truth, in metres."""
    places = [one.T_wc[:3, 3] - TRUTH[one.index + CUT - 1][:3, 3] for one in results]
    return float(np.linalg.norm(places, axis=1).max())


@BOTH_WAYS
def test_a_map_is_continued(made, second, check_map, tmp_path):
    first, path = made
    slam = Slam.load(path, threads=1, imu=CALIBRATION if second else None)
    n = slam.map.n_keyframes
    assert known_motions(slam.map).any() == first
    _, results = driven(second, CUT - 1, LAST, slam)
    check_map(slam.map)
    assert {one.state for one in results} == {"OK"}
    assert apart(results) < 0.03
    assert slam.gaps() == []
    assert (results[-1].gravity is not None) == second
    assert (slam.gravity is not None) == (first or second)
    assert len(slam.map.living_keyframes()) > n
    assert not known_motions(slam.map)[n]  # no motion connects two drives
    assert known_motions(slam.map)[n:].any() == second
    slam.save(tmp_path / "both.npz")
    assert known_motions(load_map(tmp_path / "both.npz").map).any() == (first or second)


@BOTH_WAYS
def test_a_map_is_localised_in(made, second):
    _, path = made
    slam = Slam.load(path, threads=1, localize=True, imu=CALIBRATION if second else None)
    before = {name: column.tobytes() for name, column in slam.map.columns().items()}
    results = walk(slam, samples() if second else None, first=5, last=CUT)
    slam.finish()
    assert {one.state for one in results} == {"OK"}
    errors = [np.linalg.norm(one.T_wc[:3, 3] - TRUTH[one.index + 5][:3, 3]) for one in results]
    assert max(errors) < 0.03
    assert (results[-1].gravity is not None) == second
    assert {name: column.tobytes() for name, column in slam.map.columns().items()} == before


@BOTH_WAYS
def test_maps_are_joined(made, second, check_map):
    first, path = made
    start = 12
    other, _ = driven(second, start, LAST)
    parts = [load_map(path).compact(), other.stored_map().compact()]
    joined = join_maps(parts, CONFIG, lambda: (create_detector("bow", CONFIG), None))
    assert joined.joined == [1]
    map_ = joined.stored.map
    check_map(map_)
    known = known_motions(map_)
    assert known[map_.sessions == 0].any() == first
    assert known[map_.sessions == 1].any() == second
    T_wc = np.array([inverse(map_.keyframe_pose(k)) for k in range(map_.n_keyframes)])
    frames = map_.frames + start * map_.sessions
    assert np.linalg.norm(T_wc[:, :3, 3] - np.array(TRUTH)[frames, :3, 3], axis=1).max() < 0.03
