"""A frame that is tracked: its features, its matches and its pose."""

from __future__ import annotations

import numpy as np
from parts import frame_of

from vslam.config import Config
from vslam.frontend.relocaliser import relocalised
from vslam.frontend.tracking import refine
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.geometry import se3_exp, transform
from vslam.types.map import Map
from vslam.types.map_kernels import link_many
from vslam.types.map_view import NO_LANDMARKS, LocalMap, local_map

CAMERA = Camera(400.0, 400.0, 320.0, 240.0, 0.5, 640, 480)
CONTEXT = Context.create(CAMERA, Config())
T_CW = se3_exp(np.array([0.4, -0.1, -1.0, 0.02, 0.1, -0.05]))
N = 150


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-5, 5, (N, 2)), rng.uniform(8, 20, N)])


def descriptors() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (N, 32), dtype=np.uint8)


def seen_from(T_cw: np.ndarray) -> Features:
    """Return the features of the points in the image of a camera, without stereo matches."""
    xy = CAMERA.project(transform(T_cw, points()))[:, :2]
    nothing = np.full(N, np.nan, np.float32)
    octave, angle = np.zeros(N, np.uint8), np.zeros(N, np.float32)
    return Features(xy.astype(np.float32), octave, angle, descriptors(), nothing)


def place() -> LocalMap:
    """Return the landmarks of a map whose only keyframe is at the origin and sees all points."""
    map_ = Map(CONTEXT.scales)
    map_.add_keyframe(seen_from(np.eye(4)), np.eye(4), 0.0, 0)
    ids = map_.add_landmarks(points(), descriptors().view(np.uint64), 0)
    link_many(map_.arrays, np.arange(N), ids)
    return local_map(map_, 0, 1)


def test_the_pose_of_a_frame_is_refined_from_a_nearby_one_and_found_by_relocalisation():
    seen = frame_of(seen_from(T_CW))
    matched = seen.matching(np.arange(N), np.arange(N, dtype=np.int32), points())
    refined = refine(matched, se3_exp(np.full(6, 0.02)) @ T_CW, NO_LANDMARKS, CONTEXT)
    found = relocalised(seen, place(), place(), CONTEXT, seed=0)
    assert refined.n_inliers == N
    assert found.n_inliers > 0.8 * N
    for frame in (refined, found):
        np.testing.assert_allclose(frame.T_cw, T_CW, atol=1e-4)


def test_a_step_of_tracking_changes_nothing_that_it_was_given():
    seen = frame_of(seen_from(T_CW))
    matched = seen.matching(np.arange(N), np.arange(N, dtype=np.int32), points())
    fewer = matched.without(np.arange(10))
    assert len(seen.tracked) == 0
    assert len(matched.tracked) == N
    assert fewer.tracked.tolist() == list(range(10, N))
    assert np.isnan(fewer.xyz[:10]).all()
