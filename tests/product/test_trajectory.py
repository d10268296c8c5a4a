from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vslam.support.errors import InputError
from vslam.types.geometry import se3_exp
from vslam.types.trajectory import (
    Trajectory,
    bridge_gaps,
    quaternions,
    read_kitti_poses,
    read_trajectory,
    trajectory_format,
    write_euroc,
    write_kitti,
    write_tum,
)


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(0)
    T_wc = np.tile(np.eye(4), (20, 1, 1))
    T_wc[:, :3, :3] = Rotation.random(20, rng=rng).as_matrix()
    T_wc[:, :3, 3] = rng.normal(0, 300, (20, 3))
    return Trajectory(1305031102.175304 + 0.1 * np.arange(20), T_wc)


def test_kitti_round_trip(tmp_path, trajectory):
    path = tmp_path / "poses.txt"
    write_kitti(path, trajectory.T_wc)
    np.testing.assert_allclose(read_kitti_poses(path), trajectory.T_wc, atol=1e-9)
    read = read_trajectory(path, trajectory.timestamps)
    np.testing.assert_array_equal(read.timestamps, trajectory.timestamps)
    np.testing.assert_array_equal(read_trajectory(path).timestamps, np.arange(20))
    assert trajectory_format(path) == "kitti"


def test_tum_round_trip(tmp_path, trajectory):
    path = tmp_path / "trajectory.txt"
    write_tum(path, trajectory)
    read = read_trajectory(path)
    np.testing.assert_allclose(read.timestamps, trajectory.timestamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.T_wc, trajectory.T_wc, atol=1e-8)
    assert trajectory_format(path) == "tum"
    assert (np.loadtxt(path)[:, 7] >= 0).all()


def test_equal_poses_are_written_as_equal_bytes(tmp_path):
    T_wc = np.eye(4)[None].copy()
    write_kitti(tmp_path / "a.txt", T_wc)
    T_wc[0, 0, 3] = -0.0
    write_kitti(tmp_path / "b.txt", T_wc)
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()


def test_comments_and_blank_lines_are_passed_over(tmp_path):
    path = tmp_path / "trajectory.txt"
    path.write_text("# t x y z qx qy qz qw\n\n0 1 2 3 0 0 0 1\n")
    np.testing.assert_array_equal(read_trajectory(path).T_wc[0, :3, 3], [1, 2, 3])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "empty"),
        ("0 1 2\n", "line 1 has 3 numbers (a position without time and orientation) where a pose"),
        ("0 1 2 3 0 0 0 1\n1 2 3\n", "line 2 has 3 numbers where a pose takes 8"),
        ("0 1 2 3 0 0 0 x\n", "line 1 is not a row of numbers"),
        ("0 1 2 3 0 0 nan 1\n", "line 1 holds NaN"),
        ("0 1 2 3 0 0 0 2\n", "length of a quaternion is not 1"),
        ("1 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", "pose 2 is not later"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "pose 1 is not a rotation"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "pose 1 is not a rotation"),
    ],
)
def test_malformed_files(tmp_path, text, part):
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_trajectory(path)
    assert part in str(caught.value)
    assert str(path) in str(caught.value)


def test_binary_and_missing_files(tmp_path):
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="not a text file"):
        read_trajectory(tmp_path / "binary")
    with pytest.raises(InputError, match="cannot read"):
        read_trajectory(tmp_path / "missing")


def test_other_number_of_timestamps(tmp_path, trajectory):
    write_kitti(tmp_path / "poses.txt", trajectory.T_wc)
    with pytest.raises(InputError, match="20 poses but 3 timestamps"):
        read_trajectory(tmp_path / "poses.txt", np.arange(3.0))


def test_gaps_are_bridged_at_constant_velocity():
    times = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    twist = np.array([1.0, 0.2, 0.0, 0.0, 0.1, 0.0])  # a second
    T_wc = np.array([se3_exp(twist * t) for t in times])
    known = np.array([True, False, False, True, False])
    guessed = np.where(known[:, None, None], T_wc, np.eye(4))
    bridged = bridge_gaps(Trajectory(times, guessed), known)
    np.testing.assert_allclose(bridged.T_wc[:4], T_wc[:4], atol=1e-12)
    np.testing.assert_array_equal(bridged.T_wc[4], np.eye(4))  # there is no known pose after it
    known[0] = False  # the first known pose is the fourth
    np.testing.assert_array_equal(
        bridge_gaps(Trajectory(times, guessed), known).T_wc[:3], np.tile(T_wc[3], (3, 1, 1))
    )


