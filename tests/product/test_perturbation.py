from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
import pytest

from vslam.datasets.frames import Source, TimedFrame, stored_frames
from vslam.datasets.perturbation import contact_sheet, ou_walk, parse_perturbation, perturbed
from vslam.support.errors import InputError
from vslam.types.camera import Camera

TIMES = 0.1 * np.arange(300)
LAWS = ("brightness", "gamma", "flicker", "noise", "blur", "occlusion")
RAMP = np.tile(np.arange(256, dtype=np.uint8), (64, 1))
TEXTURE = np.random.default_rng(1).integers(0, 256, (64, 256), dtype=np.uint8)


def walk_of(duration, deviation, rng, jumps=()):
    return np.fromiter(islice(ou_walk(deviation, rng, jumps), int(duration / 0.01) + 1), float)


@pytest.mark.slow
def test_walk_has_the_stated_deviation_and_correlation_time():
    walk = walk_of(20_000.0, 0.35, np.random.default_rng(0))
    # 20,000 s contain about 5,000 independent values, so that the deviation is known to about 1 %.
    assert walk.std() == pytest.approx(0.35, rel=0.04)
    assert walk.mean() == pytest.approx(0.0, abs=0.02)
    for lag_s in (1.0, 2.0, 4.0):
        lag = round(lag_s / 0.01)
        correlation = np.corrcoef(walk[:-lag], walk[lag:])[0, 1]
        assert correlation == pytest.approx(np.exp(-lag_s / 2.0), abs=0.04)


def test_walk_begins_in_the_stationary_state():
    first = [walk_of(0.0, 2.0, np.random.default_rng(seed))[0] for seed in range(2000)]
    assert np.std(first) == pytest.approx(2.0, rel=0.05)


def test_jumps_are_wider():
    after = [walk_of(1.0, 1.0, np.random.default_rng(seed), [1.0])[100] for seed in range(2000)]
    assert np.std(after) == pytest.approx(1.5, rel=0.05)


def test_brightness_has_the_stated_strength():
    # Shifts of one grey value over many seeds, where neither clip is reached.
    levels = []
    for seed in range(400):
        law = parse_perturbation("brightness:0.5", seed)
        levels.append(law.apply(0, 0.0, RAMP, RAMP)[0][0, [60, 120]].astype(float))
    low, high = np.array(levels).T
    gain = (high - low) / 60.0
    assert np.log(gain).std() == pytest.approx(0.175, rel=0.1)
    assert (low - 60.0 * gain).std() == pytest.approx(10.0, rel=0.1)


def test_brightness_is_clipped_and_quantised():
    law = parse_perturbation("brightness:1", 3)
    out = np.stack([law.apply(k, float(k), RAMP, RAMP)[0][0] for k in range(2000)])
    assert out.dtype == np.uint8
    assert (np.diff(out.astype(int), axis=1) >= 0).all()
    contrast = (out[:, 130].astype(float) - out[:, 120]) / 10.0
    assert contrast.max() <= np.exp(0.7) + 0.1
    unclipped = (out[:, 100] > 0) & (out[:, 150] < 255)
    assert contrast[unclipped].min() >= np.exp(-1.2) - 0.1


def test_brightness_changes_slowly_but_sometimes_jumps():
    law = parse_perturbation("brightness", 0)
    mid = np.array(
        [law.apply(k, 0.1 * k, RAMP[:1], RAMP[:1])[0][0, 128] for k in range(6000)], float
    )
    steps = np.abs(np.diff(mid))
    assert np.median(steps) < 15
    # 10 minutes contain about 30 jumps. Many are larger than the random walk in 0.1 s.
    assert 8 <= (steps > 60).sum() <= 40


@pytest.mark.parametrize("spec", ["", "none", " none "])
def test_identity(spec):
    law = parse_perturbation(spec, 0)
    left, right = law.apply(5, 0.5, TEXTURE, RAMP)
    assert left is TEXTURE
    assert right is RAMP
    assert law.name == "none"


@pytest.mark.parametrize("name", LAWS)
def test_strength_zero_is_the_identity(name):
    left, right = parse_perturbation(f"{name}:0", 0).apply(7, 0.7, TEXTURE, RAMP)
    np.testing.assert_array_equal(left, TEXTURE)
    np.testing.assert_array_equal(right, RAMP)


