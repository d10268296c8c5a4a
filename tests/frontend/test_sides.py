"""A stereo rig with different brightness on both sides is detected and corrected."""

from __future__ import annotations

from functools import partial, reduce
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from vslam.config import Config
from vslam.frontend.extraction import FrameImages
from vslam.frontend.sides import balanced, compare_sides, with_pair
from vslam.run.rig import is_synchronised, measure_offset, offset_warnings, rig_warnings
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Sides
from vslam.types.geometry import inverse, se3_exp
from vslam.types.states import ComparedSides

CONFIG = Config().stereo
CAMERA = Camera(300.0, 300.0, 200.0, 100.0, 0.5, 400, 200)
DISPARITY = 7


def scene(mean: float = 110.0, spread: float = 35.0) -> tuple[np.ndarray, np.ndarray]:
    rough = gaussian_filter(np.random.default_rng(0).normal(size=(200, 420)), 1.5)
    grey = np.clip(mean + spread * rough / rough.std(), 0, 255)
    return grey[:, :400].astype(np.uint8), grey[:, DISPARITY : 400 + DISPARITY].astype(np.uint8)


def darker(image: np.ndarray, stops: float, bias: float = 0.0) -> np.ndarray:
    return np.clip(np.rint(image * 2.0**-stops + bias), 0, 255).astype(np.uint8)


