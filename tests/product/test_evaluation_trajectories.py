"""The evaluation computes exactly the error of trajectories whose error is known."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evo.core.metrics import APE, RPE, PoseRelation
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation

from vslam.evaluation.trajectories import (
    command_of_evo,
    evaluate_trajectory,
    evo_command,
    kitti_drift,
    path_length,
    read_pair,
)
from vslam.support.errors import InputError
from vslam.types.trajectory import (
    Trajectory,
    trajectory_format,
    write_euroc,
    write_kitti,
    write_tum,
)


def drive(n: int = 2001, step: float = 0.5, turn: float = 0.004) -> Trajectory:
    """Return the poses of a camera on a circle.

    It moves ``step`` metres forward and turns ``turn`` radians per frame.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, turn, 0]).as_matrix()
    T[2, 3] = step
    T_wc = np.empty((n, 4, 4))
    T_wc[0] = np.eye(4)
    for k in range(1, n):
        T_wc[k] = T_wc[k - 1] @ T
    return Trajectory(0.1 * np.arange(n), T_wc)


def straight(n: int, step: float) -> Trajectory:
    return drive(n, step, turn=0.0)


def moved(trajectory: Trajectory, T: np.ndarray) -> Trajectory:
    return Trajectory(trajectory.timestamps, T @ trajectory.T_wc)


def scaled(trajectory: Trajectory, factor: float) -> Trajectory:
    T_wc = trajectory.T_wc.copy()
    T_wc[:, :3, 3] *= factor
    return Trajectory(trajectory.timestamps, T_wc)


def noisy(trajectory: Trajectory, deviation: float) -> Trajectory:
    T_wc = trajectory.T_wc.copy()
    T_wc[:, :3, 3] += np.random.default_rng(0).normal(0, deviation, (len(T_wc), 3))
    return Trajectory(trajectory.timestamps, T_wc)


RIGID = np.eye(4)
RIGID[:3, :3] = Rotation.from_euler("xyz", [20, -70, 110], degrees=True).as_matrix()
RIGID[:3, 3] = [100.0, -20.0, 3.0]


def test_a_rigid_motion_is_no_error():
    truth = drive()
    result = evaluate_trajectory(moved(truth, RIGID), truth)
    assert result.frames == 2001
    assert result.ate_rmse_m < 1e-9
    assert result.rpe_m < 1e-9
    assert result.t_rel_percent < 1e-6
    assert result.r_rel_deg_per_100m < 1e-6
    np.testing.assert_allclose(result.T_wc_aligned, truth.T_wc, atol=1e-9)
    np.testing.assert_allclose(result.distances_m, 0.5 * np.arange(2001))


@pytest.mark.parametrize("alignment", ["se3", "sim3", "none"])
def test_errors_are_those_of_evo(alignment):
    truth = drive(400)
    estimate = moved(scaled(noisy(truth, 0.05), 1.02), RIGID)
    turns = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.02, (400, 3)))
    estimate.T_wc[:, :3, :3] = estimate.T_wc[:, :3, :3] @ turns.as_matrix()
    theirs, reference = (
        PoseTrajectory3D(poses_se3=list(t.T_wc), timestamps=t.timestamps) for t in (estimate, truth)
    )
    if alignment != "none":
        theirs.align(reference, correct_scale=alignment == "sim3")
    expected = [APE(PoseRelation.translation_part)]
    expected += [RPE(PoseRelation.translation_part), RPE(PoseRelation.rotation_angle_deg)]
    for metric in expected:
        metric.process_data((reference, theirs))
    ours = evaluate_trajectory(estimate, truth, alignment)
    np.testing.assert_allclose(ours.T_wc_aligned, theirs.poses_se3, atol=1e-10)
    np.testing.assert_allclose(ours.errors_m, expected[0].error, atol=1e-10)
    rmse = [metric.get_all_statistics()["rmse"] for metric in expected]
    assert [ours.ate_rmse_m, ours.rpe_m, ours.rpe_deg] == pytest.approx(rmse, abs=1e-9)


def test_without_alignment_a_constant_offset_is_the_error():
    truth = drive(300)
    offset = np.eye(4)
    offset[:3, 3] = [3.0, 0.0, 4.0]
    result = evaluate_trajectory(moved(truth, offset), truth, "none")
    assert result.ate_rmse_m == pytest.approx(5.0)
    assert result.ate_mean_m == pytest.approx(5.0)
    assert result.ate_max_m == pytest.approx(5.0)
    assert result.rpe_m < 1e-9


