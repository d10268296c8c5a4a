"""The inertial factor against differences and GTSAM, and bundle adjustment with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from tests.inertial import ADIS16448, DOWN, EUROC, Flight, Recording, recording
from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.inertial_adjustment import (
    InertialChain,
    adjust_with_imu,
    chain_of,
    linear_factors,
    start_values,
)
from vslam.backend.inertial_factor import InertialLinks, Motions, inertial_factor
from vslam.backend.inertial_filter import noise_in_motion
from vslam.backend.inertial_links import GRAVITY_SIGMA
from vslam.backend.inertial_start import ACCEL_BIAS, GYRO_BIAS
from vslam.backend.keyframe_motions import motions_between, record_motion
from vslam.backend.metric_mapping import MapScale, scale_of_problem
from vslam.backend.preintegration import preintegrate, so3_exp, so3_log
from vslam.types.camera import Camera
from vslam.types.features import Features
from vslam.types.geometry import inverse, se3_exp, transform
from vslam.types.imu import InertialState, InertialWindow
from vslam.types.map import Map

CAMERA = Camera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
T_IC = np.eye(4)
T_IC[:3, :3] = so3_exp(np.array([0.3, -1.2, 0.7]))
T_IC[:3, 3] = 0.1, -0.05, 0.2
BIAS = np.array([0.01, -0.02, 0.015, 0.1, -0.05, 0.08])
FLIGHT = Flight(seed=3)
SIGMAS = np.repeat([0.0, 0.0, 0.0, 0.05, 0.01, 0.1], 3)  # of the filter's state


@dataclass(frozen=True)
class Shifted:
    """A recording that begins later."""

    recording: Recording
    start: float

    def pose(self, t: float) -> np.ndarray:
        return self.recording.pose(self.start + t)


def camera_at(t: float, flight: Flight | Shifted = FLIGHT) -> np.ndarray:
    """Return ``T_cw`` of the camera of the flight."""
    return inverse(flight.pose(t) @ T_IC)


def samples(noise=None, seed: int = 0, rate: float = 200.0, flight: Flight = FLIGHT) -> np.ndarray:
    return flight.samples(np.arange(-0.1, 4.0, 1.0 / rate), BIAS, noise, seed)


def window(rows: np.ndarray, **changes) -> InertialWindow:
    state = InertialState(0.0, np.eye(4), np.zeros(3), DOWN, BIAS, np.diag(SIGMAS**2))
    given = {one: changes.pop(one) for one in ("gravity", "bias", "covariance") if one in changes}
    state = replace(state, **given)
    found = InertialWindow(rows, state, np.eye(3), T_IC, ADIS16448, 0.1)
    return replace(found, **changes)


def factor(x: np.ndarray, motion) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate a factor at increments ``x`` of poses, states and gravity."""
    states = [np.r_[FLIGHT.velocity(t), BIAS + 0.01] for t in (1.0, 1.4)]
    return inertial_factor(
        motion,
        se3_exp(x[:6]) @ se3_exp(np.full(6, 0.02)) @ camera_at(1.0),
        se3_exp(x[6:12]) @ camera_at(1.4),
        states[0] + x[12:21],
        states[1] + x[21:30],
        DOWN + x[30:],
        T_IC,
    )


def test_the_residuals_are_zero_at_the_truth():
    motion = preintegrate(samples(rate=2000.0), 1.0, 1.4, ADIS16448, BIAS)
    states = [np.r_[FLIGHT.velocity(t), BIAS] for t in (1.0, 1.4)]
    r, _ = inertial_factor(motion, camera_at(1.0), camera_at(1.4), *states, DOWN, T_IC)
    np.testing.assert_allclose(r, 0.0, atol=1e-6)


def test_the_derivatives_are_those_of_differences():
    motion = preintegrate(samples(), 1.0, 1.4, ADIS16448, BIAS)
    _, J = factor(np.zeros(33), motion)
    step = 1e-6 * np.eye(33)
    differences = [(factor(e, motion)[0] - factor(-e, motion)[0]) / 2e-6 for e in step]
    np.testing.assert_allclose(J, np.transpose(differences), atol=1e-6)


