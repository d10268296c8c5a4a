"""Sub-pixel alignment is exact on patches of a known scene."""

from dataclasses import replace

import numpy as np
import pytest
from parts import frame_of

from vslam.config import Config
from vslam.frontend.alignment import align, align_matches, warps
from vslam.frontend.keyframe_alignment import align_observations
from vslam.frontend.orb import build_pyramid, extract
from vslam.frontend.patches import RecentPatches, patches_around
from vslam.frontend.tracking import refine
from vslam.method.mapping import Mapper
from vslam.support.workers import Workers
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import (
    NO_PATCHES,
    PATCH_PIXELS,
    PATCH_RADIUS,
    Extracted,
    Features,
    KeyframePatches,
)
from vslam.types.geometry import inverse, se3_exp, transform
from vslam.types.map import Map
from vslam.types.map_kernels import link_many, unlink
from vslam.types.map_view import NO_LANDMARKS

CONFIG = Config().alignment
NO_SHIFT = np.zeros((1, 2), np.float32)


def seen(scene, x=0.0, y=0.0, zoom=1.0, gain=1.0, offset=0.0):
    """Return the ``(1, PATCH_PIXELS)`` patch of a scene whose origin is at x, y from its middle."""
    at = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    u, v = np.meshgrid((at - x) / zoom, (at - y) / zoom)
    return np.rint(np.clip(gain * scene(u, v) + offset, 0, 255)).astype(np.uint8).reshape(1, -1)


