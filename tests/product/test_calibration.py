"""Camera models are compared with those of OpenCV. Images are rectified with them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import StereoSequence

from vslam.calibration.models import Calibration, CameraModel, project, unproject, without_zeros
from vslam.calibration.rectification import rectify
from vslam.datasets.frames import RawSource, stored_frames
from vslam.datasets.rectified import rectified
from vslam.run.rig import calibration_warnings
from vslam.support.errors import InputError
from vslam.types.camera import Camera, calibration_doubts
from vslam.types.geometry import se3_exp

RADTAN = (-0.283, 0.074, 0.00019, -0.0017, 0.002, 0.01, -0.02, 0.003)
PINHOLE = CameraModel(458.654, 457.296, 367.215, 248.375, 752, 480)
FISHEYE = CameraModel(
    190.9, 190.8, 254.9, 256.9, 512, 512, "fisheye", (0.0034, 0.0007, -0.002, 0.0002)
)


def matrix(model: CameraModel) -> np.ndarray:
    return np.array([[model.fx, 0, model.cx], [0, model.fy, model.cy], [0, 0, 1.0]])


def rays(n=200, reach=0.7, seed=3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-reach, reach, (n, 2)), np.ones(n)]) * rng.uniform(
        1, 9, (n, 1)
    )


@pytest.mark.parametrize("n", [0, 4, 5, 8])
def test_radial_tangential_is_that_of_opencv(n):
    model = replace(PINHOLE, distortion=RADTAN[:n])
    points = rays()
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), matrix(model), np.array(RADTAN[:n] or (0.0,) * 4)
    )[0]
    xy = project(model, points)
    np.testing.assert_allclose(xy, expected.reshape(-1, 2), atol=1e-9)
    back = unproject(model, xy)
    np.testing.assert_allclose(back, points / np.linalg.norm(points, axis=1)[:, None], atol=1e-9)


def test_equidistant_is_that_of_opencv_and_reaches_beyond_90_degrees():
    points = rays(reach=2.0)
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix(FISHEYE), np.array(FISHEYE.distortion)
    )[0]
    np.testing.assert_allclose(project(FISHEYE, points), expected.reshape(-1, 2), atol=1e-9)
    sideways = np.array([[1.0, 0.2, -0.1], [0.0, 0.0, 3.0], [-0.4, 0.9, 0.0]])
    back = unproject(FISHEYE, project(FISHEYE, sideways))
    unit = sideways / np.linalg.norm(sideways, axis=1)[:, None]
    np.testing.assert_allclose(back, unit, atol=1e-9)


def test_no_pixel_where_there_is_none():
    behind = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, -1.0]])
    assert np.isnan(project(PINHOLE, behind)).all()
    assert np.isnan(project(FISHEYE, behind[1:])).all()
    folding = replace(PINHOLE, distortion=(-2.0, 0.0, 0.0, 0.0))
    assert np.isnan(unproject(folding, np.array([[700.0, 470.0]]))).all()


def test_zeros_behind_do_not_tell_two_distortions_apart():
    assert without_zeros("pinhole", (0.0,) * 5) == ()
    assert without_zeros("pinhole", (0.1, 0, 0, 0, 0)) == (0.1, 0, 0, 0)
    assert without_zeros("pinhole", (0.1, 0, 0, 0, 0, 0, 0, 0.2)) == (0.1, 0, 0, 0, 0, 0, 0, 0.2)
    assert without_zeros("fisheye", (0.0,) * 4) == (0.0,) * 4


def pair(left: CameraModel, right: CameraModel, twist=(0.5, 0.01, -0.02, 0.01, -0.02, 0.015)):
    return Calibration(left, right, se3_exp(np.array(twist)))


RIGS = {
    "radial-tangential": pair(
        replace(PINHOLE, distortion=RADTAN[:4]),
        replace(PINHOLE, fx=470.0, fy=471.0, cx=380.0, distortion=RADTAN[:5]),
    ),
    "fisheye": pair(FISHEYE, replace(FISHEYE, fx=195.0, cx=250.0)),
    "mixed": pair(replace(PINHOLE, distortion=RADTAN), FISHEYE),
    "right one below": pair(
        replace(PINHOLE, distortion=RADTAN[:4]),
        replace(PINHOLE, fx=470.0, fy=471.0, cx=380.0, distortion=RADTAN[:5]),
        (0.01, 0.5, -0.02, 0.01, -0.02, 0.015),
    ),
    "right one above": pair(FISHEYE, replace(FISHEYE, fx=195.0), (0.02, -0.5, 0.01, 0.01, 0, 0.02)),
}
TURNS = {"right one below": 1, "right one above": -1}


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
def test_rectified_rows_correspond_and_disparity_is_depth(rig):
    calibration = RIGS[rig]
    found = rectify(calibration)
    camera = found.camera
    rng = np.random.default_rng(0)
    xy = rng.uniform((60, 60), (camera.width - 60, camera.height - 60), (9, 2))
    points = camera.backproject(xy, rng.uniform(3, 40, 9))  # rectified left camera
    in_left = points @ found.R_left_rectified.T
    in_right = (in_left - calibration.T_left_right[:3, 3]) @ calibration.T_left_right[:3, :3]
    for model, at, remap, column in (
        (calibration.left, in_left, found.left, 0),
        (calibration.right, in_right, found.right, 2),
    ):
        shown = project(model, at)
        wanted = camera.project(points)[:, [column, 1]]
        for seen, expected in zip(shown, wanted, strict=True):
            if not (8 < seen[0] < model.width - 8 and 8 < expected[0] < camera.width - 8):
                continue
            u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
            spot = 250 * np.exp(-((u - seen[0]) ** 2 + (v - seen[1]) ** 2) / 2.0)
            image = remap(np.rint(spot).astype(np.uint8)).astype(float)
            v, u = np.indices(image.shape)
            centre = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
            np.testing.assert_allclose(centre, expected, atol=0.15)


@pytest.mark.parametrize("rig", RIGS)
def test_no_pixel_of_a_rectified_image_is_black(rig):
    calibration = RIGS[rig]
    found = rectify(calibration)
    for model, remap in ((calibration.left, found.left), (calibration.right, found.right)):
        image = remap(np.full((model.height, model.width), 200, np.uint8))
        size = (calibration.left.height, calibration.left.width)
        assert image.shape == (size[::-1] if rig in TURNS else size)
        assert (image == 200).all()


@pytest.mark.parametrize("rig", RIGS)
def test_only_vertical_pairs_are_turned(rig):
    """The mounted camera differs from the original one by the small rotation of rectification."""
    found = rectify(RIGS[rig])
    assert found.camera.quarter_turns == TURNS.get(rig, 0)
    R = found.R_left_rectified @ found.camera.T_mounted_camera[:3, :3].T
    assert np.degrees(np.arccos((np.trace(R) - 1) / 2)) < 5


@pytest.mark.parametrize("turns", [1, -1])
def test_a_vertical_pair_without_distortion_is_turned_exactly(turns):
    one = CameraModel(240.0, 240.0, 250.0, 70.0, 480, 160)
    shift = np.eye(4)
    shift[1, 3] = turns * 0.12
    found = rectify(Calibration(one, one, shift))
    image = np.random.default_rng(0).integers(0, 256, (160, 480)).astype(np.uint8)
    for remap in (found.left, found.right, found.left_depth):
        assert np.array_equal(remap(image), np.rot90(image, turns))
    camera = found.camera
    assert (camera.width, camera.height, camera.baseline) == (160, 480, 0.12)
    np.testing.assert_allclose([camera.fx, camera.fy], 240.0)
    point = np.array([[0.3, -0.2, 2.0]])
    turned = point @ found.R_left_rectified
    at = np.rint(camera.project(turned)[0, :2]).astype(int)
    seen = np.zeros((160, 480), np.uint8)
    x, y = np.rint(project(one, point)[0]).astype(int)
    seen[y, x] = 1
    assert found.left(seen)[at[1], at[0]] == 1
    np.testing.assert_allclose(found.R_left_rectified, camera.T_mounted_camera[:3, :3])
    assert rectify(Calibration(one, one, shift).left_alone()).camera.quarter_turns == 0


def test_most_of_the_view_is_kept():
    found = rectify(Calibration(replace(PINHOLE, distortion=RADTAN[:4])))
    c = found.camera
    ramp = np.tile(np.arange(480)[:, None] * 0.5, (1, 752)).astype(np.uint8)
    ends = found.left(ramp)
    across = found.left(np.tile(np.arange(752) / 3.0, (480, 1)).astype(np.uint8))
    touched = [ends[0].min() <= 1, ends[-1].max() >= 238]
    touched += [across[:, 0].min() <= 1, across[:, -1].max() >= 249]
    assert sum(touched) >= 2
    assert c.fx == c.fy
    assert c.monocular


def test_what_is_rectified_already_is_handed_on():
    shift = np.eye(4)
    shift[0, 3] = 0.12
    found = rectify(Calibration(PINHOLE, PINHOLE, shift))
    image = np.zeros((480, 752), np.uint8)
    assert found.identity
    assert found.left(image) is image
    assert found.right(image) is image
    assert found.camera.baseline == 0.12
    assert (found.camera.fx, found.camera.fy) == (PINHOLE.fx, PINHOLE.fy)
    assert rectify(Calibration(PINHOLE)).identity


def test_depth_is_undistorted_by_the_nearest_pixel():
    found = rectify(Calibration(replace(PINHOLE, distortion=RADTAN[:5])))
    depth = np.random.default_rng(0).integers(1, 60000, (480, 752)).astype(np.uint16)
    seen = found.left_depth(depth)
    assert seen.dtype == np.uint16
    assert np.isin(seen, depth).all()
    assert found.left_depth(depth.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize(
    ("twist", "words"),
    [
        ((-0.3, 0, 0, 0, 0, 0), "to the left of the left one; swap"),
        ((0, 0, 0, 0, 0, 0), "baseline is 0 m"),
        ((120.0, 0, 0, 0, 0, 0), "are 120 m apart, probably because .* in millimetres"),
        ((0.05, 0, 0.3, 0, 0, 0), "are one in front of the other or look in different directions"),
        ((0.3, 0, 0, 0, 3.14, 0), "turned by"),
    ],
)
def test_pairs_that_cannot_be_rectified(twist, words):
    with pytest.raises(InputError, match=words):
        rectify(pair(PINHOLE, PINHOLE, twist))


def test_a_distortion_that_folds_the_image():
    with pytest.raises(InputError, match="folds the image"):
        rectify(Calibration(replace(PINHOLE, distortion=(-2.0, 0.0, 0.0, 0.0))))


@pytest.mark.slow
def test_a_wide_lens_may_fold_its_corners():
    """This is common for action cameras, if the target was never near the corners."""
    wide = CameraModel(582.0, 582.0, 640, 360, 1280, 720, "pinhole", (-0.24, 0.05, 0, 0, -0.004))
    corner, middle = np.array([[0.0, 0.0]]), np.array([[0.0, 360.0]])
    assert np.isnan(unproject(wide, corner)).all()
    assert np.isfinite(unproject(wide, middle)).all()
    white = np.full((720, 1280), 255, np.uint8)
    white[:2], white[-2:], white[:, :2], white[:, -2:] = 0, 0, 0, 0
    found = rectify(Calibration(wide)).left(white)
    assert (found[4:-4, 4:-4] == 255).all()


def drawn(corridor: StereoSequence, right: list) -> RawSource:
    stored = stored_frames(corridor.timestamps, lambda k, image_map: (corridor.left[k], right[k]))
    n_sides = 1 if right[0] is None else 2
    size = corridor.camera.width, corridor.camera.height
    return RawSource(
        dataset="drawn", name="drawn", sizes=(size,) * n_sides, stored=stored,
        ground_truth=corridor.T_wc,
    )  # fmt: skip


def test_a_rectified_sequence(corridor: StereoSequence):
    c = corridor.camera
    model = CameraModel(c.fx, c.fy, c.cx, c.cy, c.width, c.height)
    shift = np.eye(4)
    shift[0, 3] = c.baseline
    raw = drawn(corridor, corridor.right)
    same = rectified(raw, Calibration(model, model, shift))
    assert same.camera == c
    assert len(same) == len(corridor)
    np.testing.assert_array_equal(same.read(3)[1], corridor.right[3])
    np.testing.assert_array_equal(same.ground_truth, corridor.T_wc)

    turned = rectified(raw, pair(model, model))
    R = rectify(pair(model, model)).R_left_rectified
    np.testing.assert_allclose(turned.ground_truth[5, :3, :3], corridor.T_wc[5, :3, :3] @ R)
    np.testing.assert_array_equal(turned.ground_truth[:, :3, 3], corridor.T_wc[:, :3, 3])
    assert turned.read(0)[0].shape == corridor.left[0].shape

    with pytest.raises(InputError, match="made for 752x480 pixels but the images have 480x160"):
        rectified(raw, pair(PINHOLE, PINHOLE))
    with pytest.raises(InputError, match="right camera is missing"):
        rectified(raw, Calibration(model))
    nothing = [None] * len(corridor)
    alone = rectified(drawn(corridor, nothing), Calibration(model, model, np.eye(4)))
    assert alone.read(0)[1] is None
    assert alone.camera.monocular


KITTI = Camera(707.1, 707.1, 601.9, 183.1, 0.537, 1241, 376)


@pytest.mark.parametrize(
    ("camera", "doubt"),
    [
        (replace(KITTI, cx=1203.8, cy=366.2, fx=1414.2, fy=1414.2), "images of twice this size"),
        (replace(KITTI, cx=301.0, cy=91.5, fx=353.6, fy=353.6), "images of half this size"),
        (replace(KITTI, cx=183.1, cy=601.9), "check the order of its numbers"),
        (replace(KITTI, fx=8485.2), r"a field of view of 8 x 30 degrees"),
        (replace(KITTI, fx=1.9, fy=1.9), r"a field of view of 180 x 179 degrees"),
    ],
)
def test_an_implausible_calibration_is_named_with_its_file_and_its_cause(camera, doubt):
    (said,) = calibration_warnings(camera, [Path("mine.yaml")], "drive.mp4")
    assert said.startswith("mine.yaml: the ")
    assert re.search(doubt, said)
    assert calibration_warnings(camera, [], "06")[0].startswith("the calibration of 06: the ")


def test_a_plausible_calibration_raises_no_doubt():
    assert calibration_doubts(KITTI) == []
    assert calibration_doubts(rectify(Calibration(FISHEYE)).camera) == []
    assert (
        calibration_doubts(rectify(Calibration(replace(PINHOLE, distortion=RADTAN))).camera) == []
    )
