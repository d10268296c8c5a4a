"""Rendered motions in six degrees of freedom, and the samples of an IMU that was with them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from inertial import ADIS16448
from typer.testing import CliRunner

from vslam.backend.preintegration import preintegrate, so3_log
from vslam.cli.console import Console
from vslam.cli.drive import _open
from vslam.cli.main import every_command
from vslam.datasets import open_sequence
from vslam.datasets.kitti import open_kitti
from vslam.run.imu import usable_imu
from vslam.run.options import RunOptions
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.geometry import inverse
from vslam.types.imu import GRAVITY
from vslam_lab.towns import has_imu, motions, parse_drive
from vslam_lab.towns.inertial import (
    SAMPLE_RATE,
    imu_on_camera,
    samples_along,
    simulated_imu,
    with_noise,
)
from vslam_lab.towns.motions import MOTIONS, built_in_motion
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.rooms import SIZES, build_room
from vslam_lab.towns.routes import built_in_route
from vslam_lab.towns.site import Variation

T_IMU_CAMERA = imu_on_camera().T_imu_camera
DOWN = np.array([0.0, GRAVITY, 0.0])
SMALL = Camera(160.0, 160.0, 127.5, 95.5, 0.11, 256, 192)


@pytest.mark.parametrize("name", [*MOTIONS, "demo"])
def test_the_samples_lead_from_each_pose_to_the_later_ones(name):
    route = built_in_route(name) if name == "demo" else built_in_motion(name, 3)
    times, last = route.timestamps, len(route.T_wc) - 1
    # At a high rate, the midpoint rule is exact enough to see an error of the samples.
    samples = samples_along(times, route.T_wc, T_IMU_CAMERA, 4000.0)
    T_w_imu = route.T_wc @ inverse(T_IMU_CAMERA)
    seconds = round(route.rate)
    for k in (0, last // 3, last - 2 * seconds):
        middle, end = k + seconds, k + 2 * seconds
        first = preintegrate(samples, times[k], times[middle], ADIS16448)
        whole = preintegrate(samples, times[k], times[end], ADIS16448)
        R, p = T_w_imu[k, :3, :3], T_w_imu[[k, middle, end], :3, 3]
        turned = so3_log(whole.rotation.T @ R.T @ T_w_imu[end, :3, :3])
        assert np.linalg.norm(turned) < 1e-4
        # p(t) = p + v t + g t^2 / 2 + R moved(t): the velocity from one second, the check by two.
        velocity = p[1] - p[0] - 0.5 * DOWN - R @ first.position
        at_end = p[0] + 2.0 * velocity + 2.0 * DOWN + R @ whole.position
        assert np.linalg.norm(at_end - p[2]) < 1e-3


def test_a_standing_start_stands():
    route = built_in_motion("hall", 1)
    samples = samples_along(route.timestamps, route.T_wc, T_IMU_CAMERA)
    rest = samples[samples[:, 0] < 1.5]
    np.testing.assert_allclose(rest[:, 1:4], 0.0, atol=1e-4)
    up = -T_IMU_CAMERA[:3, :3] @ route.T_wc[0, :3, :3].T @ DOWN
    np.testing.assert_allclose(rest[:, 4:], np.tile(up, (len(rest), 1)), atol=2e-3)
    assert np.linalg.norm(route.T_wc[100, :3, 3] - route.T_wc[0, :3, 3]) > 0.5


def test_the_noise_has_the_densities_of_the_data_sheet():
    rest = np.zeros((200_000, 7))
    rest[:, 0] = np.arange(len(rest)) / SAMPLE_RATE
    noisy = with_noise(rest, ADIS16448, 4)[:, 1:]
    white = np.std(np.diff(noisy, axis=0), axis=0) / np.sqrt(2.0 * SAMPLE_RATE)
    np.testing.assert_allclose(white, np.repeat([ADIS16448.gyro, ADIS16448.accel], 3), rtol=0.02)
    walked = noisy[-20_000:].mean(axis=0) - noisy[:20_000].mean(axis=0)  # 900 s apart
    expected = np.repeat([ADIS16448.gyro_walk, ADIS16448.accel_walk], 3) * np.sqrt(900.0)
    assert (np.abs(walked) < 3.5 * expected).all()
    assert np.sqrt(np.mean((walked / expected) ** 2)) > 0.3
    assert not np.array_equal(noisy, with_noise(rest, ADIS16448, 5)[:, 1:])


@pytest.mark.parametrize("land", SIZES)
def test_a_camera_in_a_room_sees_walls_all_around_and_nothing_near(land):
    variation = Variation(seed=2)
    route = replace(built_in_motion(land, 2), camera=SMALL)
    town = build_room(land, variation)
    renderer = Renderer(SMALL, town.atlas, town.sky)
    moment = Passes(route, town, variation).at(0)
    for T_wc in route.T_wc[::80]:
        (view,) = renderer.views(moment, T_wc)
        assert view.depth.min() > 0.3
        assert view.depth.max() < np.linalg.norm(SIZES[land])
        assert view.image.std() > 12.0
    renderer.close()


def test_pitching_blurs_rows_and_turning_blurs_columns():
    dot = np.zeros((192, 256), np.float32)
    dot[96, 128] = 2e4

    def spread(yaw_rate, pitch_rate):
        image = sensor_image(dot, SMALL, yaw_rate=yaw_rate, pitch_rate=pitch_rate, night=0.0,
                             key=(0, 0, 0)).astype(float)  # fmt: skip
        image[image < 20.0] = 0.0
        rows, columns = np.mgrid[0:192, 0:256]
        weight = image / image.sum()
        return [
            float((weight * a * b).sum())
            for a, b in (
                (columns - 128, columns - 128), (rows - 96, rows - 96), (columns - 128, rows - 96)
            )
        ]  # fmt: skip

    still, yawing, pitching = spread(0.0, 0.0), spread(8.0, 0.0), spread(0.0, 8.0)
    assert yawing[0] > still[0] + 1.0
    assert abs(yawing[1] - still[1]) < 0.2
    assert pitching[1] > still[1] + 1.0
    assert abs(pitching[0] - still[0]) < 0.2
    assert spread(6.0, 6.0)[2] > 0.5
    assert spread(-6.0, 6.0)[2] < -0.5


def test_a_name_may_ask_for_the_imu():
    assert parse_drive("hall+imu+seed:4") == ("hall", Variation(4))
    assert has_imu("hall+imu+seed:4")
    assert not has_imu("hall+seed:4")
    with pytest.raises(InputError, match=r"choose one of demo, .*, room, hall"):
        open_sequence("synthetic", None, "rom+imu")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(motions, "_WIDTH", 128)
    monkeypatch.setattr(motions, "_HEIGHT", 96)
    return tmp_path / "synthetic"


def test_synth_writes_the_samples_beside_the_images_and_a_run_finds_them(cache):
    words = ["synth", "room", "--imu", "--seed", "3", "--max-frames", "2", "--quiet"]
    done = CliRunner().invoke(every_command(), words)
    assert done.exit_code == 0, done.output
    (root,) = cache.iterdir()
    source = open_kitti(root, "room", max_frames=2)
    imu, notes = usable_imu(source)
    assert notes == []
    assert imu.calibration.noise == ADIS16448
    np.testing.assert_allclose(imu.calibration.T_imu_camera, T_IMU_CAMERA, atol=1e-12)
    expected = simulated_imu(built_in_motion("room", 3), 3).read()
    np.testing.assert_allclose(imu.recorded.samples, expected, atol=1e-6)
    calibrated = open_kitti(
        root, "room", max_frames=2, calib=[root / "sequences/room/calibration.yaml"]
    )
    np.testing.assert_allclose(calibrated.imu.calibration.T_imu_camera, T_IMU_CAMERA, atol=1e-9)

    by_name = open_sequence("synthetic", None, "room+seed:3+imu", max_frames=2)
    np.testing.assert_array_equal(by_name.imu.recorded.samples, expected)
    assert open_sequence("synthetic", None, "room+seed:3", max_frames=2).imu is None


@pytest.mark.parametrize("other", ["--fisheye", "--rgbd", "--pairs=2"])
def test_other_layouts_have_no_imu(other, tmp_path):
    words = ["synth", "room", "--imu", other, "--out", str(tmp_path / "out")]
    assert "--imu: leave out" in str(CliRunner().invoke(every_command(), words).exception)


def test_a_run_gets_the_perturbed_samples(cache):
    options = RunOptions(
        dataset="synthetic", seq="room+imu", max_frames=2, perturb="imu-delay:30", seed=0
    )
    source, _ = _open(options, Console(shown=False), SimpleNamespace(start=lambda: None))
    expected = simulated_imu(built_in_motion("room", 0), 0).read()
    np.testing.assert_allclose(source.imu.recorded.samples[:, 0], expected[:, 0] + 0.03)
