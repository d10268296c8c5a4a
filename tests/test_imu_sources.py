"""The IMU of each kind of source: samples, units, and the place of the IMU on the camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_euroc import numbers, sensor

from vslam.datasets.euroc import open_euroc
from vslam.datasets.imu import Imu, ImuFeed
from vslam.datasets.imu_csv import HEADER, read_imu_csv
from vslam.support.errors import InputError
from vslam.types.geometry import se3_exp
from vslam.types.imu import GRAVITY, ImuCalibration

REAL = Path(__file__).parents[2] / "shared/data/euroc/V1_01_start"
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
