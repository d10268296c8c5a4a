"""Tracking by patches, first by sparse image alignment, then by the patches of landmarks."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import Perturbation
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.frontend.extraction import FrameImages
from vslam.frontend.images import GivenFeatures
from vslam.frontend.orb import build_pyramid, level_shapes
from vslam.frontend.patch_tracking import track_patches
from vslam.frontend.pose_alignment import align_pose, coarse_levels, is_coarse
from vslam.frontend.tracker import Tracker
from vslam.frontend.tracking import feature_depth
from vslam.run.options import RunOptions
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam
from vslam.support.errors import UnreadableImageError
from vslam.types.context import Context
from vslam.types.features import Extracted, TrackingState
from vslam.types.geometry import inverse, se3_exp, se3_log, transform
from vslam.types.trajectory import Trajectory

CONFIG = Config.model_validate({"tracking": {"method": "patches"}})
FEATURES = Config.model_validate({"tracking": {"method": "orb"}})
FIRST, SECOND = 12, 13  # frames in the turn
OFF = np.array([0.05, -0.03, 0.1, 0.01, 0.035, -0.01])  # of a prediction: two degrees, 12 cm


def coarse(image):
    return coarse_levels(build_pyramid(image, CONFIG.orb))


@pytest.fixture(scope="module")
def points(corridor):
    context = Context.create(corridor.camera, CONFIG)
    images = FrameImages(corridor.left[FIRST], lambda: corridor.right[FIRST], context)
    features = images.extracted.features
    depth = feature_depth(features, corridor.camera)
    near = np.flatnonzero((depth > 0) & (depth < 15.0))
    seen = corridor.camera.backproject(features.xy[near].astype(float), depth[near])
    return transform(corridor.T_wc[FIRST], seen)


def aligned(corridor, points, image, off=OFF):
    """Align an image, and return the difference from the true pose in degrees and in metres."""
    T_true = inverse(corridor.T_wc[SECOND])
    T_before, camera = inverse(corridor.T_wc[FIRST]), corridor.camera
    T_predicted = se3_exp(off) @ T_true
    size = camera.height, camera.width
    before = coarse(corridor.left[FIRST])
    T = align_pose(coarse(image), before, points, T_before, T_predicted, camera.intrinsics, size)
    error = se3_log(T @ inverse(T_true))
    return np.rad2deg(np.linalg.norm(error[3:])), np.linalg.norm(error[:3]), T, T_predicted


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (0.5, 30.0), (1.3, -40.0)])
def test_a_wrong_prediction_is_mended_whatever_the_light(corridor, points, gain, bias):
    image = np.clip(gain * corridor.left[SECOND] + bias, 0, 255).astype(np.uint8)
    turn, shift, *_ = aligned(corridor, points, image)
    assert turn < 0.06
    assert shift < 0.02


def test_the_prediction_stays_where_the_image_shows_something_else(corridor, points):
    noise = np.random.default_rng(0).integers(0, 256, corridor.left[0].shape, dtype=np.uint8)
    *_, T, T_predicted = aligned(corridor, points, cv2.GaussianBlur(noise, (0, 0), 2.0))
    np.testing.assert_array_equal(T, T_predicted)
    *_, T, T_predicted = aligned(corridor, points[:10], corridor.left[SECOND])
    np.testing.assert_array_equal(T, T_predicted)


def test_small_images_of_a_damaged_file_are_recognised(corridor):
    image = corridor.left[0]
    made, shapes = coarse(image), level_shapes(image.shape, CONFIG.orb)
    assert is_coarse(made, shapes, image.shape)
    for damage in (
        {"pixels": made.pixels[1:]},
        {"offsets": made.offsets + 1},
        {"shapes": made.shapes[:, ::-1]},
        {"scales": 2.0 * made.scales},
    ):
        assert not is_coarse(replace(made, **damage), shapes, image.shape)


def driven(corridor, config=CONFIG, *, threads=1, images=None, frames=None, monocular=False):
    camera = corridor.camera.left_camera() if monocular else corridor.camera
    slam = Slam(camera, config, "none", threads=threads)
    left = corridor.left if images is None else images
    results = [
        slam.step(left[k], None if monocular else corridor.right[k], corridor.timestamps[k])
        for k in range(frames or len(corridor))
    ]
    if frames is None:
        slam.finish()
    return slam, results


def test_few_frames_need_features_and_the_pose_is_as_good(corridor):
    slam, results = driven(corridor)
    assert all(result.state == TrackingState.OK for result in results)
    extracted = [result.index for result in results if result.stage_ms.get("extract", 0.0) > 0.0]
    keyframes = [result.index for result in results if result.is_keyframe]
    assert len(results) > 2 * len(extracted)
    assert len(keyframes) > 2
    by_features, _ = driven(corridor, FEATURES)
    error, usual = (
        np.linalg.norm(one.trajectory().T_wc[:, :3, 3] - corridor.T_wc[:, :3, 3], axis=1).max()
        for one in (slam, by_features)
    )
    assert error < max(0.03, 1.5 * usual)


def test_image_alignment_that_follows_a_moving_object_is_not_believed(corridor, monkeypatch):
    """The patches are searched for again, starting from the predicted pose."""

    misled_poses = []

    def mislead(now, before, xyz, T_before, T_cw, *_):
        misled_poses.append(se3_exp(np.array([0.3, 0.0, 0.3, 0.0, 0.0, 0.0])) @ T_cw)
        return misled_poses[-1]

    def track(pyramid, T_cw, *rest):
        found = track_patches(pyramid, T_cw, *rest)
        # A third of the patches do not follow the object.
        follows = any(T_cw is T for T in misled_poses)
        return found._replace(n_matches=len(found.ids) * 3 // 2) if follows else found

    slam, results = driven(corridor)
    monkeypatch.setattr("vslam.frontend.tracker.align_pose", mislead)
    monkeypatch.setattr("vslam.frontend.tracker.track_patches", track)
    misled, others = driven(corridor)
    T_wc, expected = misled.trajectory().T_wc, slam.trajectory().T_wc
    np.testing.assert_allclose(T_wc[:, :3, 3], expected[:, :3, 3], atol=0.05)
    by_patches = [sum(r.n_features == 0 for r in one) for one in (results, others)]
    assert by_patches[1] > 0.5 * by_patches[0]


def inverted(extracted: Extracted) -> Extracted:
    features = extracted.features
    return replace(extracted, features=replace(features, descriptors=~features.descriptors))


def test_a_keyframe_is_made_where_patches_are_found_even_if_no_descriptor_matches(
    corridor, monkeypatch
):
    changed, match_features = [], Tracker.match_features

    def match_in_another_light(tracker, track, images, view):
        if track.index > 8 and not changed:
            changed.append(track.index)
            seen = track.features
            images = GivenFeatures(inverted(images.extracted_with((seen.xy, seen.octave))))
        return match_features(tracker, track, images, view)

    monkeypatch.setattr(Tracker, "match_features", match_in_another_light)
    slam, results = driven(corridor)
    (index,) = changed
    assert results[index].is_keyframe
    assert all(result.state == TrackingState.OK for result in results)
    error = slam.trajectory().T_wc[:, :3, 3] - corridor.T_wc[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.03


@pytest.mark.parametrize(("share", "state"), [(0.6, TrackingState.WEAK), (0.4, TrackingState.LOST)])
def test_patches_that_agree_less_are_used_only_where_features_fail(
    corridor, monkeypatch, share, state
):
    def find(self, images, predicted, *rest):
        found = all_patches(self, images, predicted, *rest)
        few = predicted.index == 9
        return found._replace(n_matches=int(len(found.ids) / share)) if few else found

    def extract_nothing_known(self, images, predicted, view):
        track = extract(self, images, predicted, view)
        if predicted.index == 9:
            track = replace(track, extracted=inverted(track.extracted))
        return track

    all_patches, extract = Tracker._find_patches, Tracker.extract
    monkeypatch.setattr(Tracker, "_find_patches", find)
    _, by_features = driven(corridor, frames=11)
    assert by_features[9].state == TrackingState.OK
    assert by_features[9].n_features > 0
    monkeypatch.setattr(Tracker, "extract", extract_nothing_known)
    _, results = driven(corridor, frames=11)
    assert results[9].state == state
    error = np.linalg.norm((inverse(results[9].T_wc) @ corridor.T_wc[9])[:3, 3])
    assert state == TrackingState.LOST or error < 0.03


def run(kitti_tree, threads=1, sequence=None):
    """Track the corridor by patches. Reads of the right image are counted, except for those of the
    check whether the images are a stereo pair."""
    sequence = sequence or open_sequence("kitti", kitti_tree, "00")
    reads = []

    def counted(frame):
        def right():
            reads.append(frame.timestamp)
            return frame.sides[1]()

        return replace(frame, sides=(frame.sides[0], right))

    sequence = replace(sequence, stored=tuple(map(counted, sequence.stored)))
    settings = RunOptions(detector="none", threads=threads, thresholds=CONFIG)
    with patch("vslam.run.pair.PairCheck.watch", lambda self, frames: frames):
        outcome = run_sequence(begin(sequence, settings), Perturbation("none"), Recorder())
    return outcome, reads


@pytest.mark.parametrize("threads", [1, 2])
def test_the_right_image_is_read_for_keyframes_alone(corridor, kitti_tree, threads):
    outcome, reads = run(kitti_tree, threads)
    assert not any(track.state == TrackingState.LOST for track in outcome.tracks)
    n_keyframes = sum(track.is_keyframe for track in outcome.tracks)
    assert n_keyframes <= len(reads) < len(corridor) / 2
    assert len(set(reads)) == len(reads)


def test_a_right_image_that_cannot_be_read_costs_its_columns_alone(corridor, kitti_tree):
    sequence = open_sequence("kitti", kitti_tree, "00")

    def damaged():
        raise UnreadableImageError("right.png", "cannot be decoded; download the file again.")

    broken = [
        frame if k < 6 else replace(frame, sides=(frame.sides[0], damaged))
        for k, frame in enumerate(sequence.stored)
    ]
    sequence = replace(sequence, stored=tuple(broken))
    outcome, reads = run(kitti_tree, sequence=sequence)
    assert len(outcome.tracks) == len(corridor)
    assert not any(track.state == TrackingState.LOST for track in outcome.tracks[:8])
    tried = len([t for t in reads if t >= sequence.timestamps[6]])
    told = [warning for warning in outcome.warnings if "right.png" in warning]
    assert len(told) == tried > 0
    assert "has only its left image: right.png: cannot be decoded" in told[0]


def test_what_the_sides_show_is_told_of_the_frames_that_were_compared(corridor):
    black = [np.zeros_like(image) for image in corridor.right]
    slam = Slam(corridor.camera, CONFIG, "none", threads=1)
    for k, left in enumerate(corridor.left):
        slam.step(left, corridor.right[k] if k < 8 else black[k], corridor.timestamps[k])
    assert slam.rig.sides.n_black_right > 0
    assert slam.rig.sides.n < len(corridor)


def test_a_frame_that_shows_something_else_is_lost_and_the_next_is_not(corridor):
    noise = np.random.default_rng(0).integers(0, 256, corridor.left[0].shape, dtype=np.uint8)
    images = [*corridor.left]
    images[10] = noise
    _, results = driven(corridor, images=images)
    states = [result.state for result in results]
    assert states[10] == TrackingState.LOST
    assert states[:10] + states[11:] == [TrackingState.OK] * (len(corridor) - 1)


@pytest.mark.slow
@pytest.mark.parametrize("monocular", [False, True])
def test_the_same_bytes_with_two_threads_and_after_a_resume(corridor, monocular, tmp_path):
    drive = partial(driven, corridor, monocular=monocular)
    whole, _ = drive()
    expected = whole.trajectory().T_wc.tobytes()
    assert drive(threads=2)[0].trajectory().T_wc.tobytes() == expected
    resumed = 0
    for cut in range(6, 20):
        slam, _ = drive(frames=cut)
        if slam.stored_map().checkpoint is None:
            continue  # a keyframe is being mapped
        slam.save(tmp_path / "map.npz", resumable=True)
        again = Slam.load(tmp_path / "map.npz", CONFIG, "none", resume=True, threads=1)
        for k in range(cut, len(corridor)):
            right = None if monocular else corridor.right[k]
            again.step(corridor.left[k], right, corridor.timestamps[k])
        again.finish()
        assert again.trajectory().T_wc.tobytes() == expected, cut
        resumed += 1
    assert resumed >= 3


def test_one_camera_is_tracked_by_patches_between_keyframes(corridor):
    slam = Slam(corridor.camera.left_camera(), CONFIG, "none", threads=1)
    results = [
        slam.step(left, None, timestamp)
        for left, timestamp in zip(corridor.left, corridor.timestamps, strict=True)
    ]
    slam.finish()
    begun = next(k for k, result in enumerate(results) if result.is_keyframe)
    assert begun < 5
    assert all(result.state == TrackingState.OK for result in results[begun:])
    without = [result for result in results[begun:] if not result.n_features]
    assert not any(result.is_keyframe for result in without)
    assert len(without) > len(corridor) / 2
    truth = Trajectory(corridor.timestamps, corridor.T_wc)
    assert evaluate_trajectory(slam.trajectory(), truth, "sim3").ate_rmse_m < 0.05


def test_one_camera_without_an_imu_is_tracked_by_features_unless_asked_otherwise(corridor):
    depth, alone = replace(corridor.camera, depth=True), corridor.camera.left_camera()
    for camera in (corridor.camera, depth, alone):
        assert Context.create(camera, Config()).tracks_patches == (camera is not alone)
        assert Context.create(camera, Config(), has_imu=True).tracks_patches
        assert Context.create(camera, CONFIG).tracks_patches
        assert not Context.create(camera, FEATURES, has_imu=True).tracks_patches
