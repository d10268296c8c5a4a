"""Masked pixels give no feature, no patch and no place. Runs without masks are not slower."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from source_files import open_from, write_calibration, write_images, write_video

from vslam.config import Config
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.frontend import tracker
from vslam.frontend.extraction import FrameImages
from vslam.frontend.masks import REACH, Mask
from vslam.frontend.pose_alignment import align_pose
from vslam.report.finished_run import open_images, read_run
from vslam.run.preparation import prepare_frame
from vslam.slam import Slam
from vslam.support.errors import InputError, UnreadableImageError
from vslam.types.context import Context
from vslam.types.features import TrackingState
from vslam.types.geometry import transform
from vslam.types.trajectory import Trajectory

ORB = Config().orb
HOOD = 110  # first row that the hood covers


@pytest.fixture(scope="module")
def mask(corridor) -> np.ndarray:
    mask = np.full(corridor.left[0].shape, 255, np.uint8)
    mask[HOOD:] = 0
    return mask


@pytest.fixture(scope="module")
def hooded(corridor):
    """The corridor with a textured hood, which stays at the same place in both images."""
    blocks = np.random.default_rng(3).integers(0, 256, (40, 120), dtype=np.uint8)
    hood = cv2.resize(blocks, (480, 160), interpolation=cv2.INTER_NEAREST)[HOOD:]

    def covered(image: np.ndarray, shift: int) -> np.ndarray:
        image = image.copy()
        image[HOOD:] = np.roll(hood, -shift, axis=1)
        return image

    left = [covered(image, 0) for image in corridor.left]
    right = [covered(image, 20) for image in corridor.right]
    return left, right


def driven(corridor, images, mask, method="patches"):
    """Return the SLAM after all frames, its results, and its ATE in metres."""
    slam = Slam(corridor.camera, {"tracking": {"method": method}}, "none", threads=1)
    results = [
        slam.step(left, right, t, mask=mask)
        for left, right, t in zip(*images, corridor.timestamps, strict=True)
    ]
    slam.finish()
    truth = Trajectory(corridor.timestamps, corridor.T_wc)
    return slam, results, evaluate_trajectory(slam.trajectory(), truth, "se3").ate_rmse_m


@pytest.mark.parametrize("method", ["orb", "patches"])
def test_a_masked_hood_does_not_hold_the_camera_back(corridor, hooded, mask, method):
    slam, results, ate = driven(corridor, hooded, mask, method)
    assert all(result.state == TrackingState.OK for result in results)
    rows = slam.map.arrays.xy[: slam.map.n_rows, 1]
    assert len(rows)
    assert rows.max() < HOOD - REACH
    without = driven(corridor, hooded, None, method)[2]
    assert ate < 0.05
    assert ate < 0.2 * without


def test_features_keep_their_distance_and_others_take_their_place(corridor, mask):
    context = Context.create(corridor.camera, Config())
    made = [
        FrameImages(corridor.left[0], lambda: corridor.right[0], context, mask=of_left)
        for of_left in (None, Mask.of(mask, ORB))
    ]
    whole, masked = (images.extracted.features for images in made)
    scale = context.scales[masked.octave]
    assert (masked.xy[:, 1] <= HOOD - REACH * scale).all()
    above = np.count_nonzero(whole.xy[:, 1] < HOOD - REACH * 4)
    assert np.count_nonzero(masked.xy[:, 1] < HOOD - REACH * 4) > above


@pytest.mark.parametrize("sensor", ["mono", "rgbd"])
def test_cameras_without_a_right_image_are_masked(corridor, mask, sensor):
    camera, second = corridor.camera.left_camera(), None
    if sensor == "rgbd":
        camera, second = replace(corridor.camera, depth=True), np.ones(mask.shape, np.float32)
    context = Context.create(camera, Config())
    images = FrameImages(corridor.left[0], lambda: second, context, mask=Mask.of(mask, ORB))
    assert images.extracted.features.xy[:, 1].max() < HOOD - REACH


@pytest.mark.parametrize("method", ["orb", "patches"])
def test_no_landmark_is_looked_for_where_the_image_is_masked(corridor, mask, method, monkeypatch):
    aligned: list[np.ndarray] = []

    def align(now, before, xyz, T_before, T_cw, intrinsics, size):
        aligned.append(rows(xyz, T_cw))
        return align_pose(now, before, xyz, T_before, T_cw, intrinsics, size)

    def rows(xyz, T_cw):
        return corridor.camera.project(transform(T_cw, xyz))[:, 1]

    left, right, times = corridor.left, corridor.right, corridor.timestamps
    slam = Slam(corridor.camera, {"tracking": {"method": method}}, "none", threads=1)
    for k in range(20):
        slam.step(left[k], right[k], times[k])
    slam.finish()
    before = slam.map.arrays.visible[: slam.map.n_landmarks].copy()
    monkeypatch.setattr(tracker, "align_pose", align)
    slam.step(left[20], right[20], times[20], mask=mask)
    frame = slam.frame
    tracked = frame.landmark >= 0
    assert tracked.sum() > 50
    assert (frame.features.xy[tracked, 1] < HOOD).all()
    slam.finish()
    expected = slam.map.arrays.visible[: len(before)] > before
    found = rows(slam.map.arrays.xyz[: len(before)][expected], frame.T_cw)
    assert len(found) > 50
    assert found.max() < HOOD
    assert all(len(one) > 20 and one.max() < HOOD for one in aligned)
    assert len(aligned) == (method == "patches")


def test_a_mask_that_hides_nothing_changes_nothing(corridor, mask):
    images = corridor.left, corridor.right
    poses = [
        driven(corridor, images, each)[0].trajectory().T_wc.tobytes()
        for each in (None, np.full_like(mask, 255), np.ones(mask.shape, bool))
    ]
    assert poses[0] == poses[1] == poses[2]


def test_places_are_recognised_by_what_is_not_masked(corridor, hooded, mask):
    context = Context.create(corridor.camera, Config())
    of_left = Mask.of(mask, ORB)
    for left in (corridor.left[0], hooded[0][0]):
        images = FrameImages(left, lambda: corridor.right[0], context, mask=of_left)
        shown = images.image
        assert (shown[:HOOD] == corridor.left[0][:HOOD]).all()
        assert (shown[HOOD:] == int(corridor.left[0][:HOOD].mean())).all()
        assert images.left is left


def test_step_refuses_a_mask_that_does_not_fit(corridor):
    slam = Slam(corridor.camera, detector="none")
    images = corridor.left[0], corridor.right[0], 0.0
    with pytest.raises(ValueError, match=r"the mask has shape \(3, 3\), but the camera"):
        slam.step(*images, mask=np.ones((3, 3), np.uint8))
    with pytest.raises(ValueError, match="type float64 instead of uint8 or bool"):
        slam.step(*images, mask=np.ones(corridor.left[0].shape))


@pytest.fixture(scope="module")
def folder(corridor, tmp_path_factory):
    """A folder with four pairs of the corridor, as images and as a video.

    It has one calibration that requires rectification, and one that does not.
    """
    folder = tmp_path_factory.mktemp("masked")
    sides = {"left": corridor.left[:4], "right": corridor.right[:4]}
    write_images(folder, sides, [f"{k}.jpg" for k in range(4)])
    write_video(folder / "drive.mkv", sides["left"])
    write_calibration(folder / "pair.yaml", corridor.camera)
    write_calibration(folder / "left.yaml", corridor.camera, mono=True)
    c = corridor.camera
    (folder / "bent.yaml").write_text(
        f"left: {{size: [{c.width}, {c.height}], focal: [{c.fx}, {c.fy}], "
        f"centre: [{c.cx}, {c.cy}], distortion: [-0.3, 0.1, 0, 0]}}\n"
    )
    return folder


def write_mask(path, pixels):
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def opened(folder, mask, calib="left.yaml", **more):
    return open_from(
        "images", folder / "left", calib=(folder / calib,), fps=10.0, sensor="mono", mask=mask,
        **more,
    )  # fmt: skip


def test_a_mask_is_rectified_like_the_image(folder, mask, tmp_path):
    path = write_mask(tmp_path / "mask.png", mask)
    frame = opened(folder, path).stored[0]
    assert (frame.mask() == mask).all()
    bent = opened(folder, path, "bent.yaml")
    rectified = bent.stored[0].mask()
    assert set(np.unique(rectified)) == {0, 255}
    painted = write_images(
        tmp_path / "painted", {"left": [mask] * 4}, [f"{k}.png" for k in range(4)]
    )
    (painted / "bent.yaml").write_text((folder / "bent.yaml").read_text())
    seen = opened(painted, None, "bent.yaml").read(0)[0]
    assert np.mean((seen > 127) != (rectified > 127)) < 0.005
    assert np.mean(rectified != mask) > 0.01


def test_each_image_has_its_own_mask(folder, mask, tmp_path):
    masks = [np.roll(mask, 10 * k, axis=0) for k in range(4)]
    for k, each in enumerate(masks):
        write_mask(tmp_path / "stem" / f"{k}.png", each)
        write_mask(tmp_path / "whole" / f"{k}.jpg.png", each)
        write_mask(tmp_path / "number" / f"{k:06}.png", each)
    for name in ("stem", "whole"):
        source = opened(folder, tmp_path / name, start=1, every=2)
        for frame, each in zip(source.stored, masks[1::2], strict=True):
            assert (frame.mask() == each).all()
    video = open_from(
        "video", folder / "drive.mkv", calib=(folder / "left.yaml",), sensor="mono", start=1,
        mask=tmp_path / "number",
    )  # fmt: skip
    for frame, each in zip(video.frames(), masks[1:], strict=True):
        assert (frame.mask() == each).all()


def test_a_wrong_mask_of_one_frame_costs_this_frame(folder, mask, tmp_path):
    for k in range(4):
        write_mask(tmp_path / f"{k}.png", np.zeros_like(mask) if k == 2 else mask)
    source = opened(folder, tmp_path)
    with pytest.raises(UnreadableImageError, match=r"2\.png: hides the whole image"):
        source.stored[2].mask()
    context = Context.create(source.camera, Config())
    prepared = [prepare_frame(frame, context) for frame in source.stored]
    assert [one.problem is None for one in prepared] == [True, True, False, True]


@pytest.mark.parametrize(
    ("name", "pixels", "said"),
    [
        ("absent.png", None, "no such file or folder"),
        ("small.png", np.full((4, 5), 255, np.uint8), "5x4 pixels but the images have 480x160"),
        ("grey.png", np.full((160, 480), 100, np.uint8), "has pixels of value 100, but may only"),
        ("red.png", np.full((160, 480, 3), (0, 0, 255), np.uint8), "has pixels of value 76"),
        ("black.png", np.zeros((160, 480), np.uint8), "hides the whole image; paint used"),
        ("text.png", b"mask", "cannot be decoded"),
        ("empty", None, "holds no masks"),
        ("some/1.png", np.full((160, 480), 255, np.uint8), "is no 0.png for the image 0.jpg; add"),
    ],
)
def test_a_wrong_mask_is_refused_in_one_sentence(call, folder, tmp_path, name, pixels, said):
    path = tmp_path / name
    if isinstance(pixels, bytes):
        path.write_bytes(pixels)
    elif pixels is not None:
        write_mask(path, pixels)
    elif not path.suffix:
        path.mkdir()
    path = path.parent if "/" in name else path
    code, _, err = call(
        "run", folder / "left", "--sensor", "mono", "--calib", folder / "left.yaml", "--fps", 10,
        "--mask", path,
    )  # fmt: skip
    assert code == 2
    assert len(err.splitlines()) == 1
    assert said in err
    assert str(path) in err
    assert not (tmp_path / "runs").exists()


def test_a_frame_of_a_video_without_mask_is_named(folder, mask, tmp_path):
    write_mask(tmp_path / "0.png", mask)
    video = open_from(
        "video", folder / "drive.mkv", calib=(folder / "left.yaml",), sensor="mono", mask=tmp_path
    )
    with pytest.raises(InputError, match=r"there is no 000001\.png for frame 1; add this mask"):
        list(video.frames())


def test_report_and_doctor_show_the_mask(call, kitti_tree, mask, tmp_path):
    path = write_mask(tmp_path / "mask.png", mask)
    code, _, err = call(
        "run", "--data", kitti_tree, "--mask", path, "--max-frames", 4, "--no-record", "--quiet",
        "--detector", "none",
    )  # fmt: skip
    assert code == 0, err
    report = (tmp_path / "runs" / "latest" / "report.md").read_text()
    assert re.search(rf"\| mask +\| {re.escape(str(path))} +\|", report)
    assert json.loads((tmp_path / "runs/latest/run.json").read_text())["mask"] == str(path)
    path.rename(tmp_path / "moved.png")  # exports use the images without the mask
    assert open_images(read_run("runs/latest")).stored[0].mask is None
    path = tmp_path / "moved.png"
    code, out, _ = call("doctor", "--data", kitti_tree, "--mask", path)
    assert code == 0, out
    assert "the mask hides 31.2 % of the image" in out
    page = (tmp_path / "doctor.html").read_text()
    assert "the mask hides the red part" in page
