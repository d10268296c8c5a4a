"""The poses of the newest frames of a monocular camera are found again in the adjusted map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import CAMERA, Points, ahead

from vslam.config import Config
from vslam.method import recent_frames
from vslam.method.recent_frames import RecentFrames
from vslam.slam import Slam
from vslam.types.context import Context
from vslam.types.features import TrackingState
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import Matrix, inverse, inverses, se3_exp, se3_log
from vslam.types.imu import ImuNoise, InertialState, InertialWindow
from vslam.types.map import Map
from vslam.types.track import By, Track

POINTS = Points.create()
CONTEXT = Context.create(CAMERA.left_camera(), Config())
T_TRUE = ahead(0.4, 0.01)
T_TRACKED = se3_exp(np.array([0.05, 0.0, -0.03, 0.002, -0.003, 0.001])) @ T_TRUE


class Recent:
    """Frames that were tracked at ``T_TRACKED`` in a map, but observed its points at ``T_TRUE``."""

    def __init__(self, n_frames: int = 1) -> None:
        self.map = Map(CONTEXT.scales)
        self.map.add_landmarks(POINTS.xyz, POINTS.descriptors.view(np.uint64), 0)
        self.reference = 0
        self.poses = FramePoses(self)
        self.frames = RecentFrames(CONTEXT, self.poses)
        self.add_keyframe()
        self.poses.append(0.0, np.eye(4), tracked=True)
        for index in range(1, 1 + n_frames):
            self.poses.append(0.1 * index, T_TRACKED, tracked=True)
            self.frames.add(self.track(index), self.n_keyframes)
        self.poses.append(9.0, T_TRACKED, tracked=True)

    def track(self, index: int) -> Track:
        return replace(POINTS.tracked_frame(index, 0.1 * index, T_TRUE), T_cw=T_TRACKED)

    @property
    def n_keyframes(self) -> int:
        return self.map.n_keyframes

    def keyframe(self, keyframe: int) -> tuple[Matrix, float]:
        return self.map.keyframe_pose(keyframe), float(self.map.unit_scale[keyframe])

    def add_keyframe(self) -> None:
        n = self.n_keyframes
        self.map.add_keyframe(POINTS.see(np.eye(4)), np.eye(4), float(n), n)
        self.map.parents[n] = n - 1

    def settle(self) -> Matrix:
        """Settle the frames, and return the pose of the first one."""
        self.frames.settle(self.map)
        return self.poses.pose(1)


def error(T_cw: Matrix) -> float:
    return float(np.abs(se3_log(T_cw @ inverse(T_TRUE))).max())


def test_a_frame_gets_its_final_pose_when_two_more_keyframes_have_been_mapped():
    recent = Recent()
    tracked = recent.poses.pose(1)
    for _ in range(2):
        assert recent.settle().tobytes() == tracked.tobytes()
        assert len(recent.frames.all()) == 1
        recent.add_keyframe()
    assert error(tracked) > 0.04
    assert error(recent.settle()) < 1e-4
    assert recent.frames.all() == ()


def test_the_pose_is_found_in_a_map_that_has_moved_and_grown():
    recent = Recent()
    for _ in range(2):
        recent.add_keyframe()
    moved = ahead(40.0, 1.0)
    a, n = recent.map.arrays, recent.n_keyframes
    a.T_cw[:n] = moved
    a.T_cw[:n, :3, 3] *= 3.0
    grown = 3.0 * POINTS.xyz - 3.0 * moved[:3, 3]
    a.xyz[: len(grown)] = grown @ moved[:3, :3]
    recent.map.unit_scale[:n] = 3.0
    T_c_keyframe = recent.settle() @ inverse(recent.map.keyframe_pose(0))
    T_c_keyframe[:3, 3] /= 3.0
    assert error(T_c_keyframe) < 1e-4


def test_a_frame_whose_landmarks_disagree_keeps_the_pose_that_was_tracked():
    recent = Recent()
    for _ in range(2):
        recent.add_keyframe()
    n = len(POINTS.xyz)
    recent.map.arrays.xyz[: int(0.6 * n)] += np.random.default_rng(1).normal(
        0, 2, (int(0.6 * n), 3)
    )
    np.testing.assert_allclose(recent.settle(), T_TRACKED, atol=1e-12)


def test_wrong_matches_that_tracking_would_accept_do_not_pull_at_the_pose():
    """A tenth of the landmarks is seen two standard deviations aside."""
    recent = Recent(0)
    for _ in range(2):
        recent.add_keyframe()
    track = recent.track(1)
    features = track.features
    features.xy[::10, 0] += 2.0
    recent.frames.add(track, 1)
    assert error(recent.settle()) < 1e-4


def test_a_frame_whose_landmarks_were_culled_keeps_the_pose_that_was_tracked():
    recent = Recent()
    for _ in range(2):
        recent.add_keyframe()
    recent.map.arrays.landmark_alive[: len(POINTS.xyz) - 20] = False
    np.testing.assert_allclose(recent.settle(), T_TRACKED, atol=1e-12)


def test_new_ids_of_landmarks_are_followed():
    recent = Recent()
    for _ in range(2):
        recent.add_keyframe()
    n = len(POINTS.xyz)
    new_id = np.random.default_rng(2).permutation(n).astype(np.int32)
    recent.map.arrays.xyz[new_id] = POINTS.xyz
    new_id[:50] = -1
    recent.frames.renumber(new_id)
    assert np.count_nonzero(recent.frames.all()[0].landmark < 0) == 50
    recent.frames.renumber(np.arange(n, dtype=np.int32))
    assert error(recent.settle()) < 1e-4


def test_the_end_of_a_drive_changes_nothing_for_a_drive_that_goes_on():
    ended, other = Recent(3), Recent(3)
    ended.frames.add(ended.track(4), 1)  # the last frame
    ended.frames.conclude(ended.map)
    assert [error(ended.poses.pose(k)) < 1e-4 for k in (1, 2, 3, 4)] == [True, True, True, False]
    for recent in (ended, other):
        recent.add_keyframe()
        recent.map.arrays.xyz[: len(POINTS.xyz)] *= 1.001
        recent.add_keyframe()
        recent.settle()
    for k in (1, 2, 3):
        assert ended.poses.pose(k).tobytes() == other.poses.pose(k).tobytes()


def test_a_keyframe_is_forgotten():
    recent = Recent(2)
    recent.frames.forget(1)
    recent.frames.forget(7)  # it was not kept
    assert [one.index for one in recent.frames.all()] == [2]


def test_of_many_frames_without_a_keyframe_the_newest_are_kept(monkeypatch):
    monkeypatch.setattr(recent_frames, "_MOST_FRAMES", 5)
    assert [one.index for one in Recent(8).frames.all()] == [4, 5, 6, 7, 8]


STATE = InertialState(0.1, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(6), np.eye(18))
WINDOW = InertialWindow(np.zeros((0, 7)), STATE, np.eye(3), np.eye(4), ImuNoise(), 0.1)


@pytest.mark.parametrize(
    "change",
    [{"state": TrackingState.LOST}, {"by": By.STANDSTILL}, {"inertial": WINDOW}],
    ids=["lost", "standing", "inertial"],
)
def test_a_pose_that_was_not_found_by_landmarks_alone_stays(change):
    recent = Recent(0)
    recent.frames.add(replace(recent.track(1), **change), 1)
    assert recent.frames.all() == ()


def test_the_state_of_a_checkpoint_goes_on():
    recent = Recent(2)
    again = RecentFrames(CONTEXT, recent.poses, recent.frames.all())
    for _ in range(2):
        recent.add_keyframe()
    again.settle(recent.map)
    assert max(error(recent.poses.pose(k)) for k in (1, 2)) < 1e-4


def turns_wrongly(slam: Slam, T_wc: Matrix) -> float:
    """Return the RMSE of the rotation from frame to frame, in radians."""
    found, truth = (inverses(T[:-1]) @ T[1:] for T in (slam.trajectory().T_wc, T_wc))
    errors = [se3_log(step)[3:] for step in inverses(truth) @ found]
    return float(np.sqrt(np.sum(np.square(errors), axis=1).mean()))


def test_rotations_from_frame_to_frame_err_less(corridor, monkeypatch):
    def run() -> Slam:
        # By features, most frames of this short drive become keyframes.
        config = {"tracking.method": "patches"}
        slam = Slam(corridor.camera.left_camera(), config, "none", threads=1)
        for left, timestamp in zip(corridor.left, corridor.timestamps, strict=True):
            slam.step(left, None, timestamp)
        slam.finish()
        assert slam.tracked().all()
        return slam

    found = run()
    monkeypatch.setattr(RecentFrames, "_find", lambda *_: None)
    tracked = run()
    assert (
        found.keyframe_trajectory().T_wc.tobytes() == tracked.keyframe_trajectory().T_wc.tobytes()
    )
    assert turns_wrongly(found, corridor.T_wc) < 0.9 * turns_wrongly(tracked, corridor.T_wc)