def test_alignment_of_position_noise():
    truth = drive()
    result = evaluate_trajectory(noisy(truth, 0.3), truth)
    assert result.ate_rmse_m == pytest.approx(0.3 * np.sqrt(3), rel=0.03)
    assert result.rpe_m == pytest.approx(0.3 * np.sqrt(6), rel=0.03)
    assert result.rpe_deg < 1e-5
    assert result.errors_m.shape == (2001,)


@pytest.mark.slow
def test_scale_error_is_drift_in_se3_and_none_in_sim3():
    truth = straight(2001, 0.5)
    drift = kitti_drift(scaled(truth, 1.01).T_wc, truth.T_wc)
    # Each length ends at the first frame beyond it, which is 0.5 m later.
    assert drift == pytest.approx((1.0, 0.0), abs=0.003)
    truth = drive()
    assert evaluate_trajectory(scaled(truth, 1.01), truth).ate_rmse_m > 0.5
    assert evaluate_trajectory(scaled(truth, 1.01), truth, "sim3").ate_rmse_m < 1e-9


def test_scale_error_of_one_percent_in_the_limit_of_short_steps():
    truth = straight(8001, 0.015625)  # an exact binary fraction, so that 100 m fall on a frame
    t_rel, r_rel = kitti_drift(scaled(truth, 1.01).T_wc, truth.T_wc)
    assert t_rel == pytest.approx(1.000, abs=5e-4)
    assert r_rel == pytest.approx(0.0, abs=1e-9)


def test_yaw_rate_error_gives_its_rate_as_rotation_drift():
    truth = straight(1801, 0.5)
    error_deg_per_m = 0.01
    estimate = drive(1801, 0.5, turn=np.radians(error_deg_per_m * 0.5))
    t_rel, r_rel = kitti_drift(estimate.T_wc, truth.T_wc)
    assert r_rel == pytest.approx(100 * error_deg_per_m, rel=0.003)
    # After a length L, an arc of curvature c has a lateral offset of about c L^2 / 2.
    lengths, frames = np.arange(100, 801, 100), 1801
    starts = [
        np.arange(0, frames, 10)[np.arange(0, frames, 10) + 2 * x + 1 < frames].size
        for x in lengths
    ]
    sideways = np.radians(error_deg_per_m) * lengths / 2
    assert t_rel == pytest.approx(100 * np.average(sideways, weights=starts), rel=0.01)


def test_drift_needs_100_m():
    short = drive(200)
    result = evaluate_trajectory(noisy(short, 0.01), short)
    assert result.t_rel_percent is None
    assert result.r_rel_deg_per_100m is None
    assert kitti_drift(drive(203).T_wc, drive(203).T_wc) is not None


def test_path_length():
    assert path_length(np.eye(4)[None]).tolist() == [0.0]
    np.testing.assert_allclose(path_length(drive(5).T_wc), [0, 0.5, 1, 1.5, 2])


def test_different_lengths_are_matched_by_time():
    truth = drive(500)
    estimate = moved(truth.select(np.arange(100, 400, 3)), RIGID)
    result = evaluate_trajectory(estimate, truth)
    assert (result.frames, result.interpolated) == (100, 0)
    assert result.ate_rmse_m < 1e-9
    late = Trajectory(estimate.timestamps + 0.004, estimate.T_wc)
    assert evaluate_trajectory(late, truth).interpolated == 100
    # Now the longer trajectory is the estimate.
    assert evaluate_trajectory(truth, estimate).frames == 100


def test_equal_lengths_at_other_times_are_matched_by_time():
    truth = drive(500)
    result = evaluate_trajectory(truth.select(np.arange(100)), truth.select(np.arange(50, 150)))
    assert result.frames == 50
    assert result.ate_rmse_m < 1e-9


def test_no_common_times():
    truth = drive(50)
    later = Trajectory(truth.timestamps + 1e6, truth.T_wc)
    with pytest.raises(InputError, match="none of the 50 poses lies within 10 ms"):
        evaluate_trajectory(later, truth)


@pytest.mark.parametrize("trajectory", [drive(1), straight(20, 0.0)])
def test_too_little_motion_to_align(trajectory):
    with pytest.raises(InputError, match="too little motion"):
        evaluate_trajectory(trajectory, trajectory)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_a_straight_line_is_aligned_by_the_orientations(alignment):
    truth = straight(20, 0.5)
    estimate = scaled(moved(truth, RIGID), 2.0 if alignment == "sim3" else 1.0)
    found = evaluate_trajectory(estimate, truth, alignment)
    assert found.on_one_line
    assert found.ate_max_m < 1e-6
    np.testing.assert_allclose(found.T_wc_aligned, truth.T_wc, atol=1e-6)
    assert not evaluate_trajectory(moved(drive(20), RIGID), drive(20)).on_one_line


