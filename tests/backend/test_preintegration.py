"""Preintegration against physics, against GTSAM, and against the truth of EuRoC."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from inertial import ADIS16448, DOWN, EUROC, Flight, recording

from vslam.backend.preintegration import (
    Preintegration,
    preintegrate,
    right_jacobian,
    so3_exp,
    so3_log,
)
from vslam.types.imu import ImuNoise

NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
RATE = np.array([0.3, -0.5, 0.8])


def constant(rate, force, seconds: float = 1.0, step: float = 0.005) -> np.ndarray:
    times = np.arange(0.0, seconds + step / 2, step)
    return np.column_stack([times, np.tile(np.r_[rate, force], (len(times), 1))])


def free_motion(pre: Preintegration, R, v, p, gravity=DOWN):
    """Return orientation, velocity and position at the end."""
    t = pre.seconds
    return (
        R @ pre.rotation,
        v + gravity * t + R @ pre.velocity,
        p + v * t + 0.5 * gravity * t * t + R @ pre.position,
    )


def difference(one: Preintegration, other: Preintegration) -> np.ndarray:
    """Return the ``(9,)`` errors of ``other`` relative to ``one``."""
    turn = so3_log(one.rotation.T @ other.rotation)
    return np.r_[turn, other.velocity - one.velocity, other.position - one.position]


def test_at_rest_gravity_cancels():
    R = so3_exp(np.array([0.4, -1.0, 0.2]))
    pre = preintegrate(constant(np.zeros(3), R.T @ -DOWN), 0.0, 1.0, NOISE)
    R_end, v, p = free_motion(pre, R, np.zeros(3), np.zeros(3))
    assert np.allclose(R_end, R, atol=1e-15)
    assert np.abs(v).max() < 1e-13
    assert np.abs(p).max() < 1e-13


def test_a_constant_turn_is_the_exponential_of_rate_times_time():
    pre = preintegrate(constant(RATE, np.zeros(3)), 0.0, 0.7, NOISE)
    assert np.allclose(pre.rotation, so3_exp(RATE * 0.7), atol=1e-14)
    assert pre.seconds == 0.7


def test_a_constant_force_without_turning_is_a_parabola():
    force = np.array([1.0, -2.0, 3.0])
    pre = preintegrate(constant(np.zeros(3), force), 0.1, 0.9, NOISE)
    assert np.allclose(pre.velocity, 0.8 * force, atol=1e-14)
    assert np.allclose(pre.position, 0.5 * 0.8**2 * force, atol=1e-14)


def test_a_bias_is_subtracted():
    bias = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
    sound = constant(RATE, np.array([1.0, 2.0, 9.0]))
    wrong = sound.copy()
    wrong[:, 1:] += bias
    one, other = preintegrate(sound, 0.0, 1.0, NOISE), preintegrate(wrong, 0.0, 1.0, NOISE, bias)
    assert np.abs(difference(one, other)).max() < 1e-13


def test_the_ends_are_interpolated_so_that_parts_compose_to_the_whole():
    samples = Flight(1).samples(np.arange(0.0, 1.01, 0.005))
    middle = 0.41234  # between two samples
    whole = preintegrate(samples, 0.1013, 0.8871, NOISE)
    first = preintegrate(samples, 0.1013, middle, NOISE)
    both = first.followed_by(preintegrate(samples, middle, 0.8871, NOISE))
    assert both.seconds == pytest.approx(whole.seconds)
    assert np.abs(so3_log(whole.rotation.T @ both.rotation)).max() < 1e-7
    assert np.abs(whole.velocity - both.velocity).max() < 2e-6
    assert np.abs(whole.position - both.position).max() < 2e-6
    assert np.allclose(both.by_bias, whole.by_bias, atol=1e-5)
    assert np.allclose(both.covariance, whole.covariance, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_a_known_motion_is_followed_exactly(seed):
    """The error is that of the midpoint rule: it falls with the square of the step."""
    flight, errors = Flight(seed), []
    for step in (0.005, 0.0025):
        samples = flight.samples(np.arange(0.0, 1.01, step))
        pre = preintegrate(samples, 0.2, 0.7, NOISE)
        R, v, p = free_motion(pre, flight.rotation(0.2), flight.velocity(0.2), flight.position(0.2))
        errors.append(
            [
                np.linalg.norm(so3_log(flight.rotation(0.7).T @ R)),
                np.linalg.norm(v - flight.velocity(0.7)),
                np.linalg.norm(p - flight.position(0.7)),
            ]
        )
    (turn, speed, place), finer = errors
    assert turn < 2e-5
    assert speed < 2e-4
    assert place < 1e-4
    assert np.all(np.array(finer) < 0.3 * np.array(errors[0]))


def test_no_time_is_no_motion():
    pre = preintegrate(constant(RATE, -DOWN), 0.3, 0.3, NOISE)
    assert np.array_equal(pre.rotation, np.eye(3))
    assert not pre.velocity.any()
    assert not pre.position.any()
    assert not pre.covariance.any()


@pytest.mark.parametrize(
    ("times", "start", "end", "gap"),
    [
        (np.arange(0.0, 1.0, 0.01), 0.2, 0.5, 0.01),
        ([0.0, 0.1, 0.15, 0.4, 0.41], 0.05, 0.2, 0.25),  # the gap reaches beyond the interval
        ([0.0, 0.1, 0.15, 0.4, 0.41], 0.0, 0.14, 0.1),
        ([0.5, 0.51, 0.52], 0.2, 0.52, 0.3),  # nothing at the start
        ([0.5, 0.51, 0.52], 0.5, 0.9, 0.38),  # nothing at the end
        ([0.1], 0.5, 0.9, 0.8),  # long before
        ([2.0], 0.5, 0.9, 1.5),  # long after
    ],
)
def test_gaps_are_known(times, start, end, gap):
    rows = np.column_stack([times, np.tile(np.r_[RATE, -DOWN], (len(times), 1))])
    pre = preintegrate(rows, start, end, NOISE)
    assert pre.longest_gap == pytest.approx(gap)
    assert np.allclose(pre.rotation, so3_exp(RATE * (end - start)), atol=1e-12)


def test_samples_outside_of_the_interval_do_not_matter():
    samples = Flight(2).samples(np.arange(0.0, 1.01, 0.005))
    changed = samples.copy()
    changed[samples[:, 0] < 0.29, 1:] = 1e3
    changed[samples[:, 0] > 0.61, 1:] = -1e3
    one, other = (preintegrate(s, 0.2999, 0.6001, NOISE) for s in (samples, changed))
    assert not difference(one, other).any()


def test_nothing_to_integrate_is_an_error():
    with pytest.raises(ValueError, match="no inertial samples"):
        preintegrate(np.empty((0, 7)), 0.0, 1.0, NOISE)
    with pytest.raises(ValueError, match="before it begins"):
        preintegrate(constant(RATE, DOWN), 1.0, 0.5, NOISE)


def test_derivatives_by_the_biases_are_those_of_differences():
    samples = Flight(3, turning=1.5).samples(np.arange(0.0, 1.01, 0.005))
    bias = np.array([0.01, -0.02, 0.03, 0.1, -0.05, 0.02])
    pre = preintegrate(samples, 0.1, 0.9, NOISE, bias)
    numeric, step = np.empty((9, 6)), 1e-5
    for i in range(6):
        ends = [
            preintegrate(samples, 0.1, 0.9, NOISE, bias + s * np.eye(6)[i]) for s in (-step, step)
        ]
        numeric[:, i] = (difference(pre, ends[1]) - difference(pre, ends[0])) / (2 * step)
    assert np.abs(numeric - pre.by_bias).max() < 1e-8

    near = bias + 1e-3
    exact = preintegrate(samples, 0.1, 0.9, NOISE, near)
    assert np.abs(difference(exact, pre.with_bias(near))).max() < 2e-6
    assert np.abs(difference(exact, pre)).max() > 5e-4


def test_the_covariance_is_that_of_repeated_noise():
    flight, times = Flight(4), np.arange(0.0, 1.01, 0.005)
    exact = preintegrate(flight.samples(times), 0.1, 0.9, NOISE)
    errors = np.array(
        [
            difference(exact, preintegrate(flight.samples(times, None, NOISE, s), 0.1, 0.9, NOISE))
            for s in range(400)
        ]
    )
    ratio = errors.var(axis=0) / np.diag(exact.covariance)
    assert np.all((ratio > 0.75) & (ratio < 1.3))  # 400 draws: 7 % standard deviation
    whitened = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(exact.covariance), errors)
    assert whitened.mean() == pytest.approx(9.0, rel=0.1)


def test_small_rotations_and_their_jacobians():
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.0, 3.0):
        w = rng.standard_normal(3)
        w *= size / np.linalg.norm(w)
        R = so3_exp(w)
        assert np.allclose(R.T @ R, np.eye(3), atol=1e-15)
        assert np.allclose(so3_log(R), w, atol=1e-12)
        d = 1e-6 * rng.standard_normal(3)
        change = so3_log(R.T @ so3_exp(w + d))
        assert np.allclose(change, right_jacobian(w) @ d, atol=1e-11)


def oracle(noise: ImuNoise) -> gtsam.PreintegrationParams:
    parameters = gtsam.PreintegrationParams.MakeSharedU(-DOWN[2])
    parameters.setGyroscopeCovariance(np.eye(3) * noise.gyro**2)
    parameters.setAccelerometerCovariance(np.eye(3) * noise.accel**2)
    parameters.setIntegrationCovariance(np.eye(3) * 1e-16)
    return parameters


def test_gtsam_predicts_the_same_on_a_helix():
    """A car that turns while it accelerates: GTSAM's scenario gives the samples and the truth."""
    scenario = gtsam.AcceleratingScenario(
        gtsam.Rot3.Rodrigues(0.1, -0.2, 1.0),
        np.array([1.0, 2.0, 3.0]),
        np.array([0.5, -1.0, 0.2]),
        np.array([0.3, 0.2, -0.1]),
        RATE,
    )
    runner = gtsam.ScenarioRunner(scenario, oracle(NOISE), 0.005, gtsam.imuBias.ConstantBias())
    times = np.arange(0.0, 1.01, 0.005)
    rows = np.array(
        [np.r_[t, runner.actualAngularVelocity(t), runner.actualSpecificForce(t)] for t in times]
    )
    pre = preintegrate(rows, 0.0, 1.0, NOISE)
    start, end = scenario.pose(0.0), scenario.pose(1.0)
    R, v, p = free_motion(
        pre, start.rotation().matrix(), scenario.velocity_n(0.0), start.translation()
    )
    assert np.abs(so3_log(end.rotation().matrix().T @ R)).max() < 1e-12
    assert np.abs(v - scenario.velocity_n(1.0)).max() < 1e-4
    assert np.abs(p - end.translation()).max() < 1e-4

    theirs = runner.integrate(1.0, gtsam.imuBias.ConstantBias(), False)
    covariance = theirs.preintMeasCov()  # rotation vector, position, velocity
    to_ours = np.zeros((9, 9))
    to_ours[:3, :3] = right_jacobian(RATE)
    to_ours[3:6, 6:] = to_ours[6:, 3:6] = np.eye(3)
    ratio = np.diag(pre.covariance) / np.diag(to_ours @ covariance @ to_ours.T)
    assert np.all(np.abs(ratio - 1.0) < 0.02)


