"""A pair of cameras one above the other gives the drive of the same pair side by side."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from source_files import run_source

from vslam.calibration.models import Calibration, CameraModel
from vslam.config import PoseGraphConfig
from vslam.datasets.fixes import Fixes, to_geodetic
from vslam.datasets.frames import RawSource, Source, stored_frames
from vslam.datasets.masks import with_masks
from vslam.datasets.rectified import rectified
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.run.gps import locate
from vslam.run.outcome import RunOutcome, causal_trajectory, odometry_trajectory
from vslam.slam import Slam
from vslam.types.camera import Camera, same_camera
from vslam.types.features import TrackingState
from vslam.types.geometry import adjoint

TURNS = [1, -1]


def turned_camera(turns: int) -> Camera:
    return Camera(240.0, 240.0, 239.5, 79.5, 0.5, 480, 160, quarter_turns=turns)


def source(corridor, turns: int) -> Source:
    """Return the corridor as cameras see it that are turned about their axes by quarter turns, so
    that the right one is below or above the left one."""
    c, T = corridor.camera, np.eye(4)
    width, height, cx, cy = c.width, c.height, c.cx, c.cy
    if turns:
        width, height = height, width
        cx, cy = (width - 1 - c.cy, c.cx) if turns > 0 else (c.cy, height - 1 - c.cx)
    T[int(bool(turns)), 3] = (turns or 1) * c.baseline
    model = CameraModel(c.fx, c.fy, cx, cy, width, height)
    sides = [[np.rot90(i, -turns) for i in side] for side in (corridor.left, corridor.right)]
    raw = RawSource(
        dataset="drawn",
        name="corridor",
        sizes=((width, height),) * 2,
        stored=stored_frames(corridor.timestamps, lambda k, _: (sides[0][k], sides[1][k])),
        ground_truth=corridor.T_wc @ turned_camera(turns).T_mounted_camera.T,
    )
    return rectified(raw, Calibration(model, model, T))


@pytest.fixture(scope="module")
def level(corridor) -> RunOutcome:
    return run_source(source(corridor, 0))


@pytest.fixture(scope="module", params=TURNS, ids=["below", "above"])
def vertical(corridor, request) -> RunOutcome:
    return run_source(source(corridor, request.param))


def rotation(outcome: RunOutcome) -> np.ndarray:
    return outcome.sequence.camera.T_mounted_camera


def test_all_poses_are_those_of_the_camera_as_mounted(level, vertical):
    T = rotation(vertical)
    assert not np.allclose(T, np.eye(4))
    for poses in (
        lambda o: o.trajectory,
        lambda o: o.keyframes,
        lambda o: causal_trajectory(o.tracks),
        lambda o: odometry_trajectory(o.tracks),
    ):
        found, expected = poses(vertical), poses(level)
        np.testing.assert_array_equal(found.timestamps, expected.timestamps)
        np.testing.assert_allclose(found.T_wc, T @ expected.T_wc @ T.T, atol=1e-4)
    np.testing.assert_allclose(vertical.trajectory.T_wc[0], np.eye(4), atol=1e-9)


def test_uncertainties_are_turned_with_the_poses(level, vertical):
    A = adjoint(rotation(vertical))
    found, expected = (one.tracks[-1].uncertainty.covariance for one in (vertical, level))
    np.testing.assert_allclose(found, A @ expected @ A.T, rtol=0.02, atol=1e-12)


def test_the_world_of_the_map_is_the_first_camera_as_mounted(level, vertical):
    R = rotation(vertical)[:3, :3]
    one, other = (o.map.arrays.xyz[o.map.living_landmarks()] for o in (vertical, level))
    np.testing.assert_allclose(np.median(one, axis=0), R @ np.median(other, axis=0), atol=0.02)


def test_the_ground_truth_is_that_of_the_camera_as_mounted(level, vertical):
    found, expected = (
        evaluate_trajectory(one.trajectory, one.ground_truth, "se3") for one in (vertical, level)
    )
    assert found.ate_rmse_m == pytest.approx(expected.ate_rmse_m, abs=1e-3)
    assert found.rpe_deg == pytest.approx(expected.rpe_deg, abs=1e-3)


def test_a_stored_map_knows_how_the_camera_is_mounted(vertical, tmp_path):
    source, file = vertical.sequence, tmp_path / "map.npz"
    first = Slam(source.camera, detector="bow", threads=1)
    for frame in source.stored[:10]:
        first.step(*frame.read(map), frame.timestamp)
    first.finish()
    first.save(file)
    assert not same_camera(source.camera, replace(source.camera, quarter_turns=0))
    again = Slam.load(file, threads=1, localize=True)
    for k in (4, 5):
        frame = source.stored[k]
        result = again.step(*frame.read(map), frame.timestamp + 100.0)
        np.testing.assert_allclose(result.T_wc, first.trajectory().T_wc[k], atol=0.02)
        assert result.state == TrackingState.OK
    np.testing.assert_allclose(again.trajectory().T_wc[-1], result.T_wc, atol=1e-9)


def test_the_antenna_is_given_in_the_frame_of_the_camera_as_mounted(corridor, level, vertical):
    pytest.importorskip("pymap3d")
    antenna = np.array([0.4, -1.0, 0.3])
    at = corridor.T_wc[:, :3, :3] @ antenna + corridor.T_wc[:, :3, 3]
    enu = at @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # x east, z north
    geodetic = to_geodetic(enu, np.array([48.0, 11.0, 500.0]))
    sigma = np.full((len(at), 3), 0.02)

    def track(outcome: RunOutcome):
        lever = rotation(outcome)[:3, :3] @ antenna
        fixes = Fixes(corridor.timestamps, geodetic, sigma, lever)
        return locate(outcome.stored, fixes, PoseGraphConfig()).trajectory.T_wc

    np.testing.assert_allclose(track(vertical), track(level) @ rotation(vertical).T, atol=0.01)


def test_a_mask_is_drawn_on_the_images_as_they_were_taken(corridor, vertical, tmp_path):
    turns = vertical.sequence.camera.quarter_turns
    mask = np.full(corridor.left[0].shape, 255, np.uint8)
    mask[110:] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), np.rot90(mask, -turns))
    masked = with_masks(vertical.sequence, tmp_path / "mask.png")
    np.testing.assert_array_equal(masked.stored[0].mask(), mask)


def test_a_camera_has_at_most_one_quarter_turn():
    assert turned_camera(-1).left_camera().quarter_turns == -1
    with pytest.raises(ValueError, match="quarter_turns is 2 but must be -1, 0 or 1"):
        turned_camera(2)
