"""Inertial samples are sorted and checked, and a wrong calibration is refused with its reason."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.types.geometry import inverse, se3_exp
from vslam.types.imu import ImuCalibration, ImuNoise, in_camera_time, tidied


def rows(times) -> np.ndarray:
    """Return samples whose numbers are distinct, so that a mixed-up row is seen."""
    times = np.asarray(times, float)
    return np.column_stack([times, np.arange(6.0 * len(times)).reshape(-1, 6)])


def test_sound_samples_are_passed_on_without_a_copy_or_a_note():
    samples = rows([0.0, 0.005, 0.01])
    tidy = tidied(samples)
    assert tidy.samples is samples
    assert tidy.notes == ()


def test_late_samples_are_sorted_and_counted():
    samples = rows([0.0, 0.02, 0.005, 0.01, 0.03])
    tidy = tidied(samples)
    assert tidy.n_late == 2
    assert np.array_equal(tidy.samples, samples[[0, 2, 3, 1, 4]])
    assert tidy.notes == ("2 inertial samples were not in order of time and were sorted",)


def test_of_repeated_times_the_first_sample_is_kept():
    samples = rows([0.0, 0.005, 0.005, 0.01])
    tidy = tidied(samples)
    assert np.array_equal(tidy.samples, samples[[0, 1, 3]])
    assert tidy.notes == ("1 inertial sample was at the time of another and was left out",)


def test_samples_that_are_not_finite_are_left_out():
    samples = rows([0.0, 0.005, np.nan, 0.01])
    samples[1, 4] = np.inf
    tidy = tidied(samples)
    assert np.array_equal(tidy.samples, samples[[0, 3]])
    assert (tidy.n_invalid, tidy.n_late, tidy.n_repeated) == (2, 0, 0)


@pytest.mark.parametrize("nothing", [[], np.empty((0, 7)), ()])
def test_no_samples_are_fine(nothing):
    assert tidied(nothing).samples.shape == (0, 7)


@pytest.mark.parametrize("shape", [(7,), (3, 6), (3, 8), (2, 3, 7)])
def test_another_shape_is_refused_with_what_is_expected(shape):
    with pytest.raises(ValueError, match=r"instead of \(N, 7\): seconds, angular rate"):
        tidied(np.ones(shape))


def test_the_offset_is_that_of_kalibr():
    """Kalibr: the time of the IMU is the time of the camera plus the shift."""
    at_camera = in_camera_time(rows([10.0]), time_offset=0.25)
    assert at_camera[0, 0] == 9.75


@pytest.mark.parametrize("name", ["gyro", "accel", "gyro_walk", "accel_walk"])
@pytest.mark.parametrize("value", [0.0, -1e-3, float("nan"), float("inf")])
def test_a_density_that_is_not_positive_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is"):
        ImuNoise(**{name: value})


def test_a_rigid_motion_with_the_digits_of_a_file_is_accepted_and_made_exact():
    T = se3_exp(np.array([0.1, -0.2, 0.3, 0.4, 1.0, -2.0]))
    calibration = ImuCalibration(np.round(T, 4))
    R = calibration.T_imu_camera[:3, :3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert np.allclose(calibration.T_imu_camera, T, atol=1e-4)
    assert np.allclose(calibration.T_imu_camera @ inverse(T), np.eye(4), atol=2e-4)


def test_the_matrix_of_the_caller_is_neither_changed_nor_shared():
    T = np.eye(4)
    calibration = ImuCalibration(T)
    T[0, 3] = 5.0
    assert calibration.T_imu_camera[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        calibration.T_imu_camera[0, 3] = 1.0


@pytest.mark.parametrize(
    "T",
    [
        np.zeros((4, 4)),  # what the memory of an OAK camera holds without a calibration
        np.diag([1.0, 1.0, -1.0, 1.0]),
        2.0 * np.eye(4),
        np.eye(3),
        np.full((4, 4), np.nan),
        np.eye(4) + np.outer([0, 0, 0, 1.0], [0.1, 0, 0, 0]),
    ],
)
def test_what_is_not_a_rigid_motion_is_refused(T):
    with pytest.raises(ValueError, match="T_imu_camera"):
        ImuCalibration(T)
