"""The IMU of each kind of source: samples, units, and the place of the IMU on the camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from source_files import write_bag, write_video
from test_euroc import numbers, sensor
from test_kitti_raw import DRIVE, FIRST, T_X, line, write_drive

from vslam.datasets.euroc import open_euroc
from vslam.datasets.imu import Imu, ImuFeed, joined
from vslam.datasets.imu_csv import HEADER, read_imu_csv
from vslam.datasets.sources import open_source
from vslam.support.errors import InputError
from vslam.types.geometry import se3_exp
from vslam.types.imu import GRAVITY, ImuCalibration
from vslam.types.source_options import SourceOptions

REAL = Path(__file__).parents[3] / "shared/data/euroc/V1_01_start"
DEGREES = 57.29577951308232
TURN = 0.01 * np.arange(1, 7)  # a sample's rates and forces besides gravity


def samples(n: int = 50, start: float = 10.0, step: float = 0.005) -> np.ndarray:
    rows = np.tile([0.0, *TURN], (n, 1))
    rows[:, 0] = start + step * np.arange(n)
    rows[:, 1] += 0.1 * np.sin(np.arange(n))
    rows[:, 6] += GRAVITY
    return rows


def write(path: Path, head: str, rows: np.ndarray, factors=(1,) * 7, digits: str = "%.17g") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows * np.array(factors), digits, ",", header=head, comments="")
    return path


@pytest.mark.parametrize(
    ("head", "factors"),
    [
        (HEADER, (1,) * 7),
        ("timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z", (1e9,) + (1,) * 6),
        (
            "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
            "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]",
            (1e9,) + (1,) * 6,
        ),
        ("t,gx,gy,gz,ax,ay,az", (1e6,) + (1,) * 6),
        (
            "time_ms,gyro_x_dps,gyro_y_dps,gyro_z_dps,acc_x,acc_y,acc_z",
            (1e3, *[DEGREES] * 3, 1, 1, 1),
        ),
        (
            "Time (s),Gyro.X (deg/s),Gyro.Y,Gyro.Z,Accel.X (g),Accel.Y (g),Accel.Z (g)",
            (1, *[DEGREES] * 3, *[1 / GRAVITY] * 3),
        ),
        (
            "time,angular_velocity.x,angular_velocity.y,angular_velocity.z,linear_acceleration.x,"
            "linear_acceleration.y,linear_acceleration.z",
            (1,) * 7,
        ),
    ],
)  # fmt: skip
def test_units_are_named_by_the_header_or_follow_from_the_rate(tmp_path, head, factors):
    rows = samples()
    found = read_imu_csv(write(tmp_path / "imu.csv", head, rows, factors))
    np.testing.assert_allclose(found, rows, rtol=1e-9)


def test_columns_may_be_in_any_order_and_others_are_ignored(tmp_path):
    rows = samples()
    mixed = np.column_stack([rows[:, 4:], np.ones(len(rows)), rows[:, :4]])
    head = "ax,ay,az,temperature,time,gx,gy,gz"
    path = tmp_path / "imu.csv"
    np.savetxt(path, mixed, "%.17g", ",", header=head, comments="")
    np.testing.assert_allclose(read_imu_csv(path), rows)


@pytest.mark.parametrize(
    ("head", "factors", "said"),
    [
        ("1,2,3,4,5,6,7", (1,) * 7, "names no column for time"),
        ("time,gx,gy,gz,ax,ay", (1,) * 7, "no column for accel z"),
        ("time,gx [rpm],gy,gz,ax,ay,az", (1,) * 7, "unit of the column gx"),
        ("time [ns],gx,gy,gz,ax,ay,az", (1,) * 7, "which no IMU does"),
        (HEADER, (1e12,) + (1,) * 6, "no rate of an IMU"),
        (HEADER, (1,) * 4 + (1 / GRAVITY,) * 3, "write accel_x [g]"),
        (HEADER, (1,) * 4 + (1e3,) * 3, "not m/s^2"),
    ],
)
def test_a_file_that_would_be_misread_is_refused(tmp_path, head, factors, said):
    path = write(tmp_path / "imu.csv", head, samples(), factors)
    with pytest.raises(InputError, match=r"imu\.csv") as error:
        read_imu_csv(path)
    assert said in str(error.value)


def test_a_damaged_row_is_named(tmp_path):
    path = write(tmp_path / "imu.csv", HEADER, samples(3))
    path.write_text(path.read_text() + "1.0,x,0,0,0,0,0\n")
    with pytest.raises(InputError, match="row 5"):
        read_imu_csv(path)


def imu_of(rows: np.ndarray, offset: float = 0.0) -> Imu:
    return Imu("imu", lambda: rows, ImuCalibration(np.eye(4), time_offset=offset))


def test_frames_get_each_sample_once_and_the_first_after_them():
    rows = samples(100, 0.0, 0.01)
    feed = ImuFeed(imu_of(rows))
    parts = [feed.until(t) for t in (0.105, 0.2, 0.2, 5.0, 6.0)]
    assert [len(part) for part in parts] == [12, 9, 0, 79, 0]
    np.testing.assert_array_equal(np.concatenate(parts), rows)


def test_times_of_samples_are_moved_to_the_clock_of_the_camera():
    (part,) = [ImuFeed(imu_of(samples(3, 10.0), 4.0)).until(6.006)]
    np.testing.assert_allclose(part[:, 0], [6.0, 6.005, 6.01])


def test_samples_of_a_live_device_come_as_they_arrive():
    arriving = [samples(2, 1.0), samples(3, 1.01), samples(0)]
    imu = Imu("live", lambda: arriving.pop(0), ImuCalibration(np.eye(4)), live=True)
    feed = ImuFeed(imu)
    assert [len(feed.until(t)) for t in (1.0, 1.1, 1.2)] == [2, 3, 0]
    with pytest.raises(TypeError):
        imu.recorded  # noqa: B018


@pytest.mark.skipif(not REAL.is_dir(), reason="EuRoC is not here")
def test_euroc_has_all_samples_and_the_pose_of_the_rectified_camera():
    source = open_euroc(REAL)
    imu = source.imu
    assert imu is not None
    assert imu.calibration is not None
    found = imu.recorded
    assert found.samples.shape == (29_120, 7)
    assert not found.notes
    # The first images of the clip are 1403715273262142976 ns; the drone hangs nearly upright.
    assert abs(found.samples[0, 0] - source.timestamps[0]) < 1e-6
    up = imu.calibration.T_imu_camera[:3, :3].T @ found.samples[:, 4:].mean(axis=0)
    assert np.argmin(up) == 1
    assert up[1] < -8.0
    assert imu.calibration.noise.gyro == 1.6968e-4
    # Rectification turns the camera by less than a degree, but not by zero.
    T_left = np.eye(4)
    T_left[:3] = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
            [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
            [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        ]
    )
    turned = T_left[:3, :3].T @ imu.calibration.T_imu_camera[:3, :3]
    angle = np.degrees(np.arccos((np.trace(turned) - 1.0) / 2.0))
    assert 0.1 < angle < 2.0
    np.testing.assert_allclose(imu.calibration.T_imu_camera[:3, 3], T_left[:3, 3], atol=1e-6)


def test_rectification_turns_the_calibration_of_the_imu(corridor, tmp_path):
    """The rectified camera sees the IMU elsewhere by exactly the rotation of the images."""
    T_B_imu = se3_exp(np.array([0.1, 0.2, -0.1, 0.3, -0.2, 0.4]))
    base = tmp_path / "V9_02" / "mav0"
    inward = np.eye(4)
    inward[0, 3] = corridor.camera.baseline
    inward = inward @ se3_exp(np.array([0, 0, 0, 0.04, 0.0, 0.0]))
    for side, T in enumerate((np.eye(4), inward)):
        folder = base / f"cam{side}"
        (folder / "data").mkdir(parents=True)
        images = (corridor.left, corridor.right)[side]
        cv2.imwrite(str(folder / "data" / "1000000000.png"), images[0])
        (folder / "data.csv").write_text("#timestamp [ns],filename\n1000000000,1000000000.png\n")
        (folder / "sensor.yaml").write_text(sensor(T, corridor.camera))
    write(base / "imu0" / "data.csv", HEADER, samples(), (1e9,) + (1,) * 6)
    (base / "imu0" / "sensor.yaml").write_text(
        f"T_BS:\n  data: [{numbers(T_B_imu)}]\ngyroscope_noise_density: 2.0e-4\n"
    )
    pair = open_euroc(tmp_path / "V9_02").imu
    alone = open_euroc(tmp_path / "V9_02", monocular=True).imu
    assert pair is not None
    assert pair.calibration is not None
    assert alone is not None
    assert alone.calibration is not None
    np.testing.assert_allclose(alone.calibration.T_imu_camera, np.linalg.inv(T_B_imu), atol=1e-9)
    R = np.linalg.inv(alone.calibration.T_imu_camera) @ pair.calibration.T_imu_camera
    np.testing.assert_allclose(R[:3, 3], 0.0, atol=1e-9)
    assert 0.005 < np.linalg.norm(R[:3, :3] - np.eye(3)) < 0.05  # half of the angle between them
    assert pair.calibration.noise.gyro == 2e-4
    (base / "imu0" / "sensor.yaml").write_text(
        "T_BS:\n  data: [0,0,0,0, 0,0,0,0, 0,0,0,0, 0,0,0,0]\ngyroscope_noise_density: 2.0e-4\n"
    )
    source = open_euroc(tmp_path / "V9_02")
    assert source.imu is not None
    assert source.imu.calibration is None
    assert "all zeros" in source.warnings[0]
    assert "The IMU is not used" in source.warnings[0]


def bag(tmp_path: Path, corridor, kind: str, **topics: np.ndarray) -> dict:
    sides = {"/left/image": corridor.left[:2], "/right/image": corridor.right[:2]}
    path = tmp_path / {"ros1": "drive.bag"}.get(kind, "drive")
    named = {f"/imu/{name}": rows for name, rows in topics.items()}
    stamps = [10**10, 10**10 + 10**8]
    found = write_bag(path, kind, sides, stamps, camera=corridor.camera, imu=named)
    return {"data": str(found), "dataset": "bag", "topics": "/left/image,/right/image"}


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_the_only_imu_of_a_bag_is_read(tmp_path, corridor, kind):
    given = bag(tmp_path, corridor, kind, data=samples())
    imu = open_source(SourceOptions(**given)).imu
    assert imu is not None
    assert imu.name.endswith(": /imu/data")
    assert imu.calibration is None
    np.testing.assert_allclose(imu.recorded.samples, samples(), atol=1e-9)
    assert open_source(SourceOptions(**given, imu=False)).imu is None


def test_gyroscope_and_accelerometer_in_two_topics_are_joined(tmp_path, corridor):
    """As RealSense records them: 200 and 100 Hz, each with zeros in place of the other."""
    rows = samples(40)
    rows[:, 4] = 3.0 * (rows[:, 0] - 10.0)  # so that interpolation is exact
    gyro, accel = rows.copy(), rows[1::2].copy()
    gyro[:, 4:], accel[:, 1:4] = 0.0, 0.0
    given = bag(tmp_path, corridor, "ros1", gyro=gyro, accel=accel)
    imu = open_source(SourceOptions(**given)).imu
    assert imu is not None
    np.testing.assert_allclose(imu.recorded.samples, rows[1:], atol=1e-8)


def test_samples_in_a_gap_of_the_accelerometer_are_left_out():
    gyro, accel = samples(100), samples(100)
    accel = np.delete(accel, slice(40, 70), axis=0)  # 0.155 s
    assert len(joined(gyro, accel)) == 100 - 30
    assert joined(gyro, accel[:1]).shape == (0, 7)


def test_the_user_chooses_among_several_imus(tmp_path, corridor):
    given = bag(tmp_path, corridor, "ros1", body=samples(), camera=samples(20))
    source = open_source(SourceOptions(**given))
    assert source.imu is None
    assert "/imu/body, /imu/camera" in source.warnings[0]
    imu = open_source(SourceOptions(**given, imu_topics="/imu/camera")).imu
    assert imu is not None
    assert len(imu.recorded.samples) == 20
    with pytest.raises(InputError, match=r"--imu-topics /imu: not in .*/imu/body, /imu/camera"):
        open_source(SourceOptions(**given, imu_topics="/imu"))


def test_samples_without_time_stamps_are_refused(tmp_path, corridor):
    rows = samples()
    rows[:, 0] = 0.0
    imu = open_source(SourceOptions(**bag(tmp_path, corridor, "ros1", data=rows))).imu
    assert imu is not None
    with pytest.raises(InputError, match="no time stamps"):
        imu.recorded  # noqa: B018


T_IMU_CAMERA = se3_exp(np.array([0.05, 0.0, 0.02, 0.1, 0.2, 0.3]))


def calibration(tmp_path: Path, camera) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(
        f"left:\n  focal: [{camera.fx}, {camera.fy}]\n  centre: [{camera.cx}, {camera.cy}]\n"
        f"imu:\n  T_imu_camera: {T_IMU_CAMERA.tolist()}\n"
    )
    return path


@pytest.mark.parametrize("name", ["images/imu.csv", "imu.csv", "drive.imu.csv"])
def test_a_csv_file_beside_images_or_a_video(tmp_path, corridor, name):
    (tmp_path / "images").mkdir()
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"images/{10**10 + k * 10**8}.png"), corridor.left[k])
    write_video(tmp_path / "drive.avi", corridor.left[:5], 10.0)
    write(tmp_path / name, HEADER, samples())
    calib = calibration(tmp_path, corridor.camera)
    for data, expected in (
        ("images", name != "drive.imu.csv"),
        ("drive.avi", "images" not in name),
    ):
        given = SourceOptions(data=str(tmp_path / data), calib=(calib,), sensor="mono")
        imu = open_source(given).imu
        assert (imu is not None) is expected
        if imu is not None:
            assert imu.calibration is not None
            np.testing.assert_allclose(imu.calibration.T_imu_camera, T_IMU_CAMERA, atol=1e-12)
            np.testing.assert_allclose(imu.recorded.samples, samples())


def oxts(drive: Path, rate: int) -> None:
    folder = drive / "oxts"
    (folder / "data").mkdir(parents=True)
    stamps = [f"2011-09-26 13:02:25.{250000123 + k * 10**9 // rate:09d}" for k in range(20)]
    (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for k in range(20):
        numbers = np.zeros(30)
        numbers[11:14], numbers[17:20] = (0.1, 0.2, GRAVITY), (0.01, 0.02, 0.03 + k)
        text = " ".join(map(repr, numbers.tolist()))
        (folder / "data" / f"{k:010}.txt").write_text(text)


def test_the_inertial_unit_of_kitti_raw(tmp_path):
    """Axes of unit and laser: ahead, left, up. Axes of the camera: right, down, ahead."""
    drive = write_drive(tmp_path)
    oxts(drive, 40)
    source = open_source(SourceOptions(data=str(drive)))
    assert source.imu is not None
    assert source.imu.calibration is None
    (drive.parent / "calib_imu_to_velo.txt").write_text(
        line("R", np.eye(3)) + line("T", [-0.81, 0.32, -0.8])
    )
    (drive.parent / "calib_velo_to_cam.txt").write_text(
        "calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n"
    )
    for kind in ("stereo", "mono"):
        imu = open_source(SourceOptions(data=str(drive), sensor=kind)).imu
        assert imu is not None
        assert imu.calibration is not None
        T_camera_imu = np.linalg.inv(imu.calibration.T_imu_camera)
        np.testing.assert_allclose(T_camera_imu[:3, :3] @ (0, 0, 1), (0, -1, 0), atol=1e-12)
        place = (-0.32, 0.8 - 0.08, -0.81 - 0.27)
        np.testing.assert_allclose(T_camera_imu[:3, 3], place, atol=1e-9)
    found = imu.recorded.samples
    np.testing.assert_allclose(found[:, 0], FIRST + np.arange(20) / 40, atol=2e-6)
    np.testing.assert_allclose(found[3, 1:], [0.01, 0.02, 3.03, 0.1, 0.2, GRAVITY])
    oxts(drive.with_name(DRIVE.replace("sync", "extract")), 100)
    faster = open_source(SourceOptions(data=str(drive))).imu
    assert faster is not None
    assert np.diff(faster.recorded.samples[:2, 0]) == pytest.approx(0.01, abs=1e-5)


def test_another_colour_camera_of_kitti_raw_is_beside_the_first(tmp_path):
    drive = write_drive(tmp_path, cameras=(2, 3))
    oxts(drive, 100)
    for name in ("calib_imu_to_velo.txt", "calib_velo_to_cam.txt"):
        (drive.parent / name).write_text(line("R", np.eye(3)) + line("T", [0.1, 0.0, 0.0]))
    imu = open_source(SourceOptions(data=str(drive))).imu
    assert imu is not None
    assert imu.calibration is not None
    place = np.linalg.inv(imu.calibration.T_imu_camera)[:3, 3]
    np.testing.assert_allclose(place, [0.2 + T_X[2], 0, 0], atol=1e-9)