def test_gtsam_integrates_the_same_samples_to_the_same_motion():
    """With steps of 0.1 ms, its other rule of integration makes no difference."""
    flight, step = Flight(5), 1e-4
    knots = flight.samples(np.arange(0.0, 0.2 + step / 2, step))
    bias = np.array([0.01, -0.02, 0.03, 0.1, -0.05, 0.02])
    theirs = gtsam.PreintegratedImuMeasurements(
        oracle(NOISE), gtsam.imuBias.ConstantBias(bias[3:], bias[:3])
    )
    for before, after in pairwise(knots):
        mean = 0.5 * (before + after)
        theirs.integrateMeasurement(mean[4:], mean[1:4], step)
    pre = preintegrate(knots, 0.0, knots[-1, 0], NOISE, bias)
    assert np.abs(so3_log(theirs.deltaRij().matrix().T @ pre.rotation)).max() < 1e-8
    assert np.abs(theirs.deltaVij() - pre.velocity).max() < 2e-4
    assert np.abs(theirs.deltaPij() - pre.position).max() < 2e-5


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC's inertial data absent")
@pytest.mark.parametrize(
    ("name", "seconds", "place", "degrees"),
    [
        ("V1_01", 0.5, 0.012, 0.12),
        ("V1_01", 1.0, 0.045, 0.2),
        ("V1_01", 2.0, 0.18, 0.35),
        ("V1_03", 0.5, 0.015, 0.12),
        ("V1_03", 1.0, 0.05, 0.2),
        ("V1_03", 2.0, 0.18, 0.35),
    ],
)
def test_real_flights_are_followed_from_true_states(name, seconds, place, degrees):
    """Medians over 60 starts in flight. Gravity of the truth's frame is 9.81 m/s^2 along -z."""
    flight = recording(name)
    moving = np.flatnonzero(np.linalg.norm(flight.velocity, axis=1) > 0.3)
    last = np.searchsorted(flight.times, flight.times[-1] - seconds - 1.0)
    starts = moving[moving < last]
    errors = []
    for k in starts[:: max(len(starts) // 60, 1)]:
        t = flight.times[k]
        pre = preintegrate(flight.samples, t, t + seconds, ADIS16448, flight.bias[k])
        R, _, p = free_motion(pre, flight.rotation[k], flight.velocity[k], flight.position[k])
        T = flight.pose(t + seconds)
        turn = np.degrees(np.linalg.norm(so3_log(T[:3, :3].T @ R)))
        errors.append((np.linalg.norm(p - T[:3, 3]), turn))
    metres, turned = np.median(errors, axis=0)
    assert metres < place
    assert turned < degrees
    assert len(errors) >= 60