def test_a_bend_of_an_estimate_of_a_straight_line_is_its_error():
    truth = straight(20, 0.5)
    bent = drive(20, 0.5, turn=0.01)
    found = evaluate_trajectory(bent, truth)
    turned = evaluate_trajectory(bent, moved(truth, RIGID))
    assert 0.01 < found.ate_rmse_m < 0.1
    assert turned.ate_rmse_m == pytest.approx(found.ate_rmse_m, rel=1e-6)


def test_unknown_alignment():
    with pytest.raises(InputError, match=r"--align rigid: unknown .* se3, sim3, none"):
        evaluate_trajectory(drive(9), drive(9), "rigid")


@pytest.mark.slow
@pytest.mark.parametrize("alignment", ["se3", "sim3", "none"])
@pytest.mark.parametrize("write", [lambda p, t: write_kitti(p, t.T_wc), write_tum])
def test_evo_command_reproduces_the_ate(tmp_path, write, alignment):
    truth = drive(120)
    estimate = scaled(noisy(moved(truth, RIGID), 0.2), 1.05)
    paths = tmp_path / "an estimate.txt", tmp_path / "truth.txt"
    for path, trajectory in zip(paths, (estimate, truth), strict=True):
        write(path, trajectory)
    ours = evaluate_trajectory(*read_pair(*paths), alignment).ate_rmse_m
    words = shlex.split(evo_command(*paths, alignment, trajectory_format(paths[1])))
    words[0] = str(Path(sys.executable).with_name(words[0]))
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    rmse = re.search(r"rmse\s+([0-9.]+)", printed)
    assert rmse is not None
    assert ours == pytest.approx(float(rmse[1]), abs=1e-6)


def test_read_pair_mixes_formats_with_times(tmp_path):
    truth = drive(60)
    write_kitti(tmp_path / "truth.txt", truth.T_wc)
    write_tum(tmp_path / "estimate.txt", truth.select(np.arange(10, 40)))
    np.savetxt(tmp_path / "times.txt", truth.timestamps)
    pair = tmp_path / "estimate.txt", tmp_path / "truth.txt"
    assert evaluate_trajectory(*read_pair(*pair, tmp_path / "times.txt")).frames == 30
    with pytest.raises(InputError, match="give its times with --times"):
        read_pair(*pair)
    np.savetxt(tmp_path / "times.txt", 1e9 * truth.timestamps, fmt="%.0f")
    found = evaluate_trajectory(*read_pair(*pair, tmp_path / "times.txt"))
    assert (found.frames, len(found.warnings)) == (30, 1)
    np.savetxt(tmp_path / "times.txt", truth.timestamps[::-1])
    with pytest.raises(InputError, match="the times do not increase"):
        read_pair(*pair, tmp_path / "times.txt")


def test_read_pair_refuses_kitti_files_of_different_length(tmp_path):
    write_kitti(tmp_path / "truth.txt", drive(60).T_wc)
    write_kitti(tmp_path / "estimate.txt", drive(50).T_wc)
    with pytest.raises(InputError, match=r"50 poses but 60 .* ground_truth_kitti\.txt"):
        read_pair(tmp_path / "estimate.txt", tmp_path / "truth.txt")


def test_summary_has_the_numbers_only():
    truth = drive(50)
    summary = evaluate_trajectory(noisy(truth, 0.1), truth).summary()
    assert "errors_m" not in summary
    assert summary["frames"] == 50
    assert isinstance(summary["ate_rmse_m"], float)


