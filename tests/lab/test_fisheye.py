"""The rendered fisheye pair, rectified with its calibration, equals a pinhole pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.calibration.files import read_calibration
from vslam.datasets.euroc import open_euroc
from vslam.types.camera import Camera
from vslam_lab.towns.fisheye import render_fisheye, wide_camera
from vslam_lab.towns.routes import Route, built_in_route
from vslam_lab.towns.site import Variation

SMALL = Camera(140.0, 140.0, 119.5, 39.5, 0.5, 240, 80)
FRAMES = 2


@pytest.fixture(scope="module")
def route() -> Route:
    return replace(built_in_route("block"), camera=SMALL)


@pytest.fixture(scope="module")
def folder(route: Route, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fisheye")
    return render_fisheye(route, Variation(), folder, until=FRAMES, threads=1)


@pytest.mark.slow
def test_both_calibrations_tell_the_same(folder):
    ours, kalibr = (read_calibration([path]) for path in (folder, folder / "camchain.yaml"))
    assert (ours.left, ours.right) == (kalibr.left, kalibr.right)
    np.testing.assert_allclose(ours.T_left_right, kalibr.T_left_right, atol=1e-12)
    assert ours.left.lens == "fisheye"
    assert not np.allclose(ours.T_left_right[:3, :3], np.eye(3), atol=0.01)


@pytest.mark.slow
def test_rectified_images_are_those_of_a_pinhole_pair(folder, route):
    sequence = open_euroc(folder, "")
    assert len(sequence) == FRAMES
    wide, seen = wide_camera(SMALL), sequence.camera
    assert seen.baseline == pytest.approx(SMALL.baseline)
    # The x axes of both pairs are equal. The rectified pair may be slightly rotated about it.
    R_wide_seen = np.linalg.inv(route.ground_truth[1, :3, :3]) @ sequence.ground_truth[1, :3, :3]
    np.testing.assert_allclose(R_wide_seen[:, 0], [1, 0, 0], atol=1e-9)
    u, v = np.meshgrid(np.arange(seen.width), np.arange(seen.height))
    rays = seen.backproject(np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    at = wide.project(rays @ R_wide_seen.T)[:, :2].reshape(*u.shape, 2).astype(np.float32)
    rendered = next(folder.glob("pinhole/*/sequences/block"))
    for side, image in enumerate(sequence.read(1)):
        pinhole = cv2.imread(str(rendered / f"image_{side}/000001.png"), cv2.IMREAD_GRAYSCALE)
        expected = cv2.remap(pinhole, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(float)
        difference = np.abs(image - expected)[2:-2, 2:-2]
        shifted = np.abs(image[:, 1:] - expected[:, :-1])[2:-2, 2:-2]
        assert difference.mean() < 3.0
        assert difference.mean() < 0.5 * shifted.mean()


@pytest.mark.slow
def test_the_ground_truth_is_the_drive(folder, route):
    found = open_euroc(folder, "").ground_truth
    np.testing.assert_allclose(found[:, :3, 3], route.ground_truth[:FRAMES, :3, 3], atol=1e-9)