def test_the_cost_is_gtsams():
    """GTSAM holds each sample until the next one, so that many samples are needed to compare."""
    rows = samples(rate=20_000.0)
    inside = rows[(rows[:, 0] >= 1.0 - 1e-9) & (rows[:, 0] < 1.4 - 1e-9)]
    params = gtsam.PreintegrationParams(DOWN)
    params.setGyroscopeCovariance(np.eye(3) * ADIS16448.gyro**2)
    params.setAccelerometerCovariance(np.eye(3) * ADIS16448.accel**2)
    params.setIntegrationCovariance(1e-16 * np.eye(3))
    bias = gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3])
    theirs = gtsam.PreintegratedImuMeasurements(params, bias)
    for row in inside:
        theirs.integrateMeasurement(row[4:], row[1:4], 1.0 / 20_000.0)
    values = gtsam.Values()
    T = [se3_exp(np.full(6, 0.002)) @ camera_at(1.0), camera_at(1.4)]
    v = [FLIGHT.velocity(1.0) + 0.01, FLIGHT.velocity(1.4)]
    for k in range(2):
        values.insert(k, gtsam.Pose3(inverse(T[k]) @ inverse(T_IC)))
        values.insert(2 + k, v[k])
    values.insert(4, bias)
    expected = gtsam.ImuFactor(0, 2, 1, 3, 4, theirs).error(values)
    motion = preintegrate(rows, 1.0, 1.4, ADIS16448, BIAS)
    r, _ = inertial_factor(motion, *T, np.r_[v[0], BIAS], np.r_[v[1], BIAS], DOWN, T_IC)
    ours = 0.5 * r[:9] @ np.linalg.inv(motion.covariance) @ r[:9]
    assert ours == pytest.approx(expected, rel=2e-3)
    assert expected > 100.0


def scene(
    seed: int, n: int = 8, step: float = 0.3, sigma: float = 1.0, flight: Flight | Shifted = FLIGHT
) -> tuple[BundleProblem, np.ndarray, np.ndarray]:
    """Make a bundle problem of a few points far away. The first keyframe is held fixed.

    Returns:
        The problem, the true poses, and the times of the keyframes, both in the order of time. The
        fixed keyframe is the last camera of the problem.
    """
    rng = np.random.default_rng(seed)
    times = 0.5 + step * np.arange(n)
    truth = np.array([camera_at(t, flight) for t in times])
    order = np.r_[1:n, 0]
    points, uvr, camera, first = [], [], [], [0]
    while len(points) < 60:
        k = rng.integers(n)
        near = np.array([rng.uniform(-4, 4), rng.uniform(-3, 3), rng.uniform(4, 12)])
        point = transform(inverse(truth[k]), near[None])[0]
        seen = []
        for place, one in enumerate(order):
            q = transform(truth[one], point[None])[0]
            if q[2] < 1.0:
                continue
            u = CAMERA.project(q[None])[0]
            if 0 < u[0] < 640 and 0 < u[1] < 480:
                seen.append((place, u + sigma * rng.standard_normal(3)))
        if len(seen) < 2:
            continue
        points.append(point + 0.02 * rng.standard_normal(3))
        camera += [place for place, _ in seen]
        uvr += [u for _, u in seen]
        first.append(len(camera))
    poses = [se3_exp(0.01 * rng.standard_normal(6)) @ T for T in truth[order]]
    poses[-1] = truth[0]
    problem = BundleProblem(
        np.array(poses),
        n - 1,
        np.array(points),
        np.array(first),
        np.array(camera),
        np.array(uvr),
        np.full(len(camera), sigma**-2.0),
        CAMERA.intrinsics,
    )
    return problem, truth[order], times


def motions_at(times: np.ndarray, found: InertialWindow) -> Motions:
    """Return the motions between keyframes at given times, as a map keeps them."""
    map_ = Map(np.array([1.0, 1.2]))
    for time in times:
        map_.add_keyframe(Features.none(), np.eye(4), time, 0)
    for keyframe in range(1, len(times)):
        record_motion(map_, keyframe, found)
    return motions_between(map_, np.arange(len(times)))


def chain(problem: BundleProblem, times: np.ndarray, found: InertialWindow) -> InertialChain:
    n = problem.n_free
    made = chain_of(found, motions_at(times, found), np.r_[n, 0:n], np.eye(3))
    assert made is not None
    return made