def random_scene(seed):
    """Make a scene of waves in all directions, at least 6 pixels long, like a blurred image."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.3, 1.0, 12)
    turn, phase = rng.uniform(0, 2 * np.pi, (2, 12))
    height = rng.uniform(5.0, 15.0, 12)

    def scene(u, v):
        along = np.cos(turn) * u[..., None] + np.sin(turn) * v[..., None]
        return 128.0 + (height * np.sin(waves * along + phase)).sum(axis=-1)

    return scene


def aligned(image, reference, zoom=1.0, centre=NO_SHIFT):
    config = CONFIG
    return align(
        image,
        reference,
        centre,
        np.array([0]),
        np.eye(2, dtype=np.float32)[None] / np.float32(zoom),
        7,
        2.0,
        config.min_correlation,
    )[0]


@pytest.mark.parametrize("zoom", [0.85, 1.0, 1.2, 1.35])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.5, 20.0), (1.3, -60.0)])
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.3, -0.4), (-0.9, 0.75), (1.2, 0.1)])
def test_shift_under_another_size_and_light_is_found_to_a_twentieth_of_a_pixel(
    x, y, zoom, gain, offset
):
    errors = []
    for seed in range(20):
        scene = random_scene(seed)
        found = aligned(seen(scene, x, y, zoom, gain, offset), seen(scene), zoom)
        errors.append(np.abs(found - [x, y]).max())
    errors = np.array(errors)
    known = np.isfinite(errors)
    assert known.sum() >= 16
    assert np.median(errors[known]) < 0.03
    assert np.quantile(errors[known], 0.9) < 0.05


def test_what_a_landmark_is_may_lie_beside_the_middle_of_its_patch():
    scene = random_scene(3)
    reference = seen(scene, x=1.4, y=-0.6)
    found = aligned(seen(scene, 0.25, 0.5), reference, centre=np.array([[1.4, -0.6]], np.float32))
    assert np.abs(found - [0.25, 0.5]).max() < 0.05


def test_another_scene_is_refused_in_99_of_100_cases():
    found = [aligned(seen(random_scene(k)), seen(random_scene(1000 + k))) for k in range(600)]
    assert np.isfinite(found).all(axis=1).sum() <= 6


def test_an_edge_and_a_flat_patch_are_refused():
    edge = seen(lambda u, v: 128.0 + 60.0 * np.tanh(u))
    flat = np.full((1, PATCH_PIXELS), 90, np.uint8)
    assert np.isnan(aligned(edge, edge)).all()
    assert np.isnan(aligned(flat, flat)).all()
    assert np.isnan(aligned(flat, seen(random_scene(0)))).all()


def test_what_lies_farther_than_asked_for_is_refused():
    scene = random_scene(5)
    assert np.isnan(aligned(seen(scene, x=2.6), seen(scene))).all()


OUTSIDE = [(np.nan, 0.0), (0.0, np.inf), (9.0, 0.0), (0.0, -1e30)]


@pytest.mark.parametrize(
    "wrong",
    [
        *({"zoom": zoom} for zoom in (0.3, 1e-30, np.nan)),
        *({"centre": np.array([centre], np.float32)} for centre in OUTSIDE),
    ],
    ids=str,
)
def test_what_the_patch_does_not_reach_is_refused(wrong):
    image = seen(random_scene(0))
    assert np.isnan(aligned(image, image, **wrong)).all()


def test_patches_are_the_pixels_around_the_keypoints():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (240, 320), dtype=np.uint8)
    found = extract(image, Config().orb)
    patches = patches_around(found.pyramid, found.xy, found.octave)
    for level in (0, 3):
        of_level = np.flatnonzero(found.octave == level)
        assert len(of_level)
        pixels = found.pyramid.level(level)
        ratio = np.array(image.shape[::-1]) / pixels.shape[::-1]
        for i in of_level[:20]:
            x, y = np.rint((found.xy[i] + 0.5) / ratio - 0.5).astype(int)
            around = pixels[
                y - PATCH_RADIUS : y + PATCH_RADIUS + 1, x - PATCH_RADIUS : x + PATCH_RADIUS + 1
            ]
            assert np.array_equal(patches[i], around.ravel())


IMAGE = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
CAMERA = Camera(400.0, 400.0, 320.0, 240.0, 0.5, 640, 480)
CONTEXT = Context.create(CAMERA, Config())


def features_at(u, v, octave, n):
    xy = np.tile(np.array([[u, v]], np.float32), (n, 1))
    return Features(
        xy,
        np.full(n, octave, np.uint8),
        np.zeros(n, np.float32),
        np.zeros((n, 32), np.uint8),
        xy[:, 0] - 20.0,
    )


def extracted_at(u, v, octave, n):
    return Extracted(features_at(u, v, octave, n), build_pyramid(IMAGE, Config().orb))


def one_landmark(shift=0.0):
    """Make a map of one keyframe with a landmark 10 m ahead, and the patches of the keyframe."""
    map_ = Map(CONTEXT.scales)
    patch = seen(random_scene(1))
    keyframe = map_.add_keyframe(features_at(320, 240, 2, 1), np.eye(4), 0.0, 0)
    ids = map_.add_landmarks(np.array([[3.0, 0.0, 10.0]]), np.zeros((1, 4), np.uint64), keyframe)
    link_many(map_.arrays, np.array([0]), ids)
    at = map_.arrays.xy[:1].copy()
    return map_, KeyframePatches(keyframe, patch, np.full((1, 2), shift, np.float32), at)


def patches_of(map_, ids, keyframes, capacity=3):
    """Return the result of ``RecentPatches.of``, and the pixels and shifts of each patch."""
    recent = RecentPatches(capacity)
    for one in keyframes:
        recent.add(one)
    known = recent.of(map_, np.array(ids, np.int32))
    return known, known.pixels[known.where], known.shift[known.where]


def test_a_landmark_has_the_patch_of_a_keyframe_with_its_size_and_place():
    map_, recent = one_landmark(shift=0.5)
    known, pixels, shift = patches_of(map_, [0], [recent])
    assert np.array_equal(pixels, seen(random_scene(1)))
    assert known.size.tolist() == [CONTEXT.scales[2]]
    assert known.T_cw[known.view].tolist() == [np.eye(4).tolist()]
    assert shift.tolist() == [[0.5, 0.5]]


def test_a_landmark_has_the_patch_of_the_newest_keyframe_that_observes_it():
    map_, first = one_landmark()
    second, other = (seen(random_scene(k)) for k in (2, 3))
    both = np.concatenate([second, other])
    for k in (1, 2):
        T_cw = np.eye(4)
        T_cw[2, 3] = -2.0 * k
        map_.add_keyframe(features_at(320, 240, 0, 2), T_cw, 0.1 * k, k)
    link_many(map_.arrays, np.array([1]), np.array([0], np.int32))
    nothing, at = np.zeros((2, 2), np.float32), map_.arrays.xy[1:3].copy()
    recent = [first, *(KeyframePatches(k, both, nothing, at) for k in (1, 2))]
    known, pixels, _ = patches_of(map_, [0], recent)
    assert np.array_equal(pixels, second)
    assert known.T_cw[known.view, 2, 3].tolist() == [-2.0]
    # One keyframe is forgotten, and another one no longer observes the landmark.
    assert np.array_equal(patches_of(map_, [0], recent, capacity=2)[1], second)
    assert len(patches_of(map_, [0], recent, capacity=1)[1]) == 0
    unlink(map_.arrays, 1)
    assert np.array_equal(patches_of(map_, [0], recent)[1], first.pixels)


def test_recent_patches_are_those_of_the_newest_keyframes():
    recent = RecentPatches(2)
    ones = [
        KeyframePatches(
            k,
            np.full((n, PATCH_PIXELS), k, np.uint8),
            np.full((n, 2), k, np.float32),
            np.full((n, 2), 10 * k, np.float32),
        )
        for k, n in ((3, 2), (4, 5), (7, 1))
    ]
    for count, one in enumerate(ones, 1):
        recent.add(one)
        kept = ones[max(0, count - 2) : count]
        assert [k.keyframe for k in recent.all()] == [k.keyframe for k in kept]
        for is_, wanted in zip(recent.all(), kept, strict=True):
            assert np.array_equal(is_.pixels, wanted.pixels)
            assert np.array_equal(is_.shift, wanted.shift)
            assert np.array_equal(is_.xy, wanted.xy)


def test_landmarks_that_no_recent_keyframe_observes_have_none():
    map_, recent = one_landmark()
    assert len(patches_of(map_, [0], [])[1]) == 0
    assert len(patches_of(map_, [], [recent])[1]) == 0


def wide_scene(texture):
    """Return the image of a plane 10 m ahead of the world's origin."""

    def image(T_cw):
        u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)])
        T = inverse(T_cw)
        directions = np.tensordot(T[:3, :3], rays, axes=1)
        x, y = T[:2, 3, None, None] + directions[:2] * (10.0 - T[2, 3]) / directions[2]
        return np.rint(texture(40.0 * x, 40.0 * y)).clip(0, 255).astype(np.uint8)

    return image