@pytest.mark.parametrize("name", LAWS)
def test_depends_on_seed_and_frame_only(name):
    spec = f"{name}:1.5"
    law = parse_perturbation(spec, 7)
    once = [law.apply(k, 0.1 * k, TEXTURE, TEXTURE) for k in range(40)]
    again = parse_perturbation(spec, 7)
    with ThreadPoolExecutor(4) as pool:
        shuffled = list(
            pool.map(lambda k: again.apply(k, 0.1 * k, TEXTURE, TEXTURE), range(39, -1, -1))
        )
    for one, other in zip(once, reversed(shuffled), strict=True):
        np.testing.assert_array_equal(one, other)
    assert all(image.dtype == np.uint8 and image.shape == TEXTURE.shape for image in once[0])
    if name != "blur":
        other_seed = parse_perturbation(spec, 8).apply(0, 0.0, TEXTURE, TEXTURE)
        assert not np.array_equal(once[0], other_seed)


@pytest.mark.parametrize("name", LAWS)
def test_both_cameras_alike_but_for_noise(name):
    left, right = parse_perturbation(name, 0).apply(9, 0.9, TEXTURE, TEXTURE)
    assert np.array_equal(left, right) == (name != "noise")
    assert not np.array_equal(left, TEXTURE)


@pytest.mark.parametrize("name", ["brightness", "gamma", "occlusion"])
def test_dropped_frames_do_not_change_the_light(name):
    whole, every_third = (parse_perturbation(name, 4) for _ in range(2))
    for k in range(0, 100, 7):
        t = TIMES[3 * k]
        np.testing.assert_array_equal(
            whole.apply(3 * k, t, TEXTURE, RAMP), every_third.apply(k, t, TEXTURE, RAMP)
        )


@pytest.mark.parametrize(("spec", "apart"), [
    ("none", True),
    ("brightness,noise:2", True),
    ("brightness,stereo_gain:1", False),
])  # fmt: skip
def test_a_side_alone_is_perturbed_as_in_the_pair(spec, apart):
    pair = TEXTURE, RAMP
    frames = [
        TimedFrame(t, lambda image_map: pair, (lambda: TEXTURE, lambda: RAMP)) for t in TIMES[:3]
    ]
    last = list(perturbed(iter(frames), parse_perturbation(spec, 4)))[-1]
    assert (last.sides is not None) == apart
    if last.sides is not None:
        for alone, together in zip(last.sides, last.read(map), strict=True):
            np.testing.assert_array_equal(alone(), together)


def test_a_side_is_not_offered_alone_where_the_source_reads_both():
    frames = [TimedFrame(0.0, lambda image_map: (TEXTURE, RAMP))]
    assert next(perturbed(iter(frames), parse_perturbation("brightness", 4))).sides is None


def test_time_of_day_does_not_matter():
    def seen(times):
        frames = [TimedFrame(t, lambda image_map: (TEXTURE, RAMP)) for t in times.tolist()]
        last = list(perturbed(iter(frames), parse_perturbation("brightness", 4)))[-1]
        return last.timestamp, *last.read(map)

    early, late = seen(TIMES[:51]), seen(TIMES[:51] + 1.3e9)
    assert late[0] == 1.3e9 + TIMES[50]
    np.testing.assert_array_equal(early[1:], late[1:])
    assert not np.array_equal(early[1], TEXTURE)


@pytest.mark.slow
def test_a_walk_is_drawn_as_far_as_needed_and_its_beginning_stays():
    far, near = (parse_perturbation("brightness,gamma", 4) for _ in range(2))
    far.apply(0, 3600.0, TEXTURE, RAMP)
    for t in (7.5, 0.0):
        np.testing.assert_array_equal(
            far.apply(0, t, TEXTURE, RAMP), near.apply(0, t, TEXTURE, RAMP)
        )


def test_composition_applies_the_laws_in_order():
    both = parse_perturbation("brightness:1.5, blur:0.5", 2)
    assert both.name == "brightness:1.5,blur:0.5"
    first = parse_perturbation("brightness:1.5", 2)
    second = parse_perturbation("blur:0.5", 2)
    expected = second.apply(30, 3.0, *first.apply(30, 3.0, TEXTURE, RAMP))
    np.testing.assert_array_equal(both.apply(30, 3.0, TEXTURE, RAMP), expected)


def test_default_strength_is_one():
    assert parse_perturbation("gamma", 0).name == "gamma:1"


def test_noise_has_the_stated_deviation():
    grey = np.full((200, 300), 128, np.uint8)
    left, right = parse_perturbation("noise:0.5", 0).apply(0, 0.0, grey, grey)
    for image in (left, right):
        assert (image.astype(float) - 128).std() == pytest.approx(4.0, rel=0.03)
    correlation = np.corrcoef(left.ravel(), right.ravel())[0, 1]
    assert abs(correlation) < 0.02