def errors(T_cw: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the RMS errors of position (m) and rotation (rad)."""
    moved = [inverse(a) @ b for a, b in zip(T_cw, truth, strict=True)]
    turns = [so3_log(T[:3, :3]) for T in moved]
    return np.array(
        [np.sqrt(np.mean(np.square(x)) * 3) for x in ([T[:3, 3] for T in moved], turns)]
    )


@pytest.mark.parametrize("n_free", [0, 4, 7])
def test_the_gradient_of_the_factors_is_that_of_their_cost(n_free):
    problem, _, times = scene(0)
    made = chain(problem, times, window(samples(ADIS16448)))
    inertial = start_values(problem.T_cw, made)
    rng = np.random.default_rng(1)
    inertial = inertial + 0.01 * rng.standard_normal(len(inertial))
    found = linear_factors(problem.T_cw, inertial, made, n_free)

    def cost(x: np.ndarray) -> float:
        T_cw = problem.T_cw.copy()
        for k in range(n_free):
            T_cw[k] = se3_exp(x[6 * k : 6 * k + 6]) @ T_cw[k]
        return linear_factors(T_cw, inertial + x[6 * n_free :], made, n_free).cost

    step = 1e-6 * np.eye(len(found.gradient))
    differences = [-(cost(e) - cost(-e)) / 2e-6 for e in step]
    np.testing.assert_allclose(
        found.gradient, differences, rtol=1e-4, atol=1e-6 * np.abs(differences).max()
    )


def test_poses_are_better_with_samples():
    """Five random scenes. The observations are as uncertain as in fast motion."""
    alone, together = [], []
    for seed in range(5):
        problem, truth, times = scene(seed)
        found = window(samples(ADIS16448, seed), bias=BIAS + 0.002)
        solution = adjust_with_imu(problem, chain(problem, times, found), iterations=20)
        assert solution is not None
        alone.append(errors(adjust(problem, iterations=20).T_cw, truth))
        together.append(errors(solution.T_cw, truth))
    assert (np.array(together) < np.array(alone)).all()
    assert (np.mean(together, axis=0) < 0.8 * np.mean(alone, axis=0)).all()


def test_weights_do_not_change_whether_samples_and_images_agree():
    problem, _, times = scene(0)
    made = chain(problem, times, window(samples(ADIS16448)))
    weighed = made.weighed(3.0, 0.25)
    inertial = start_values(problem.T_cw, made)
    before, after = (
        linear_factors(problem.T_cw, inertial, one, problem.n_free) for one in (made, weighed)
    )
    assert after.misfit == pytest.approx(before.misfit)
    walks, motions = (made.motions.information, weighed.motions.information)
    np.testing.assert_allclose(motions[:, :9, :9], 9.0 * 0.25 * walks[:, :9, :9])
    np.testing.assert_allclose(motions[:, 9:, 9:], 0.25 * walks[:, 9:, 9:])
    np.testing.assert_allclose(weighed.information, 0.25 * made.information)


def of_one_camera(seed: int, flight: Flight) -> tuple[float, MapScale]:
    """Find the scale of a scene whose observations err less than expected, and whose samples were
    integrated with more noise than they have. Return the true one, too."""
    problem, truth, times = scene(seed, n=10, flight=flight)
    rng = np.random.default_rng([seed, 1])
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    exact = [
        CAMERA.project(transform(truth[c], p[None]))[0]
        for c, p in zip(problem.camera, problem.points[point], strict=True)
    ]
    uvr = np.array(exact) + 0.5 * rng.standard_normal((len(point), 3))
    uvr[:, 2] = np.nan
    T_cw = np.array([se3_exp(0.002 * rng.standard_normal(6)) @ T for T in truth])
    T_cw[-1] = truth[-1]
    centre, fixed = inverse(truth[-1])[:3, 3], 0.9
    for T in T_cw[:-1]:
        c = centre + fixed * (inverse(T)[:3, 3] - centre)
        T[:3, 3] = -T[:3, :3] @ c
    points = centre + fixed * (problem.points - centre)
    problem = replace(problem, T_cw=T_cw, points=points, uvr=uvr)
    seen = adjust(problem, iterations=30)
    problem, T_cw = replace(problem, T_cw=seen.T_cw, points=seen.points), seen.T_cw
    enlarged = replace(ADIS16448, gyro=3.0 * ADIS16448.gyro, accel=3.0 * ADIS16448.accel)
    rows = samples(ADIS16448, seed, flight=flight)
    unsure = np.diag(np.repeat([0.0, 0.0, 0.0, 0.5, 0.05, 0.2], 3) ** 2)
    found = window(rows, noise=enlarged, covariance=unsure, bias=BIAS + 0.01)
    solved = scale_of_problem(problem, chain(problem, times, found), 3.0)
    assert solved is not None
    spread = [np.std([inverse(T)[:3, 3] for T in poses], axis=0) for poses in (T_cw, truth)]
    before, after = np.linalg.norm(spread, axis=1)
    return after / before, solved


def test_the_scale_errs_as_its_standard_deviation_tells(monkeypatch):
    """Twenty scenes without drift: the squared errors are those of 20 normal numbers, at 98 %."""
    monkeypatch.setattr("vslam.backend.metric_mapping._DRIFT", 0.0)
    errors = []
    for seed in range(20):
        true, found = of_one_camera(seed, FLIGHT)
        errors.append(np.log(found.scale / true) / found.sigma)
        assert found.sigma < 0.02
    assert 0.41 < np.mean(np.square(errors)) < 1.88


def test_the_scale_is_less_certain_while_the_camera_approaches_the_scene():
    """The images of a camera that comes nearer to the scene drift in scale."""

    @dataclass(frozen=True)
    class Onwards(Flight):
        along: float = 0.0

        def position(self, t) -> np.ndarray:
            ahead = (self.rotation(1.0) @ T_IC[:3, :3])[:, 2]
            return super().position(t) + self.along * np.asarray(t, float)[..., None] * ahead

        def velocity(self, t) -> np.ndarray:
            ahead = (self.rotation(1.0) @ T_IC[:3, :3])[:, 2]
            return super().velocity(t) + self.along * ahead

    still, onwards = (
        of_one_camera(0, Onwards(3, turning=0.05, along=along))[1] for along in (0.0, 2.0)
    )
    assert onwards.sigma > 1.2 * still.sigma


def test_samples_that_contradict_the_images_are_not_used():
    problem, _, times = scene(0)
    rows = samples(ADIS16448)
    for wrong in (
        window(np.c_[rows[:, :1], np.degrees(rows[:, 1:4]), rows[:, 4:]]),
        window(rows, T_imu_camera=inverse(T_IC)),
        window(rows, gravity=-DOWN),
    ):
        assert adjust_with_imu(problem, chain(problem, times, wrong), iterations=20) is None


def test_a_chain_begins_after_the_last_gap():
    rows = FLIGHT.samples(np.arange(-0.1, 7.0, 0.005), BIAS)
    times = 0.5 + 0.3 * np.arange(8)

    def chained(rows: np.ndarray, times: np.ndarray) -> list[int] | None:
        found = window(rows)
        made = chain_of(found, motions_at(times, found), np.arange(8), np.eye(3))
        return None if made is None else made.camera.tolist()

    assert chained(rows, times) == [*range(8)]
    gap = (rows[:, 0] > 1.2) & (rows[:, 0] < 1.35)
    assert chained(rows[~gap], times) == [*range(3, 8)]
    late = times + np.where(np.arange(8) > 5, 3.4, 0.0)
    assert chained(rows, late) == [6, 7]
    assert chained(rows[rows[:, 0] > 1.0], times) == [*range(2, 8)]
    assert chained(rows[:0], times) is None


def test_the_state_of_the_filter_is_turned_into_the_world():
    """The window is the same after the odometry and the world were turned apart."""
    times, R = 0.5 + 0.3 * np.arange(3), so3_exp(np.array([0.4, 1.0, -2.0]))
    sigmas = np.diag([1.0, 2.0, 3.0])
    given, covariance = window(samples()), np.diag(SIGMAS**2)
    covariance[9:12, 9:12] = R @ sigmas @ R.T
    state = replace(given.state, gravity=R @ DOWN, covariance=covariance)
    turned = replace(given, state=state, R_odom_camera=R)
    made = chain_of(turned, motions_at(times, given), np.arange(3), np.eye(3))
    assert made is not None
    np.testing.assert_allclose(made.gravity, DOWN, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(made.information)[:3, :3], sigmas, atol=1e-12)


def test_motions_around_a_culled_keyframe_are_one():
    """The result is the motion that would have been integrated without the keyframe."""
    times, found = 0.5 + 0.3 * np.arange(4), window(samples(ADIS16448))
    map_ = Map(np.array([1.0, 1.2]))
    for keyframe, time in enumerate(times):
        map_.add_keyframe(Features.none(), np.eye(4), time, 0)
        state = replace(found.state, bias=BIAS + 0.003 * keyframe)
        record_motion(map_, keyframe, replace(found, state=state))
    kept = motions_between(map_, np.array([0, 2, 3]))
    direct = motions_at(times[[0, 2, 3]], window(samples(ADIS16448), bias=BIAS + 0.006))
    assert kept.bias[0].tolist() == (BIAS + 0.006).tolist()
    np.testing.assert_allclose(kept.seconds, [0.6, 0.3])
    np.testing.assert_allclose(kept.rotation[0], direct.rotation[0], atol=1e-5)
    np.testing.assert_allclose(kept.velocity[0], direct.velocity[0], atol=1e-4)
    np.testing.assert_allclose(kept.position[0], direct.position[0], atol=1e-4)
    np.testing.assert_allclose(kept.by_bias[0], direct.by_bias[0], atol=2e-3)
    sigmas = [np.sqrt(np.diag(np.linalg.inv(m.information[0]))) for m in (kept, direct)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.02)
    map_.keyframes.motion_seconds[1] = 0.0
    assert motions_between(map_, np.array([0, 2, 3])).seconds.tolist() == [0.0, kept.seconds[1]]


def test_a_motion_may_lie_between_two_samples():
    """An IMU that is as slow as the camera has no sample between two keyframes."""
    found = window(samples(rate=5.0), longest_gap=1.0)
    made = motions_at(np.array([0.52, 0.58]), found)
    assert (np.linalg.eigvalsh(made.information[0]) > 0.0).all()


def linked(problem: BundleProblem, times: np.ndarray, found: InertialWindow) -> BundleProblem:
    """Connect all keyframes of a scene by the motions of the IMU."""
    ends, n = np.r_[len(times) - 1, 0 : len(times) - 1], len(times)
    links = InertialLinks(ends[:-1], ends[1:], motions_at(times, found), found.state.gravity)
    down, sigma = np.tile([0.0, 1.0, 0.0], (n, 1)), np.full(n, 0.001)  # not used, and wrong
    return replace(problem, links=links, gravity=down, gravity_sigma=sigma)


@pytest.mark.parametrize("n_free", [5, 7])
def test_global_and_local_bundle_adjustment_have_the_same_optimum(n_free):
    problem, truth, times = scene(2)
    T_cw = np.concatenate([problem.T_cw[:n_free], truth[n_free:]])
    problem = replace(problem, n_free=n_free, T_cw=T_cw)
    found = window(samples(ADIS16448))  # both converge sooner if the samples weigh less
    noise = replace(ADIS16448, gyro=10.0 * ADIS16448.gyro, accel=10.0 * ADIS16448.accel)
    found = replace(found, noise=noise)
    together = linked(problem, times, found)
    made = chain_of(found, motions_at(times, found), np.r_[7, 0:7], np.eye(3))
    up = DOWN / np.linalg.norm(DOWN) / GRAVITY_SIGMA
    prior = np.diag(np.repeat([0.0, GYRO_BIAS**-2, ACCEL_BIAS**-2], 3))
    prior[:3, :3] = np.outer(up, up)
    dense = adjust_with_imu(
        problem, replace(made, information=prior), iterations=100, tolerance=1e-13
    )
    sparse = adjust_globally(together, iterations=100, tolerance=1e-13)
    np.testing.assert_allclose(sparse.T_cw, dense.T_cw, atol=2e-5)
    np.testing.assert_allclose(sparse.points, dense.points, atol=1e-3)
    alone = adjust_globally(replace(problem, links=None), iterations=100, tolerance=1e-13)
    assert np.abs(sparse.T_cw - alone.T_cw).max() > 1e-3


def test_global_bundle_adjustment_does_not_use_samples_that_contradict_the_images():
    problem, _, times = scene(0)
    rows = samples(ADIS16448)
    wrong = window(np.c_[rows[:, :1], np.degrees(rows[:, 1:4]), rows[:, 4:]])
    together = linked(problem, times, wrong)
    solution = adjust_globally(together, iterations=20)
    level = adjust_globally(replace(together, links=None), iterations=20)
    assert solution.T_cw.tobytes() == level.T_cw.tobytes()


@pytest.mark.skipif(not EUROC.is_dir(), reason="EuRoC's inertial data absent")
@pytest.mark.parametrize("fault", ["none", "late", "stretched"])
def test_real_samples_agree_with_images_and_wrong_ones_do_not(fault):
    """The samples of a fast flight, with simulated observations along its true poses."""
    flight, agreed = recording("V1_03"), []
    moving = flight.times[np.linalg.norm(flight.velocity, axis=1) > 0.3]
    for start in np.linspace(moving[0] + 1.0, moving[-1] - 6.0, 6):
        poses = Shifted(flight, start)
        problem, _, times = scene(int(start), sigma=0.4, flight=poses)
        rows = flight.samples - np.r_[start, np.zeros(6)]
        rows = rows[np.abs(rows[:, 0]) < 5.0]
        if fault == "late":
            rows[:, 0] += 0.015
        if fault == "stretched":
            rows[:, 1:] *= 1.05
        bias = flight.bias[np.searchsorted(flight.times, start)]
        noise = noise_in_motion(ADIS16448, rows[rows[:, 0] < 2.0])
        made = chain(problem, times, window(rows, noise=noise, bias=bias))
        agreed.append(adjust_with_imu(problem, made, iterations=30) is not None)
    assert all(agreed) if fault == "none" else not any(agreed)