@pytest.mark.parametrize(
    "motion",
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.2, -0.1, -1.5, 0.0, 0.0, 0.0],  # ahead
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.4],  # rolled
        [-0.6, 0.0, -1.0, 0.05, 0.15, -0.3],
    ],
)
def test_matches_are_aligned_however_the_camera_has_moved(motion):
    image = wide_scene(random_scene(4))
    T_cw = se3_exp(np.array(motion))
    rng = np.random.default_rng(0)
    n = 40
    points = np.column_stack([rng.uniform(-4, 4, n), rng.uniform(-3, 3, n), np.full(n, 10.0)])

    def frame_at(T, off):
        uvr = CAMERA.project(transform(T, points)).astype(np.float32)
        xy = np.rint(uvr[:, :2] + off).astype(np.float32)
        features = replace(features_at(0, 0, 0, n), xy=xy)
        frame = frame_of(Extracted(features, build_pyramid(image(T), Config().orb)), T_cw=T)
        return frame.matching(np.arange(n), np.arange(n, dtype=np.int32), points), uvr[:, :2]

    first, seen_at = frame_at(np.eye(4), 0.0)
    map_ = Map(CONTEXT.scales)
    map_.add_keyframe(first.features, first.T_cw, 0.0, 0)
    ids = map_.add_landmarks(points, np.zeros((n, 4), np.uint64), 0)
    link_many(map_.arrays, np.arange(n), ids)
    recent = RecentPatches(2)
    pixels = patches_around(first.extracted.pyramid, first.features.xy, first.features.octave)
    recent.add(KeyframePatches(0, pixels, seen_at - first.features.xy, first.features.xy))

    frame, truth = frame_at(T_cw, rng.uniform(-0.5, 0.5, (n, 2)))
    inside = ((truth > 20) & (truth < [620, 460])).all(axis=1)
    frame = frame.without(~inside)
    shift = align_matches(
        frame, recent.of(map_, ids), CONTEXT.scales, CAMERA.intrinsics, Config().alignment
    )
    error = np.linalg.norm(frame.features.xy + shift - truth, axis=1)[inside]
    assert np.isnan(shift[~inside]).all()
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.05
    assert np.nanquantile(error, 0.9) < 0.15


