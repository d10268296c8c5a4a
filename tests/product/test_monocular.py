"""Monocular SLAM on a ring of points (tests/ring.py). The map has an arbitrary unit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ring import CAMERA, LAP, Oracle, Ring

from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.run.slam_run import scale_warnings
from vslam.slam import Slam
from vslam.types.features import Extracted, Features, TrackingState
from vslam.types.trajectory import Trajectory

LEFT_CAMERA = CAMERA.left_camera()
RING = Ring.create()
ROUND = [float(k) for k in range(LAP + 40)]
IMAGE = np.zeros((1, 1), np.uint8)


def see(k):
    """Return what the left camera sees at frame k.

    As in a real image, near points are at coarse levels of the pyramid. Points that are mapped from
    two places must be found from a third place.
    """
    features = RING.see(k, 1)
    depth = CAMERA.bf / (features.xy[:, 0] - features.u_right)
    octave = np.clip(np.ceil(np.log(30.0 / np.clip(depth, 1.0, None)) / np.log(1.2)), 0, 7)
    nothing = np.full(len(features), np.nan, np.float32)
    return replace(features, octave=octave.astype(np.uint8), u_right=nothing)


def run(frames, detector="none", *, threads=1, dark=()):
    slam = Slam(LEFT_CAMERA, None, detector, threads=threads)
    results = []
    for i, k in enumerate(frames):
        image = np.array([[i & 255, i >> 8]], np.uint8)  # tells the oracle which frame it is
        features = Features.none() if i in dark else see(k)
        results.append(slam.step_features(Extracted(features), 0.1 * i, image))
    slam.finish()
    return slam, results


def error(slam, frames, chosen=slice(None)):
    found = slam.trajectory()
    truth = Trajectory(found.timestamps, np.array([RING.pose(k) for k in frames]))
    indices = np.arange(len(frames))[chosen]
    return evaluate_trajectory(found.select(indices), truth.select(indices), "sim3").ate_rmse_m


@cache
def closed():
    return run(ROUND, Oracle(RING, ROUND))


def test_a_map_begins_within_ten_frames_and_tracks_all_others(check_map):
    slam, results = run(ROUND[:60])
    lost = [r.index for r in results if r.state is TrackingState.LOST]
    assert lost == list(range(len(lost)))
    assert len(lost) < 10
    assert error(slam, ROUND[:60], slice(len(lost), None)) < 0.2
    check_map(slam.map)


def test_the_frames_before_the_map_get_their_poses_when_it_begins():
    """The camera stands for 12 frames, and then moves."""
    frames = [*(3.0 + 1e-6 * k for k in range(12)), *(3.0 + k for k in range(30))]
    slam, results = run(frames)
    n_lost = sum(r.state is TrackingState.LOST for r in results)
    assert n_lost > 12
    assert slam.tracked().all()
    assert not slam.gaps()
    assert error(slam, frames, slice(0, n_lost + 4)) < 0.05
    turns = slam.trajectory().T_wc[:12, :3, :3]
    assert np.abs(turns - turns[0]).max() < 1e-3


def test_the_first_landmarks_make_the_unit():
    slam, results = run(ROUND[:6])
    second = next(r.index for r in results if r.is_keyframe)
    depth = slam.map.arrays.xyz[slam.map.landmarks_of(0), 2]
    assert np.median(depth) == pytest.approx(
        slam.context.config.initialization.median_depth, rel=0.2
    )
    assert second >= 1


def test_a_drive_that_is_resumed_has_the_bytes_of_one_that_was_not(tmp_path):
    """Also the frames whose poses are found again later (``RecentFrames``)."""
    whole, _ = run(ROUND[:60])
    slam, done = Slam(LEFT_CAMERA, None, "none", threads=1), 0
    for done, k in enumerate(ROUND[:60], 1):
        slam.step_features(Extracted(see(k)), 0.1 * (done - 1), IMAGE)
        state = slam.stored_map().checkpoint
        if done > 30 and state is not None and len(state.published.recent) > 5:
            break
    assert done < 50
    slam.save(tmp_path / "part.npz", resumable=True)
    again = Slam.load(tmp_path / "part.npz", detector="none", threads=1, resume=True)
    for one in (slam, again):
        for i, k in enumerate(ROUND[done:60], done):
            one.step_features(Extracted(see(k)), 0.1 * i, IMAGE)
        one.finish()
        assert one.trajectory().T_wc.tobytes() == whole.trajectory().T_wc.tobytes()


@pytest.mark.slow
def test_a_loop_corrects_the_scale(check_map):
    without, _ = run(ROUND)
    slam, _ = closed()
    assert slam.corrections
    assert all(edge.reason == "closed" for edge in slam.loops if edge.accepted)
    assert error(slam, ROUND) < min(1.0, 0.5 * error(without, ROUND))
    check_map(slam.map)


@pytest.mark.slow
def test_same_bytes_with_one_thread_and_two():
    again, _ = run(ROUND, Oracle(RING, ROUND), threads=2)
    assert again.trajectory().T_wc.tobytes() == closed()[0].trajectory().T_wc.tobytes()


@pytest.mark.slow
def test_a_lost_camera_begins_a_sub_map_that_a_loop_joins(check_map):
    frames = [*ROUND[:80], *ROUND[140:], *(k + LAP for k in ROUND[40:70])]
    slam, results = run(frames, Oracle(RING, frames))
    assert len(slam.map.restarts) == 1
    assert slam.corrections
    lost = sum(r.state is TrackingState.LOST for r in results)
    assert lost < 25
    tracked = [r.index for r in results if r.state is not TrackingState.LOST]
    assert error(slam, frames, tracked) < 1.5
    assert len(set(slam.map.unit_scale)) > 1
    check_map(slam.map)


def test_a_sub_map_goes_on_at_the_speed_before():
    frames = [*ROUND[:40], *ROUND[100:140]]
    slam, results = run(frames)
    assert len(slam.map.restarts) == 1
    steps = np.linalg.norm(np.diff(slam.trajectory().T_wc[:, :3, 3], axis=0), axis=1)
    tracked = np.array([r.state is not TrackingState.LOST for r in results])
    assert np.median(steps[50:]) == pytest.approx(np.median(steps[30:39]), rel=0.1)
    assert tracked[50:].all()
    assert slam.tracked()[40:].all()  # also the frames in which the camera was lost
    assert len(slam.trajectory()) == 80


def test_darkness_at_the_beginning_only_delays_it():
    slam, results = run(ROUND[:40], dark=range(12))
    assert all(r.state is TrackingState.LOST for r in results[:12])
    assert sum(r.state is TrackingState.LOST for r in results) < 20
    assert len(slam.trajectory()) == 40


def test_a_start_that_no_motion_confirms_is_doubtful():
    slam, _ = run(ROUND[:8])
    assert not scale_warnings(slam.map)
    poses = slam.map.arrays.T_cw[: slam.map.n_keyframes]
    poses[1:, :3, 3] = 0.05 * poses[1:, :3, 3]
    (said,) = scale_warnings(slam.map)
    assert said.startswith("The start of the monocular map is doubtful")


def test_a_scale_that_loops_have_changed_much_is_said():
    slam, _ = run(ROUND[:30])
    assert not scale_warnings(slam.map)
    slam.map.unit_scale[-3:] *= 0.6
    (said,) = scale_warnings(slam.map)
    assert "by a factor of up to 1.7" in said


@pytest.mark.slow
def test_a_camera_that_stands_still_begins_no_map():
    slam, results = run([3.0 + 1e-6 * k for k in range(30)])
    assert slam.map.n_keyframes == 0
    assert all(r.state is TrackingState.LOST for r in results)
    assert np.isfinite(slam.trajectory().T_wc).all()


def test_images_must_be_those_of_the_camera():
    image = np.zeros((LEFT_CAMERA.height, LEFT_CAMERA.width), np.uint8)
    with pytest.raises(ValueError, match="the camera is monocular"):
        Slam(LEFT_CAMERA).step(image, image, 0.0)
    with pytest.raises(ValueError, match="right image"):
        Slam(CAMERA).step(image, None, 0.0)
    with pytest.raises(ValueError, match="the images have shape"):
        Slam(LEFT_CAMERA).step(image[:-1], None, 0.0)
