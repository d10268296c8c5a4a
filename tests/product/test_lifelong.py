"""Driving along known streets does not make the map grow."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ring import CAMERA, LAP, Oracle, Ring
from test_closing import errors

from vslam.config import Config
from vslam.slam import Slam
from vslam.types.features import Extracted, Features
from vslam.types.geometry import inverse

RING = Ring.create()
PLACES = [float(k % LAP) for k in range(5 * LAP)]
NEVER_KNOWN = 1e9
LOOK_ALIKES = 80


@cache
def view(k: int) -> Features:
    return RING.see(k, 1)


@cache
def laps(known_after_s: float, threads: int = 1) -> tuple[Slam, tuple[int, ...], list]:
    """Track five laps of the ring, 21 s each. Return the number of keyframes after each lap."""
    config = Config.model_validate({"keyframes": {"known_after_s": known_after_s}})
    slam = Slam(CAMERA, config, Oracle(RING, PLACES), threads=threads)
    keyframes, results = [], []
    for i, place in enumerate(PLACES):
        image = np.array([[i & 255, i >> 8]], np.uint8)
        results.append(slam.step_features(Extracted(view(int(place))), 0.1 * i, image))
        if i % LAP == LAP - 1:
            slam.stored_map()  # waits for the keyframe that is being mapped
            keyframes.append(len(slam.map.living_keyframes()))
    slam.finish()
    return slam, tuple(keyframes), results


@pytest.mark.slow
def test_known_streets_do_not_grow_the_map(check_map):
    slam, keyframes, results = laps(10.0)
    _, growing, _ = laps(NEVER_KNOWN)
    assert keyframes[0] == growing[0]  # in the first lap, both add keyframes
    assert keyframes[-1] < 1.4 * keyframes[1]
    assert growing[-1] > 1.4 * growing[0]
    assert sum(result.is_keyframe for result in results[3 * LAP :]) < 20
    check_map(slam.map)


@pytest.mark.slow
def test_what_is_known_is_tracked_no_worse():
    of_lap = errors(laps(10.0)[0], RING, PLACES).reshape(5, LAP).mean(axis=1)
    assert of_lap[1:].max() < 1.1 * of_lap[0]
    # Before the loop is closed, one frame may see two parts of the map that do not agree.
    assert sum(result.n_inliers <= 60 for result in laps(10.0)[2][2 * LAP :]) <= 1


@pytest.mark.slow
def test_known_streets_give_the_same_bytes_with_one_thread_and_two():
    one, two = laps(10.0)[0], laps(10.0, threads=2)[0]
    assert one.trajectory().T_wc.tobytes() == two.trajectory().T_wc.tobytes()


def with_some_of(features: Features, other: Features, n: int) -> Features:
    """Add n features of a different view, as on a street that looks repetitive."""
    some = np.linspace(0, len(other) - 1, n).astype(int)
    names = ("xy", "octave", "angle", "descriptors", "u_right")
    columns = ((getattr(features, name), getattr(other, name)) for name in names)
    return Features(*(np.concatenate([mine, theirs[some]]) for mine, theirs in columns))


@pytest.mark.parametrize("publish_after_frames", [1, 3])
def test_a_camera_that_is_carried_is_not_left_where_little_agrees(publish_after_frames):
    """A carried camera sees 80 points that look like expected ones.

    Enough of them agree on the same wrong pose. Every frame becomes a keyframe. It is published
    when the next frame arrives, or it is still being mapped then.
    """
    places = [*map(float, range(14)), 3.0]
    keyframes = {"max_interval_s": 0.05, "publish_after_frames": publish_after_frames}
    config = Config.model_validate({"keyframes": keyframes})
    slam = Slam(CAMERA, config, Oracle(RING, places), threads=1)
    for i, place in enumerate(places):
        image = np.array([[i & 255, i >> 8]], np.uint8)
        features = view(int(place))
        if i == len(places) - 1:
            assert slam.is_mapping
            features = with_some_of(features, view(int(places[i - 1]) + 1), LOOK_ALIKES)
        slam.step_features(Extracted(features), 0.1 * i, image)
    slam.finish()
    truth = inverse(RING.pose(0)) @ RING.pose(3)
    off = inverse(truth) @ slam.trajectory().T_wc[-1]
    assert np.linalg.norm(off[:3, 3]) < 0.2
