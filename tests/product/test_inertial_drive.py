"""A car that turns into an unseen street while it is dark, in a rendered town."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from inertial import ADIS16448

from vslam.datasets.kitti import open_kitti
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse, se3_log
from vslam.types.imu import ImuCalibration
from vslam_lab.towns.inertial import samples_along
from vslam_lab.towns.routes import built_in_route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import render_sequence

DARK = range(81, 101)  # 2 s, in which the car turns by 60 degrees
FRAMES = 112


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return the camera, the times, the images and the true poses of the first two corners."""
    route = built_in_route("block")
    one = route.camera
    centre = {"cx": (one.cx - 0.5) / 2, "cy": (one.cy - 0.5) / 2}
    half = replace(
        one, fx=one.fx / 2, fy=one.fy / 2, width=one.width // 2, height=one.height // 2, **centre
    )
    smaller = replace(route, camera=half, T_wc=route.T_wc[:FRAMES])
    folder = tmp_path_factory.mktemp("drive")
    sequence = open_kitti(render_sequence(smaller, Variation(seed=11), folder), "block")
    frames = list(sequence.frames())
    times = np.array([frame.timestamp for frame in frames])
    return half, times, [frame.read(map) for frame in frames], smaller.T_wc


@cache
def noise(n: int) -> np.ndarray:
    sigma = np.repeat([ADIS16448.gyro, ADIS16448.accel], 3) / np.sqrt(0.005)
    bias = np.array([0.01, -0.02, 0.05, 0.05, -0.1, 0.08])
    return bias + sigma * np.random.default_rng(0).standard_normal((n, 6))


def drive_through(drive, imu: ImuCalibration | None) -> tuple[Slam, list, np.ndarray]:
    camera: Camera = drive[0]
    _, times, images, T_wc = drive
    rows = samples_along(times, T_wc, np.eye(4))
    rows[:, 1:] += noise(len(rows))
    slam, results, before = Slam(camera, imu=imu, detector="none", threads=1), [], -1.0
    for k, (left, right) in enumerate(images):
        light = np.uint8(k not in DARK)
        new = rows[(rows[:, 0] > before) & (rows[:, 0] <= times[k])]
        before = times[k]
        results.append(slam.step(light * left, light * right, times[k], imu=new))
    slam.finish()
    truth = inverse(T_wc[0]) @ T_wc
    apart = [se3_log(inverse(true) @ one.T_wc) for true, one in zip(truth, results, strict=True)]
    return slam, results, np.array(apart)


@pytest.mark.slow
def test_two_seconds_of_darkness_in_a_corner_cost_less_than_half_a_metre(drive):
    slam, results, apart = drive_through(drive, ImuCalibration(np.eye(4), ADIS16448))
    plain, _, alone = drive_through(drive, None)
    assert {results[k].state for k in DARK} == {TrackingState.INERTIAL}
    assert results[-1].state == TrackingState.OK
    during = apart[DARK[-1]] - apart[DARK[0] - 1]
    assert np.linalg.norm(during[:3]) < 0.5
    assert np.degrees(np.linalg.norm(during[3:])) < 0.3
    assert slam.gaps() == []
    assert slam.in_map()[-1]

    assert len(plain.gaps()) == 1
    assert np.linalg.norm(alone[-1, :3]) > 10.0 * np.linalg.norm(apart[-1, :3])