def test_flicker_has_the_stated_deviation():
    law = parse_perturbation("flicker", 0)
    level = np.array(
        [law.apply(k, 0.1 * k, RAMP[:1], RAMP[:1])[0][0, 100] for k in range(3000)], float
    )
    assert np.log(level / 100.0).std() == pytest.approx(0.15, rel=0.05)


def test_gamma_keeps_black_and_white():
    law = parse_perturbation("gamma:3", 0)
    for k in range(0, 300, 30):
        out = law.apply(k, 0.1 * k, RAMP, RAMP)[0][0]
        assert (out[0], out[255]) == (0, 255)


def test_blur_has_the_stated_width():
    point = np.zeros((41, 41), np.uint8)
    point[20, 20] = 255
    rows = parse_perturbation("blur:2", 0).apply(0, 0.0, point, point)[0].sum(axis=0, dtype=float)
    x = np.arange(41) - 20
    assert np.sqrt((rows * x**2).sum() / rows.sum()) == pytest.approx(3.0, rel=0.15)


def test_occlusion_covers_the_stated_area_and_moves_every_second():
    grey = np.zeros((200, 600), np.uint8)
    law = parse_perturbation("occlusion:2", 1)
    second = [law.apply(k, 0.1 * k, grey, grey)[0] for k in range(10)]
    for image in second[1:]:
        np.testing.assert_array_equal(image, second[0])
    assert (second[0] > 0).mean() == pytest.approx(0.3, abs=0.01)
    assert not np.array_equal(law.apply(10, 1.0, grey, grey)[0], second[0])


@pytest.mark.parametrize(
    ("spec", "part"),
    [
        ("snow", "unknown law 'snow'"),
        ("brightness,,blur", "unknown law ''"),
        ("none,blur", "unknown law 'none'"),
        ("blur:", "bad strength ''"),
        ("blur:strong", "bad strength 'strong'"),
        ("blur:-1", "bad strength '-1'"),
        ("blur:nan", "bad strength 'nan'"),
        ("blur:11", "0 to 10"),
        ("blur:1,blur:2", "blur is given twice"),
    ],
)
def test_bad_specifications(spec, part):
    with pytest.raises(InputError) as caught:
        parse_perturbation(spec, 0)
    assert part in str(caught.value)
    if "unknown" in part:
        assert all(law in str(caught.value) for law in LAWS)


def test_negative_seed():
    with pytest.raises(InputError, match="--seed -1"):
        parse_perturbation("blur", -1)


def test_the_left_camera_alone_sees_what_it_sees_beside_the_right_one():
    law = parse_perturbation("brightness,noise,occlusion", 3)
    for index in (0, 7):
        both, (alone, nothing) = (
            law.apply(index, 0.1 * index, RAMP, TEXTURE),
            law.apply(index, 0.1 * index, RAMP, None),
        )
        np.testing.assert_array_equal(both[0], alone)
        assert nothing is None


def test_contact_sheet():
    height, width = TEXTURE.shape
    camera = Camera(100.0, 100.0, width / 2, height / 2, 0.5, width, height)
    stored = stored_frames(TIMES, lambda k, image_map: (TEXTURE, RAMP))
    source = Source(dataset="drawn", name="drawn", camera=camera, stored=stored)
    sheet = contact_sheet(source, parse_perturbation("blur", 0), [0, 10, 20])
    assert sheet.shape == (3 * (120 + 30), 4 * (480 + 8))  # a title and a margin each
    assert sheet.dtype == np.uint8
    plain = contact_sheet(source, parse_perturbation("none", 0), [0])
    change = plain[22 : 22 + 120, 3 * 488 : 3 * 488 + 480]
    assert (change == 128).all()


def test_contact_sheet_of_depth_images_with_a_dropped_frame():
    height, width = TEXTURE.shape
    camera = Camera(100.0, 100.0, width / 2, height / 2, 0.1, width, height, depth=True)
    depth = np.ones(TEXTURE.shape, np.float32)
    stored = stored_frames(TIMES[:2], lambda k, image_map: (TEXTURE, depth))
    source = Source(dataset="drawn", name="drawn", camera=camera, stored=stored)
    sheet = contact_sheet(source, parse_perturbation("drop:99", 0), [0, 1])
    assert sheet.shape == (2 * (120 + 30), 3 * (480 + 8))
    dropped = sheet[150 + 22 : 150 + 22 + 120, 488 : 488 + 480]
    assert (dropped == 0).all()
