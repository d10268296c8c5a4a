"""How long the camera moved between two frames that may have been stamped on arrival."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.config import Config
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.frontend.motion_time import RECENT, motion_seconds
from vslam.slam import Slam
from vslam.types.features import TrackingState
from vslam.types.trajectory import Trajectory


def times(milliseconds) -> np.ndarray:
    """Return the times in seconds of frames with the given steps between them."""
    return 100.0 + np.concatenate([[0.0], np.cumsum(milliseconds)]) / 1000.0


@pytest.mark.parametrize("steps", [
    [100] * 30,
    [33, 34, 33, 33, 34, 33, 40],
    [100] * 10 + [200],  # one frame was dropped
    [100, 100, 300, 100, 100, 200, 100],
    [100] * 10 + [1000],
    [100] * 10 + [20],
    [100] * 3 + [150] * 3 + [100] * 10 + [140],  # a few steps are irregular
    [50] * 20 + [100] * 6,  # another frame rate
])  # fmt: skip
def test_times_of_exposure_are_taken_as_they_are(steps):
    assert motion_seconds(times(steps)) == pytest.approx(steps[-1] / 1000.0)


@pytest.mark.parametrize("last", range(4))
def test_frames_that_were_stamped_on_arrival_were_taken_at_regular_intervals(last):
    burst = np.roll([58, 58, 23, 1], last)
    steps = np.tile(burst, 6)  # 25 times
    assert motion_seconds(times(steps)) == pytest.approx(0.035)


@pytest.mark.parametrize(("last_ms", "seconds"), [(90, 0.872 / 24), (92, 0.092)])
def test_a_gap_between_bursts_is_taken_as_it_is(last_ms, seconds):
    """A step of more than 2.5 mean steps is a gap in which frames are missing."""
    steps = [*np.tile([58, 58, 23, 1], 6)[1:], last_ms]
    assert motion_seconds(times(steps)) == pytest.approx(seconds)


@pytest.mark.parametrize(("n", "judged"), [(2, False), (4, False), (5, True)])
def test_fewer_than_five_times_are_not_judged(n, judged):
    steps = [58, 58, 23, 1][5 - n :] if n < 5 else [58, 58, 23, 1]
    expected = 0.035 if judged else 0.001
    assert motion_seconds(times(steps)) == pytest.approx(expected)


def test_only_the_recent_times_are_looked_at():
    bursts, regular = [58, 58, 23, 1] * 10, [100] * (RECENT - 2)
    assert motion_seconds(times([*bursts, *regular, 110])) == pytest.approx(0.11)
    assert motion_seconds(times([*regular, 100, *bursts])) == pytest.approx(0.035)


@pytest.mark.parametrize(("n_irregular", "mean"), [(5, False), (6, True)])
def test_a_quarter_of_irregular_steps_shows_that_frames_were_stamped_on_arrival(n_irregular, mean):
    steps = np.full(RECENT - 1, 100.0)
    steps[2 : 2 + n_irregular] = 140.0
    steps[-1] = 110.0
    expected = float(np.mean(steps)) if mean else 110.0
    assert motion_seconds(times(steps)) == pytest.approx(expected / 1000.0, rel=1e-6)


@pytest.mark.parametrize(("sensor", "every"), [("stereo", 1), ("mono", 2)])
def test_stamps_of_arrival_make_tracking_hardly_worse(corridor, sensor, every):
    """The poses are those that are known when a frame has been tracked. Patches are found only near
    their predicted positions."""
    camera = corridor.camera if sensor == "stereo" else corridor.camera.left_camera()
    config = Config.model_validate({"tracking": {"method": "patches"}})
    chosen = np.arange(0, len(corridor), every)
    even = 100.0 + 0.035 * np.arange(len(chosen))
    arrival = times(np.tile([58, 58, 23, 1], 10))[: len(chosen)]
    errors, by_patches = [], []
    for stamps in (even, arrival):
        slam = Slam(camera, config, "none", threads=1)
        results = [
            slam.step(corridor.left[k], corridor.right[k] if sensor == "stereo" else None, t)
            for k, t in zip(chosen, stamps, strict=True)
        ]
        tracked = np.array([r.index for r in results if r.state == TrackingState.OK])
        T_wc = np.array([results[k].T_wc for k in tracked])
        found = Trajectory(stamps[tracked], T_wc)
        truth = Trajectory(found.timestamps, corridor.T_wc[chosen][tracked])
        alignment = "se3" if sensor == "stereo" else "sim3"
        errors.append(evaluate_trajectory(found, truth, alignment).ate_rmse_m)
        by_patches.append([k for k in tracked if results[k].n_features == 0])
    assert errors[1] <= 1.5 * errors[0]
    assert by_patches[1] == by_patches[0]
