"""Frames follow their reference keyframes, in the current unit of the map."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import inverse, se3_exp


class Keyframes:
    """Keyframes whose poses a test can change."""

    def __init__(self) -> None:
        self.poses: list[np.ndarray] = []
        self.units: list[float] = []
        self.reference = 0

    @property
    def n_keyframes(self) -> int:
        return len(self.poses)

    def add(self, T_cw: np.ndarray) -> int:
        self.poses.append(T_cw)
        self.units.append(1.0)
        self.reference = len(self.poses) - 1
        return self.reference

    def keyframe(self, keyframe: int) -> tuple[np.ndarray, float]:
        return self.poses[keyframe], self.units[keyframe]


def pose(x: float, turn: float = 0.0) -> np.ndarray:
    return se3_exp(np.array([x, 0.0, 0.0, 0.0, turn, 0.0]))


@pytest.fixture
def keyframes() -> Keyframes:
    return Keyframes()


def test_before_the_first_keyframe_frames_are_in_the_world(keyframes):
    poses = FramePoses(keyframes)
    poses.append(0.0, pose(1.0), tracked=False)
    np.testing.assert_allclose(poses.pose(0), pose(1.0), atol=1e-12)
    assert (len(poses), poses.timestamp(-1)) == (1, 0.0)


def test_frames_move_with_their_keyframe(keyframes):
    poses = FramePoses(keyframes)
    poses.append(0.0, pose(0.0), tracked=False)
    poses.replace(0, keyframes.add(pose(0.0)))
    poses.append(0.1, pose(-0.5, 0.1), tracked=True)
    moved = pose(3.0, 0.4)
    keyframes.poses[0] = moved
    np.testing.assert_allclose(poses.pose(0), moved, atol=1e-12)
    np.testing.assert_allclose(poses.pose(1), pose(-0.5, 0.1) @ moved, atol=1e-12)


def test_frames_take_on_the_unit_of_their_keyframe(keyframes):
    poses = FramePoses(keyframes)
    keyframes.add(np.eye(4))
    keyframes.units[0] = 2.0
    poses.append(0.0, pose(-1.0), tracked=True)  # measured in a map whose unit is twice as long
    keyframes.units[0] = 6.0
    np.testing.assert_allclose(poses.pose(0)[:3, 3], [-3.0, 0.0, 0.0], atol=1e-12)
    poses.append(0.1, pose(-4.0), tracked=True)
    np.testing.assert_allclose(poses.pose(1)[:3, 3], [-4.0, 0.0, 0.0], atol=1e-12)


def test_a_frame_that_became_a_keyframe_is_where_that_is(keyframes):
    poses = FramePoses(keyframes)
    keyframes.add(np.eye(4))
    poses.append(0.0, np.eye(4), tracked=True)
    poses.append(0.1, pose(-1.0), tracked=False)
    second = keyframes.add(pose(-1.0))
    poses.replace(1, second)
    keyframes.poses[second] = pose(-1.5)
    np.testing.assert_allclose(poses.pose(1), pose(-1.5), atol=1e-12)
    np.testing.assert_array_equal(poses.trajectory().timestamps, [0.0, 0.1])


def test_poses_that_were_only_predicted_are_interpolated(keyframes):
    poses = FramePoses(keyframes)
    keyframes.add(np.eye(4))
    for k, tracked in enumerate((True, False, True, False)):
        poses.append(0.1 * k, pose(-1.0 * k if tracked else 7.0), tracked=tracked)
    T_wc = poses.trajectory().T_wc
    np.testing.assert_allclose(T_wc[:3, 0, 3], [0.0, 1.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(T_wc[3], inverse(pose(7.0)), atol=1e-12)  # there is no later pose