def three_views(certain):
    """Make a map of three keyframes that see 40 points of a plane, each at the nearest whole pixel
    to a place half a pixel away, and the patches around these keypoints. Keyframe ``certain`` is
    aligned to the points.

    Returns:
        The map, the patches, and the ``(3, 40, 2)`` true positions.
    """
    image, rng, n = wide_scene(random_scene(4)), np.random.default_rng(0), 40
    points = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), np.full(n, 10.0)])
    map_, patches, truth = Map(CONTEXT.scales), [], []
    ids = map_.add_landmarks(points, np.zeros((n, 4), np.uint64), 0)
    for k, motion in enumerate(([0.0] * 6, [0.1, 0, -0.4, 0, 0, 0.05], [0.2, 0, -0.8, 0, 0, 0.1])):
        T_cw = se3_exp(np.array(motion))
        at = CAMERA.project(transform(T_cw, points))[:, :2].astype(np.float32)
        pixel = np.rint(at + rng.uniform(-0.5, 0.5, (n, 2))).astype(np.float32)
        shift = at - pixel if k == certain else np.zeros_like(pixel)
        features = replace(features_at(0, 0, 0, n), xy=pixel + shift)
        map_.add_keyframe(features, T_cw, 0.1 * k, k, 4 if k == certain else 1)
        link_many(map_.arrays, n * k + np.arange(n), ids)
        pixels = patches_around(
            build_pyramid(image(T_cw), Config().orb), pixel, np.zeros(n, np.uint8)
        )
        patches.append(KeyframePatches(k, pixels, shift, features.xy))
        truth.append(at)
    return map_, tuple(patches), np.array(truth)


@pytest.mark.parametrize("certain", [0, 1, 2])
def test_observations_of_keyframes_are_aligned_to_the_certain_one(certain):
    map_, patches, truth = three_views(certain)
    before = map_.arrays.xy[: map_.n_rows].copy()
    rows, xy = align_observations(map_, 2, patches, CONTEXT)
    assert np.array_equal(map_.arrays.xy[: map_.n_rows], before)
    assert (rows // 40 != certain).all()
    assert len(rows) > 0.8 * 80
    error = np.linalg.norm(xy - truth.reshape(-1, 2)[rows], axis=1)
    assert np.median(np.linalg.norm(before - truth.reshape(-1, 2), axis=1)[rows]) > 0.3
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.9) < 0.15
    # Their patches now lie around the landmarks.
    map_.move_observations(rows, xy, 4)
    known, _, shift = patches_of(map_, range(40), patches)
    assert set(known.view) == {2}
    aligned = np.isin(80 + np.arange(40), rows) | (certain == 2)
    wanted = truth[2] - np.rint(patches[2].xy - patches[2].shift)
    assert np.quantile(np.abs(shift - wanted)[aligned], 0.9) < 0.15
    # The second time, there is nothing left to be aligned.
    assert len(align_observations(map_, 2, patches, CONTEXT)[0]) < 10