def test_quaternions_are_those_of_scipy_to_the_last_bit():
    rng = np.random.default_rng(0)
    half_turns = Rotation.from_matrix([np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])])
    for rotations in (
        Rotation.random(1000, rng=1),
        Rotation.from_rotvec(rng.normal(0, 1e-3, (1000, 3))),
        half_turns,
        Rotation.identity(2),
    ):
        R = rotations.as_matrix()
        for almost in (R, R + rng.normal(0, 1e-8, R.shape)):
            expected = Rotation.from_matrix(almost).as_quat(canonical=True)
            assert quaternions(almost).tobytes() == expected.tobytes()
    assert quaternions(np.empty((0, 3, 3))).shape == (0, 4)


def _rows(trajectory: Trajectory, unit: float = 1.0, w_first: bool = False) -> list[list[str]]:
    q = quaternions(trajectory.T_wc[:, :3, :3])
    q = q[:, [3, 0, 1, 2]] if w_first else q
    values = np.column_stack([trajectory.T_wc[:, :3, 3], q])
    times = [f"{t / unit:.0f}" if unit < 1 else f"{t:.6f}" for t in trajectory.timestamps]
    return [[t, *(f"{x:.12f}" for x in row)] for t, row in zip(times, values, strict=True)]


@pytest.mark.parametrize(
    ("header", "separator", "unit", "w_first", "more", "format_"),
    [
        (
            "#timestamp [ns],x [m],y [m],z [m],q_w [],q_x [],q_y [],q_z []",
            ",",
            1e-9,
            True,
            0,
            "euroc",
        ),
        ("timestamp,px,py,pz,qw,qx,qy,qz", ",", 1e-9, True, 0, "euroc"),
        ("#timestamp [ns],p_RS_R_x [m], and others", ",", 1e-9, True, 9, "euroc"),
        ("", ", ", 1e-9, True, 0, "euroc"),
        ("", ",", 1e-9, True, 3, "euroc"),
        ("time,x,y,z,qx,qy,qz,qw", ",", 1.0, False, 0, "tum"),
        ("timestamp_ns;x;y;z;qx;qy;qz;qw", ";", 1e-9, False, 0, "tum"),
        ("", ",", 1.0, False, 0, "tum"),
        ("", ",", 1, False, 0, "tum"),
        ("timestamp tx ty tz qx qy qz qw", "\t", 1.0, False, 0, "tum"),
        ("", " ", 1.0, False, 0, "tum"),
    ],
)
def test_formats(tmp_path, trajectory, header, separator, unit, w_first, more, format_):
    path = tmp_path / "trajectory.csv"
    rows = [[*row, *["0.5"] * more] for row in _rows(trajectory, unit, w_first)]
    lines = [header] * bool(header) + [separator.join(row) for row in rows]
    path.write_text("\ufeff" + "\r\n".join(lines) + "\r\n", encoding="utf-8")
    assert trajectory_format(path) == format_
    read = read_trajectory(path)
    np.testing.assert_allclose(read.timestamps, trajectory.timestamps, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.T_wc, trajectory.T_wc, atol=1e-9)


def test_euroc_round_trip(tmp_path, trajectory):
    for start in (0.0, trajectory.timestamps[0]):
        written = Trajectory(
            start + trajectory.timestamps - trajectory.timestamps[0], trajectory.T_wc
        )
        write_euroc(tmp_path / "trajectory.csv", written)
        read = read_trajectory(tmp_path / "trajectory.csv")
        np.testing.assert_allclose(read.timestamps, written.timestamps, rtol=0, atol=1e-6)
        np.testing.assert_allclose(read.T_wc, written.T_wc, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("0 1 2 3\n", "4 numbers (a time and a position without orientation) where a pose"),
        ("1,2,3,0,0,0,1\n2,2,3,0,0,0,1\n", "7 numbers (a pose without time)"),
        ("130.1 rgb/130.1.png\n", "line 1 is not a row of numbers"),
        ("a recording\nof a robot\n", "line 2 is not a row of numbers"),
        ("<html>\n", "a web page instead of a file with a pose on each line"),
        ("a recording\n", 'has no numbers (it begins with "a recording")'),
        ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "left-handed"),
        ("1 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", "remove one of them"),
    ],
)
def test_a_sound_file_of_another_kind_is_not_called_damaged(tmp_path, text, part):
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError) as caught:
        read_trajectory(tmp_path / "file")
    assert part in str(caught.value)
    assert "download" not in str(caught.value)


@pytest.mark.parametrize("text", ["0 1 2 3 0 0 0 1\n1 2 3\n", "0 1 2 3 0 0 0 1\n\0\0\n"])
def test_a_file_that_is_cut_off_or_has_garbage_is_called_damaged(tmp_path, text):
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError, match="download the file again"):
        read_trajectory(tmp_path / "file")


def test_a_trajectory_is_named_where_kitti_poses_are_expected(tmp_path, trajectory):
    write_tum(tmp_path / "00.txt", trajectory)
    with pytest.raises(InputError, match=r"as in TUM's format.* where a KITTI pose takes 12"):
        read_kitti_poses(tmp_path / "00.txt")