def winding(n: int = 300) -> Trajectory:
    """Return the poses of a camera that moves and turns in three dimensions at 10 Hz."""
    t = 0.1 * np.arange(n)
    T_wc = np.tile(np.eye(4), (n, 1, 1))
    T_wc[:, :3, 3] = np.column_stack([np.sin(t), np.cos(0.7 * t), 0.5 * np.sin(0.4 * t)])
    turns = np.column_stack([0.3 * np.sin(t), 0.4 * t, 0.2 * np.cos(0.5 * t)])
    T_wc[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return Trajectory(t, T_wc)


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@pytest.mark.parametrize("alignment", ["se3", "sim3", "none"])
@pytest.mark.parametrize("of_rotations", [np.eye(4), MIRROR])
def test_a_mirrored_ground_truth_is_named(alignment, of_rotations):
    truth = winding()
    mirrored = truth.T_wc.copy()
    mirrored[:, :3, :3] = of_rotations[:3, :3] @ truth.T_wc[:, :3, :3] @ of_rotations[:3, :3]
    mirrored[:, :3, 3] = truth.T_wc[:, :3, 3] @ MIRROR[:3, :3]
    estimate = moved(noisy(truth, 0.01), RIGID)
    found = evaluate_trajectory(estimate, Trajectory(truth.timestamps, mirrored), alignment)
    assert "mirror image of the trajectory" in found.warnings[0]
    assert not evaluate_trajectory(estimate, truth, alignment).warnings


@pytest.mark.parametrize("alignment", ["se3", "none"])
def test_turns_tell_that_a_path_in_a_plane_is_mirrored(alignment):
    truth = drive(1000, turn=0.004)
    wrong = truth.T_wc.copy()
    wrong[:, 0, 3] *= -1.0
    estimate = moved(noisy(truth, 0.1), RIGID)
    found = evaluate_trajectory(estimate, Trajectory(truth.timestamps, wrong), alignment)
    assert "turns against the trajectory" in found.warnings[0]
    # A mirrored world with mirrored cameras is the same plane seen from the other side.
    same = MIRROR @ truth.T_wc @ MIRROR
    assert not evaluate_trajectory(estimate, Trajectory(truth.timestamps, same)).warnings
    # The axes of NED, and another frame of the vehicle
    ned = np.eye(4)
    ned[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    assert not evaluate_trajectory(
        estimate, Trajectory(truth.timestamps, ned @ truth.T_wc @ RIGID)
    ).warnings


def test_a_bad_estimate_is_no_mirror_image():
    truth = winding()
    bent = truth.T_wc.copy()
    bent[:, 2, 3] = 0.0
    assert not evaluate_trajectory(Trajectory(truth.timestamps, bent), truth).warnings
    assert not evaluate_trajectory(noisy(straight(200, 0.1), 0.01), straight(200, 0.1)).warnings


@pytest.mark.parametrize(
    ("unit", "name"), [(1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")]
)
@pytest.mark.parametrize("start", [0.0, 312.0, 1.7e9])
def test_times_in_another_unit_are_read_and_named(unit, name, start):
    truth = winding()
    seconds = Trajectory(start + truth.timestamps, truth.T_wc)
    other = Trajectory(seconds.timestamps / unit, truth.T_wc)
    some = seconds.select(np.arange(30, 290, 2))
    for estimate, gt, what in ((some, other, "ground truth"), (other, some, "trajectory")):
        found = evaluate_trajectory(estimate, gt)
        assert found.ate_rmse_m < 1e-6
        assert found.warnings == (
            f"the times of the {what} are read as {name}, because only then do they agree with "
            f"those of the {'ground truth' if what == 'trajectory' else 'trajectory'}.",
        )
    late = Trajectory(some.timestamps / unit + 0.02 / unit, some.T_wc)  # both in this unit
    found = evaluate_trajectory(late, other)
    assert (found.frames, len(found.warnings)) == (130, 2)
    assert name in found.warnings[0]


def test_a_constant_offset_between_the_clocks_is_named():
    truth = winding()
    later = Trajectory(truth.timestamps + 1.4e9, truth.T_wc)
    with pytest.raises(InputError, match=r"add 1400000000\.000 s to those of the ground truth"):
        evaluate_trajectory(later, truth)


def test_sparse_ground_truth_is_used_once():
    """No frame between poses that are far apart has a ground truth."""
    estimate = Trajectory(np.arange(1000) / 200.0, winding(1000).T_wc)
    truth = estimate.select(np.arange(0, 1000, 40))
    found = evaluate_trajectory(estimate, truth)
    assert (found.frames, found.interpolated) == (25, 0)
    assert found.ate_rmse_m < 1e-9
    shifted = Trajectory(truth.timestamps + 0.003, truth.T_wc)
    assert evaluate_trajectory(estimate, shifted).frames == 25


def test_read_pair_of_euroc_files(tmp_path):
    truth = winding()
    write_euroc(tmp_path / "truth.csv", truth)
    write_euroc(tmp_path / "estimate.csv", truth.select(np.arange(0, 300, 7)))
    write_tum(tmp_path / "estimate.tum", truth)
    for name in ("estimate.csv", "estimate.tum"):
        files = tmp_path / name, tmp_path / "truth.csv"
        found = evaluate_trajectory(*read_pair(*files))
        assert found.ate_rmse_m < 1e-9
        assert command_of_evo(*files, found) is None


def test_evo_is_named_only_where_it_compares_the_same_poses(tmp_path):
    truth = winding()
    late = Trajectory(truth.timestamps + 0.004, truth.T_wc)
    for name, one in (("estimate", truth), ("truth", truth), ("late", late)):
        write_tum(tmp_path / name, one)
    (tmp_path / "commas").write_text((tmp_path / "estimate").read_text().replace(" ", ","))
    named = {}
    for name in ("estimate", "late", "commas"):
        files = tmp_path / name, tmp_path / "truth"
        named[name] = command_of_evo(*files, evaluate_trajectory(*read_pair(*files)))
    assert named["estimate"] is not None
    assert named["late"] is named["commas"] is None