def balance(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return balanced(left, right, compare_sides(left, right, CONFIG))


def test_sides_alike_stay_the_same_objects():
    left, right = scene()
    assert compare_sides(left, right, CONFIG) == Sides()
    one, two = balance(left, right)
    assert one is left
    assert two is right


@pytest.mark.parametrize("stops", [0.5, 1.0, 2.0, 3.0])
def test_a_dark_side_is_measured_in_stops_and_brightened(stops):
    left, right = scene()
    for ours, theirs, sign in ((left, darker(right, stops), 1), (darker(left, stops), right, -1)):
        found = compare_sides(ours, theirs, CONFIG)
        assert found.darker_stops == pytest.approx(sign * stops, abs=0.08)
        one, two = balance(ours, theirs)
        for image, clean in ((one, left), (two, right)):
            assert np.abs(image.astype(float) - clean).mean() < 0.6 + 0.6 * 2**stops


def test_a_shift_of_the_black_level_is_undone_with_the_gain():
    left, right = scene()
    _, mended = balance(left, darker(right, 1.0, bias=30.0))
    assert np.abs(mended.astype(float) - right).mean() < 2.0


def test_a_clipped_side_is_measured_by_its_dark_half():
    left, right = scene(mean=200.0)
    found = compare_sides(np.minimum(2.0 * left, 255).astype(np.uint8), right, CONFIG)
    assert found.darker_stops == 0.0  # nearly all of it is white
    left, right = scene(mean=110.0)
    bright = np.minimum(2.0 * left, 255).astype(np.uint8)
    assert compare_sides(bright, right, CONFIG).darker_stops == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("columns", [100, 160, 240, 400])
def test_a_side_that_is_white_in_part_is_no_brighter_one(columns):
    left, right = scene()
    glare = left.copy()
    glare[:, :columns] = 255
    for ours, theirs in ((glare, right), (right, glare)):
        assert compare_sides(ours, theirs, CONFIG) == Sides()
    assert balance(glare, right)[0] is glare


@pytest.mark.parametrize("side", [0, 1])
def test_a_bright_strip_that_one_side_sees_is_no_gain(side):
    left, right = scene(mean=90.0, spread=20.0)
    pair = [left.copy(), right.copy()]
    for image in pair:
        image[:50] = 255  # the sky
    pair[side][50:66] = 150  # outside the view of the other image
    assert compare_sides(*pair, CONFIG) == Sides()
    assert balance(*pair)[side] is pair[side]


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("share", [0.4, 0.55, 0.7, 0.85])
@pytest.mark.parametrize("sky", [160.0, 190.0, 220.0, 245.0])
@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_a_sky_that_one_side_sees_is_no_gain(side, share, sky, noise):
    """The other camera sees the underside of a bridge instead of the sky."""
    pair = list(scene(mean=100.0, spread=25.0))
    rows = int(share * 200)
    grain = noise * np.random.default_rng(1).normal(size=(rows, 400))
    pair[side][:rows] = np.clip(sky + grain, 0, 255)
    assert compare_sides(*pair, CONFIG) == Sides()
    assert balance(*pair)[1 - side] is pair[1 - side]


def test_a_gain_is_told_beside_glare_on_both_sides():
    left, right = scene()
    left[:, :100], right[:, :100] = 255, 255
    dimmed = np.where(right == 255, 255, darker(right, 1.0)).astype(np.uint8)
    assert compare_sides(left, dimmed, CONFIG).darker_stops == pytest.approx(1.0, abs=0.1)


def test_what_is_no_gain_is_left_alone():
    left, right = scene()
    covered = right.copy()
    covered[:, :160] = 20
    assert balance(left, covered)[1] is covered
    assert compare_sides(left, np.full_like(left, 90), CONFIG) == Sides()


def test_a_small_difference_is_left_alone():
    left, right = scene()
    assert compare_sides(left, darker(right, 0.2), CONFIG) == Sides()


def test_a_black_side_is_named_but_not_by_night():
    left, right = scene()
    black = np.full_like(left, 2)
    assert compare_sides(left, black, CONFIG) == Sides(black="right")
    assert compare_sides(black, right, CONFIG) == Sides(black="left")
    assert compare_sides(black, black, CONFIG) == Sides()
    assert compare_sides(darker(left, 5), darker(right, 5), CONFIG).black == ""


def test_video_of_limited_range_needs_other_limits():
    """In such a video, black is 16 and white is 235."""
    limited = CONFIG.model_copy(update={"black_below": 22.0, "clipped_from": 230})
    left, right = scene()
    black = np.full_like(left, 16)
    assert compare_sides(left, black, CONFIG) == Sides()
    assert compare_sides(left, black, limited) == Sides(black="right")
    bright = np.minimum(2.0 * left, 235).astype(np.uint8)
    assert compare_sides(bright, right, CONFIG) == Sides()
    assert compare_sides(bright, right, limited).darker_stops == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("stops", [1.0, 2.0])
def test_disparities_stay_true_when_a_side_is_dark(stops):
    """Without the correction, a side that is two stops darker gives few and wrong matches."""
    left, right = scene()
    context = Context.create(CAMERA, Config())
    clean, dark = (
        FrameImages(left, partial(darker, right, by), context).extracted.features
        for by in (0.0, stops)
    )
    for features, least in ((clean, 0.9), (dark, 0.7)):
        d = features.xy[:, 0] - features.u_right
        found = np.isfinite(d)
        assert found.mean() > least * np.isfinite(clean.u_right).mean()
        assert np.abs(np.median(d[found]) - DISPARITY) < 0.05
        assert np.mean(np.abs(d[found] - DISPARITY) < 0.5) > 0.95


def test_drives_have_clocks_of_their_own():
    """A second drive visits the same places one second later by its own clock.

    This is not treated as motion.
    """
    two = driven(turned_px=0.4)
    n = two.n_keyframes
    alone = measure_offset(two, CAMERA)
    two.sessions = np.arange(n) % 2
    two.timestamps = two.timestamps - 3.0 * two.sessions
    both = measure_offset(two, CAMERA)
    assert both == pytest.approx(alone, rel=0.1)


def warned(each: list[Sides]) -> list[str]:
    return rig_warnings(reduce(with_pair, each, ComparedSides()))


def test_warnings_say_what_was_seen_and_done():
    dark, black, fine = Sides(darker_stops=-1.5), Sides(black="right"), Sides()
    assert warned([fine] * 100) == []
    assert warned([fine] * 100 + [dark, black, black]) == []
    (said,) = warned([dark] * 7 + [fine] * 3)
    assert "left image was 1.5 stops darker than the right image in 7 of 10 frames" in said
    (said,) = warned([black] * 4 + [fine] * 6)
    assert "right image was black in 4 of 10 frames" in said
    assert "left image alone" in said
    (said,) = warned([Sides(black="left")] * 4)
    assert "these frames are lost" in said


TWIST = np.array([0.3, 0.0, -8.0, 0.0, -0.3, 0.0])  # per second: ahead and to the right


def driven(delay_s: float = 0.0, turned_px: float = 0.0, n: int = 5000) -> SimpleNamespace:
    """Make a map of 10 keyframes with exact left observations and wrong right observations."""
    rng = np.random.default_rng(1)
    times = 0.1 * np.arange(10)
    T_cw = np.array([se3_exp(TWIST * t) for t in times])
    keyframe = rng.integers(0, 10, n)
    z = rng.uniform(3.0, 30.0, n)
    in_camera = np.stack([rng.uniform(-0.5, 0.5, n) * z, rng.uniform(-0.2, 0.2, n) * z, z], axis=1)
    T_wc = np.array([inverse(T) for T in T_cw])[keyframe]
    xyz = np.einsum("nij,nj->ni", T_wc[:, :3, :3], in_camera) + T_wc[:, :3, 3]
    late = np.array([se3_exp(TWIST * (t + delay_s)) for t in times])[keyframe]
    seen = np.einsum("nij,nj->ni", late[:, :3, :3], xyz) + late[:, :3, 3]
    u = CAMERA.fx * in_camera[:, 0] / z + CAMERA.cx
    u_right = CAMERA.fx * (seen[:, 0] - CAMERA.baseline) / seen[:, 2] + CAMERA.cx - turned_px
    arrays = SimpleNamespace(
        landmark=np.arange(n), keyframe=keyframe, T_cw=T_cw, xyz=xyz,
        xy=np.stack([u, u], axis=1), u_right=u_right + rng.normal(0.0, 0.2, n),
    )  # fmt: skip
    return SimpleNamespace(
        arrays=arrays, n_rows=n, n_keyframes=10, timestamps=times, sessions=np.zeros(10, int),
        living_keyframes=lambda: np.arange(10), scalars=SimpleNamespace(session=0),
    )  # fmt: skip


def test_residuals_tell_a_turned_side_from_a_late_one():
    assert measure_offset(driven(), CAMERA) == pytest.approx(0.0, abs=0.03)
    assert measure_offset(driven(turned_px=0.4), CAMERA) == pytest.approx(-0.4, abs=0.03)
    assert measure_offset(driven(delay_s=0.005), CAMERA) is None


def test_a_map_shows_that_its_right_images_are_not_late():
    assert is_synchronised(driven(), CAMERA)
    assert is_synchronised(driven(turned_px=0.4), CAMERA)
    assert not is_synchronised(driven(delay_s=0.0015), CAMERA)
    assert not is_synchronised(driven(n=1000), CAMERA)
    now = driven()
    now.scalars.session = 1  # all keyframes are those of an earlier drive
    assert not is_synchronised(now, CAMERA)


def test_a_map_that_cannot_tell_says_nothing():
    assert measure_offset(driven(n=1000), CAMERA) is None
    assert measure_offset(driven(), CAMERA.left_camera()) is None
    still = driven()
    still.timestamps = 100.0 * np.arange(10)
    assert measure_offset(still, CAMERA) is None  # in gaps, the motion is unknown
    assert offset_warnings(None, CAMERA) == []


def test_a_fault_of_the_rig_is_said_with_its_size():
    assert offset_warnings(0.05, CAMERA) == []
    (said,) = offset_warnings(-0.3, CAMERA)
    assert "0.30 pixels" in said
    assert "3.4 arc minutes" in said