def test_observations_without_a_certain_one_or_without_a_patch_are_not_aligned():
    map_, patches, _ = three_views(certain=-1)
    assert len(align_observations(map_, 2, patches, CONTEXT)[0]) == 0
    map_, patches, _ = three_views(certain=0)
    assert len(align_observations(map_, 2, patches[1:], CONTEXT)[0]) == 0
    assert len(align_observations(map_, 2, (), CONTEXT)[0]) == 0
    rows, _ = align_observations(map_, 2, patches[::2], CONTEXT)
    assert set(rows // 40) == {2}


def test_what_lies_behind_a_camera_or_is_seen_from_behind_has_no_warp():
    X = np.array([[0.0, 0.0, 10.0]])
    beyond, turned = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    beyond[2, 3], turned[2, 3] = -12.0, 20.0
    one, ones = np.array([0]), np.ones(1)

    def warp(T_cw, T_seen):
        return warps(T_cw, X, T_seen[None], one, ones, ones, CAMERA.intrinsics)

    assert warp(np.eye(4), np.eye(4)).tolist() == [np.eye(2).tolist()]
    assert np.isnan(warp(beyond, np.eye(4))).all()
    assert np.isnan(warp(np.eye(4), beyond)).all()
    assert np.isnan(warp(turned, np.eye(4))).all()


def test_matches_without_a_patch_are_not_aligned():
    map_, recent = one_landmark()
    known, _, _ = patches_of(map_, [0], [recent])
    frame = frame_of(extracted_at(100, 50, 0, 1)).matching(slice(None), 7, 1.0)
    arguments = CONTEXT.scales, CAMERA.intrinsics, Config().alignment
    assert np.isnan(align_matches(frame, known, *arguments)).all()
    assert align_matches(frame, NO_PATCHES, *arguments) is None
    frame = replace(frame, extracted=replace(frame.extracted, pyramid=None))
    assert align_matches(frame, known, *arguments) is None


def test_an_aligned_frame_observes_where_matches_were_aligned_to():
    shift = np.array([[0.5, -0.25], [np.nan, np.nan], [1.0, 1.0]], np.float32)
    frame = frame_of(extracted_at(100, 50, 0, 3))
    frame = replace(frame, landmark=np.array([0, 1, -1], np.int32), shift=shift)
    assert frame.aligned.tolist() == [True, False, False]
    observed = frame.refined_features()
    assert observed.xy.tolist() == [[100.5, 49.75], [100.0, 50.0], [100.0, 50.0]]
    assert observed.u_right.tolist() == [80.5, 80.0, 80.0]
    assert frame.features.xy[0].tolist() == [100.0, 50.0]


def test_a_pose_follows_aligned_matches():
    """Half of the matches contradict the other half by half a pixel.

    Aligned matches have four times the weight of other matches.
    """
    rng = np.random.default_rng(0)
    n = 100
    xyz = np.column_stack([rng.uniform(-8, 8, (n, 2)), rng.uniform(8, 30, n)])
    uvr = CAMERA.project(xyz).astype(np.float32)
    features = replace(features_at(100, 50, 0, n), xy=uvr[:, :2], u_right=uvr[:, 2])
    frame = frame_of(features).matching(np.arange(n), np.arange(n, dtype=np.int32), xyz)
    shift = np.full((n, 2), np.nan, np.float32)
    shift[::2] = 0.5, 0.0
    found = refine(frame, np.eye(4), NO_LANDMARKS, CONTEXT, shift)
    assert found.n_inliers == n
    moved = CAMERA.project(transform(found.T_cw, xyz))[:, 0] - uvr[:, 0]
    certainty = Config().alignment.certainty
    assert moved.mean() == pytest.approx(0.5 * certainty / (certainty + 1), abs=0.02)


def test_the_map_knows_how_sure_each_observation_is(two_keyframes):
    frame, published = two_keyframes
    known = published.view.patches
    pixels, shift = known.pixels[known.where], known.shift[known.where]
    map_ = published.wait()
    sure = Config().alignment.certainty
    # One feature is tracked and aligned, one is only tracked, and one is new.
    assert map_.arrays.certainty[map_.rows(1)].tolist() == [sure, 1, sure]
    assert map_.arrays.xy[map_.rows(1)][0].tolist() == [100.5, 49.75]
    assert np.array_equal(pixels[0], IMAGE[42:59, 92:109].ravel())
    assert shift[known.ids == frame.landmark[0]].tolist() == [[0.5, -0.25]]
    assert shift[np.isin(known.ids, frame.landmark[1:])].tolist() == [[0.0, 0.0]] * 2


@pytest.fixture
def two_keyframes():
    """Add a second keyframe, which tracks two landmarks of the first keyframe."""
    from vslam.loopclosure.detector import NoDetector
    from vslam.loopclosure.verifier import Verifier
    from vslam.method.closing import LoopClosing

    closing = LoopClosing(NoDetector(), Verifier(CONTEXT), CONTEXT, threads=1)
    mapper = Mapper(CONTEXT, closing, Workers(1))
    published = mapper.published
    first, second = (frame_of(extracted_at(100, 50, 0, 3), k, 0.1 * k) for k in range(2))
    published.record(first)
    first = mapper.insert(first, None)
    published.record(second)
    shift = np.array([[0.5, -0.25], [np.nan] * 2, [np.nan] * 2], np.float32)
    seen = second.matching(np.arange(2), first.landmark[:2], first.xyz[:2])
    return mapper.insert(replace(seen, shift=shift), None), published
