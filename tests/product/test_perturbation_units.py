"""Each perturbation has the effect that its unit states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from vslam.datasets.frames import Source, stored_frames
from vslam.datasets.imu import Imu
from vslam.datasets.perturbation import LAWS, Scene, laws_for, parse_perturbation
from vslam.datasets.perturbation.depth import dense_depths, disparity
from vslam.datasets.perturbation.kinds import Pair
from vslam.datasets.perturbation.light import FULL_WELL, READ_NOISE
from vslam.datasets.perturbation.motion import line_kernel
from vslam.datasets.perturbation.weather import AIRLIGHT, drops_per_m3, glass_drops
from vslam.support.errors import DroppedFrameError, InputError
from vslam.types.camera import Camera, ImageMap
from vslam.types.imu import GRAVITY, ImuNoise

CAMERA = Camera(400.0, 400.0, 160.0, 80.0, 0.5, 320, 160)
RATE = 0.4  # rad/s, to the right
NOISE = ImuNoise(1e-4, 1e-3)
SAMPLES = np.column_stack(
    [5.0 + 0.005 * np.arange(6000), np.tile([0.0, RATE, 0.0, 0.0, -GRAVITY, 0.0], (6000, 1))]
)


def texture(seed: int, shape: tuple[int, int] = (160, 480)) -> np.ndarray:
    rough = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 1.5)
    return np.clip(128 + 60 * rough / rough.std(), 0, 255).astype(np.uint8)


def wall(metres: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a stereo pair of a wall that faces the cameras. Its disparity is a whole number."""
    d = CAMERA.bf / metres
    assert d == round(d)
    wide = texture(2)
    return wide[:, 80:400], wide[:, 80 + int(d) : 400 + int(d)]


def drive_of(camera: Camera = CAMERA, *, poses: bool = True) -> Source:
    """Make the images of a camera that turns to the right.

    The camera looks at a wall, which moves 4 pixels to the left per frame.
    """
    timestamps = 5.0 + 0.1 * np.arange(20)
    T_wc = np.tile(np.eye(4), (20, 1, 1))
    turned = np.outer(RATE * (timestamps - 5.0), [0.0, 1.0, 0.0])
    T_wc[:, :3, :3] = Rotation.from_rotvec(turned).as_matrix()

    def read(index: int, image_map: ImageMap) -> tuple[np.ndarray, np.ndarray | None]:
        left = texture(3)[:, 4 * index : 4 * index + 320]
        right = texture(3)[:, 20 + 4 * index : 20 + 4 * index + 320]
        return left, None if camera.monocular else right

    return Source(
        dataset="drawn",
        name="wall",
        camera=camera,
        stored=stored_frames(timestamps, read),
        ground_truth=T_wc if poses else None,
        imu=Imu("imu.csv", lambda: SAMPLES, noise=NOISE),
    )


def seen(spec: str, images: tuple, index: int = 3, seed: int = 0, drive: Source | None = None):
    law = parse_perturbation(spec, seed).bound_to(drive or drive_of())
    return law.apply(index, 0.1 * index, *images)


def test_at_the_visibility_contrast_is_five_percent():
    left, right = wall(20.0)  # on the optical axis
    foggy = seen("fog:20", (left, right))
    at = np.s_[60:100, 140:180]
    for clear, hazy in zip((left, right), foggy, strict=True):
        slope = np.polyfit(clear[at].ravel(), hazy[at].ravel(), 1)
        assert slope[0] == pytest.approx(0.05, abs=0.005)
        assert slope[0] * AIRLIGHT + slope[1] == pytest.approx(AIRLIGHT, abs=1.0)
    half = seen("fog:40", (left, right))[0]
    assert np.polyfit(left[at].ravel(), half[at].ravel(), 1)[0] == pytest.approx(
        0.05**0.5, abs=0.01
    )


def test_fog_takes_the_depth_image_where_there_is_one():
    depth = np.full((160, 320), 12.0, np.float32)
    depth[:, :100] = 0.0  # unknown depth counts as far
    camera = Camera(400.0, 400.0, 160.0, 80.0, 0.5, 320, 160, depth=True)
    left, _ = wall(20.0)
    foggy, same = seen("fog:12", (left, depth), drive=drive_of(camera))
    assert same is depth
    at = np.s_[75:85, 155:165]
    slope = np.polyfit(left[at].ravel(), foggy[at].ravel(), 1)[0]
    assert slope == pytest.approx(0.05, abs=0.01)
    assert (foggy[:, :100] == AIRLIGHT).all()


def test_depth_of_stereo_is_that_of_both_sides():
    images = wall(20.0)
    for depth in dense_depths(CAMERA, *images):
        assert np.median(depth) == pytest.approx(20.0, rel=0.02)
        assert depth.shape == images[0].shape


@pytest.mark.parametrize("width", [8, 33, 34, 63])
def test_a_narrow_image_has_depth(width):
    left, right = (np.ascontiguousarray(image[:, :width]) for image in wall(20.0))
    for depth in dense_depths(CAMERA, left, right):
        assert depth.shape == left.shape
        assert (depth > 0).all()


def test_night_takes_stops_and_counts_electrons():
    grey = np.full((400, 600), 200, np.uint8)
    drive = drive_of(Camera(400.0, 400.0, 300.0, 200.0, 0.5, 600, 400))
    dark = seen("night:3", (grey, grey), drive=drive)
    assert dark[0].mean() == pytest.approx(25.0, abs=0.1)
    electrons = FULL_WELL / 255.0
    expected = np.sqrt(25.0 * electrons + READ_NOISE**2) / electrons
    rounded = np.sqrt(expected**2 + 1.0 / 12.0)
    assert dark[0].std() == pytest.approx(rounded, rel=0.02)
    assert not np.array_equal(*dark)


def test_exposure_follows_with_its_time_constant():
    """When the light decreases by 3 stops, the error of the exposure is 3 stops.

    After the time constant, it is 1/e of this.
    """
    law = parse_perturbation("exposure:0.5", 0)
    grey = np.full((2, 2), 128, np.uint8)
    level = np.array([law.apply(k, 0.01 * k, grey, None)[0][0, 0] for k in range(4000)], float)
    stops = np.log2(np.maximum(level, 1.0) / 128.0)
    falls = np.flatnonzero(np.diff(stops) < -2.5) + 1
    clean = [k for k in falls if np.abs(np.diff(stops[k : k + 51])).max() < 0.2]
    assert len(clean) >= 2
    for k in clean:
        before = stops[k - 1]
        assert stops[k] - before == pytest.approx(-3.0, abs=0.2)
        assert stops[k + 50] == pytest.approx(stops[k] / np.e, abs=0.1)


def test_exposure_without_lag_is_the_identity():
    law = parse_perturbation("exposure:0", 0)
    ramp = np.arange(256, dtype=np.uint8)[None]
    for k in range(0, 3000, 7):
        np.testing.assert_array_equal(law.apply(k, 0.01 * k, ramp, None)[0], ramp)


def test_dark_lowers_gain_and_gamma_in_turn():
    ramp = np.arange(256, dtype=np.uint8)[None]
    levels = np.array([seen(f"dark:{level}", (ramp, None))[0][0] for level in range(13)], float)
    np.testing.assert_array_equal(levels[0], ramp[0])
    np.testing.assert_array_equal(levels[3], np.rint(255 * 0.7 * (ramp[0] / 255) ** (1 / 0.9)))
    white = levels[:, 255]  # gamma does not change white
    assert (np.diff(white)[::2] < -30).all()
    assert (np.diff(white)[1::2] == 0).all()
    assert (np.diff(levels[:, 128]) < 0).all()
    between = seen("dark:2.5", (ramp, None))[0][0]
    assert levels[3, 255] < between[255] < levels[2, 255]


@pytest.mark.parametrize("ms", [10, 3])
def test_a_blackout_lasts_its_time_whatever_the_frame_rate(ms):
    law = parse_perturbation("blackout:5", 1)
    white = np.full((2, 2), 255, np.uint8)
    times = np.arange(0.0, 41.0, 1e-3 * ms)
    grey = np.array([law.apply(k, t, white, None)[0][0, 0] for k, t in enumerate(times)], int)
    assert (grey[times < 1.0] == 255).all()
    for k in range(8):
        within = (times >= 1.0 + 5.0 * k) & (times < 6.0 + 5.0 * k)
        begin = np.flatnonzero(within & (grey == 0))[0]
        black, dim = ((0.16, 0.64), (0.32, 0.40))[k % 2]
        assert 1e-3 * ms * (within & (grey == 0)).sum() == pytest.approx(black, abs=2e-3 * ms)
        assert 1e-3 * ms * (within & (grey < 255)).sum() == pytest.approx(
            black + dim, abs=2e-3 * ms
        )
        middle = np.searchsorted(times, times[begin] + black + dim / 2)
        assert grey[middle] == pytest.approx(128, abs=8)


def test_motion_blur_is_as_long_as_the_turn_while_the_shutter_is_open():
    """At 0.4 rad/s for 50 ms and a focal length of 400 pixels, the blur is 8 pixels long."""
    point = np.zeros((160, 320), np.uint8)
    point[80, 160] = 255
    images = seen("motion:50", (point, point))
    for image in images:
        rows, columns = np.nonzero(image > 8)
        assert set(rows) == {80}
        assert np.ptp(columns) + 1 == pytest.approx(8.0, abs=1.0)


def test_motion_blur_without_poses_takes_the_motion_of_the_image():
    """The image moves 4 pixels in 0.1 s. An exposure of 100 ms gives a blur of 4 pixels."""
    point = np.zeros((160, 320), np.uint8)
    point[80, 160] = 255
    drive = drive_of(poses=False)
    law = parse_perturbation("motion:100", 0).bound_to(drive)
    columns = np.nonzero(law.apply(3, 0.3, point, point)[0][80] > 16)[0]
    assert np.ptp(columns) + 1 == pytest.approx(4.0, abs=1.0)


def test_line_kernel_keeps_the_light_and_its_middle():
    for shift in ([7.0, 0.0], [-3.0, 4.5], [0.2, 0.1]):
        kernel = line_kernel(np.array(shift))
        y, x = np.mgrid[: len(kernel), : len(kernel)] - len(kernel) // 2
        assert kernel.sum() == pytest.approx(1.0)
        assert (kernel * x).sum() == pytest.approx(0.0, abs=1e-5)
        assert (kernel * y).sum() == pytest.approx(0.0, abs=1e-5)


def test_vignetting_takes_its_stops_at_the_corner():
    white = np.full((160, 320), 240, np.uint8)
    for image in seen("vignetting:3", (white, white)):
        assert image[0, 0] == image[-1, -1] == 30
        assert image[80, 160] == 240


def test_flare_has_its_grey_levels_ten_degrees_from_the_sun():
    dark = np.zeros((160, 320), np.uint8)
    for seed in range(5):
        left, right = seen("flare:25", (dark, dark), seed=seed)
        np.testing.assert_array_equal(left, right)
        v, u = np.argwhere(left == 255).mean(axis=0)
        y, x = np.mgrid[:160, :320]
        rays = np.stack([(x - 160.0) / 400.0, (y - 80.0) / 400.0, np.ones(x.shape)])
        sun = np.array([(u - 160.0) / 400.0, (v - 80.0) / 400.0, 1.0])
        cosine = np.tensordot(sun, rays, 1) / np.linalg.norm(rays, axis=0) / np.linalg.norm(sun)
        ring = np.abs(np.degrees(np.arccos(np.minimum(cosine, 1.0))) - 10.0) < 0.3
        assert np.median(left[ring]) == pytest.approx(25.0, abs=3.0)


def test_dirt_covers_its_share_and_stays():
    white = np.full((160, 320), 255, np.uint8)
    left, right = seen("dirt:20", (white, white))
    assert ((left < 150).mean(), (right < 150).mean()) == pytest.approx((0.2, 0.2), abs=0.02)
    assert not np.array_equal(left, right)
    np.testing.assert_array_equal(seen("dirt:20", (white, white), index=15)[0], left)


def test_rain_is_that_of_marshall_and_palmer():
    """Only drops above 1 mm are drawn.

    The water in these drops is most of the stated rate, and never more than the rate.
    """
    for mm_per_h in (5.0, 25.0, 100.0):
        n, rate = drops_per_m3(mm_per_h)
        d = 1.0 + np.linspace(0.0, 8.0, 4000)
        density = n * rate * np.exp(-rate * (d - 1.0))  # 1/(m^3 mm)
        speed = 9.65 - 10.3 * np.exp(-0.6 * d)
        volume = np.pi / 6.0 * (1e-3 * d) ** 3
        flux = 3.6e6 * np.trapezoid(density * speed * volume, d)
        assert 0.6 * mm_per_h < flux < 1.15 * mm_per_h


def test_rain_brightens_and_wets_the_glass_with_its_rate():
    grey = np.full((160, 320), 60, np.uint8)
    assert (seen("rain:0", (grey, grey))[0] == 60).all()
    wet = [np.mean([seen(f"rain:{r}", (grey, grey), index=k)[0] > 60 for k in range(10)])
           for r in (5, 50, 200)]  # fmt: skip
    assert 0 < wet[0] < wet[1] < wet[2] < 0.9
    assert glass_drops(100.0, CAMERA) == pytest.approx(10 * glass_drops(10.0, CAMERA))
    # 100 mm/h in 3 s on 30 x 15 mm: 37.5 microlitres, of 4.19 each.
    assert glass_drops(100.0, CAMERA) == pytest.approx(37.5 / 4.19, rel=0.01)


def test_jpeg_resolution_bits_and_contrast():
    import cv2

    image = texture(5, (160, 320))
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 12])[1]
    np.testing.assert_array_equal(seen("jpeg:12", (image, image))[0], cv2.imdecode(data, 0))
    stripes = np.tile(np.uint8([0, 255]), (160, 160))
    assert np.ptp(seen("resolution:0.5", (stripes, stripes))[0][:, 4:-4]) <= 1
    np.testing.assert_array_equal(seen("resolution:1", (image, image))[0], image)
    assert set(np.unique(seen("bits:2", (image, image))[0])) <= {0, 64, 128, 192}
    np.testing.assert_array_equal(seen("bits:8", (image, image))[0], image)
    flat = seen("contrast:25", (image, image))[0]
    assert flat.std() == pytest.approx(0.25 * image.std(), rel=0.03)
    assert flat.mean() == pytest.approx(image.mean(), abs=0.5)
    np.testing.assert_array_equal(
        seen("bias:20", (image, image))[0], np.minimum(image.astype(int) + 20, 255)
    )


def test_shot_noise_counts_photons_and_impulses_their_share():
    grey = np.full((160, 320), 102, np.uint8)  # 0.4 of white: 10 photons of 25
    left, right = seen("shot:25", (grey, grey))
    assert left.mean() == pytest.approx(102.0, rel=0.02)
    assert left.std() == pytest.approx(np.sqrt(10.0) / 25.0 * 255.0, rel=0.03)
    assert not np.array_equal(left, right)
    hit = seen("impulse:10", (grey, grey))[0]
    assert ((hit == 255).mean(), (hit == 0).mean()) == pytest.approx((0.05, 0.05), abs=0.005)


def test_frames_are_dropped_by_share():
    law = parse_perturbation("drop:30", 1)
    image = np.zeros((2, 2), np.uint8)
    dropped = []
    for k in range(3000):
        try:
            law.apply(k, 0.1 * k, image, image)
        except DroppedFrameError:
            dropped.append(k)
    assert len(dropped) / 3000 == pytest.approx(0.3, abs=0.03)
    assert dropped[0] > 0


def test_an_outage_lasts_its_seconds_once_in_ten():
    law = parse_perturbation("outage:2", 1)
    image = np.zeros((2, 2), np.uint8)
    dropped = np.zeros(6000, bool)
    for k in range(6000):
        try:
            law.apply(k, 0.01 * k, image, image)
        except DroppedFrameError:
            dropped[k] = True
    begins = np.flatnonzero(np.diff(dropped.astype(int)) == 1)
    assert len(begins) == 6
    assert dropped.reshape(6, 1000).sum(axis=1) == pytest.approx(200, abs=1)
    assert not dropped[:100].any()


def test_stereo_gain_takes_stops_of_the_right_side_alone():
    left, right = wall(20.0)
    ours, theirs = seen("stereo_gain:2", (left, right))
    assert ours is left
    np.testing.assert_array_equal(theirs, np.rint(right / 4.0))


@pytest.mark.parametrize(("law", "axis"), [("yaw", 1), ("pitch", 0)])
def test_a_turned_camera_moves_the_image_by_arc_minutes(law, axis):
    """With a focal length of 400 pixels, 30 arc minutes are 3.49 pixels."""
    image = np.zeros((160, 320), np.uint8)
    image[76:85, 156:165] = 255
    ours, theirs = seen(f"{law}:30", (image, image))
    assert ours is image
    centre = np.array(np.average(np.argwhere(theirs), axis=0, weights=theirs[theirs > 0]))
    expected = np.array([80.0, 160.0])
    expected[axis] += (1 if axis == 0 else -1) * 400.0 * np.tan(np.radians(0.5))
    assert centre == pytest.approx(expected, abs=0.1)


def test_a_longer_baseline_lengthens_disparities():
    left, right = wall(20.0)  # 10 pixels
    longer = seen("baseline:20", (left, right))[1]
    found = disparity(CAMERA, left, longer)[20:-20, 40:-40]
    assert np.median(found) == pytest.approx(12.0, abs=0.15)


def test_a_late_right_side_shows_what_comes_later():
    drive = drive_of()
    images = drive.read(3)
    late = seen("desync:50", images, drive=drive)[1].astype(float)
    true = np.asarray(texture(3)[:, 20 + 14 : 20 + 14 + 320], float)  # 2 pixels later
    inner = np.s_[10:-10, 10:-10]
    error = np.abs(late - true)[inner].mean()
    assert error < 0.2 * np.abs(images[1] - true)[inner].mean()


@pytest.mark.parametrize("side", [0, 1])
def test_a_black_side_is_black_for_its_share_of_the_seconds(side):
    law = parse_perturbation(f"black_{('left', 'right')[side]}:25", 0).bound_to(drive_of())
    left, right = wall(20.0)
    black = np.array(
        [[image.max() == 0 for image in law.apply(k, 0.5 * k, left, right)] for k in range(2000)]
    )
    assert black[:, side].mean() == pytest.approx(0.25, abs=0.04)
    assert not black[:, 1 - side].any()
    np.testing.assert_array_equal(black[::2], black[1::2])  # by the second


@pytest.mark.slow
def test_every_law_is_repeatable_and_keeps_the_shape():
    drive = drive_of()
    for name, kind in LAWS.items():
        spec = f"{name}:{kind.strongest:g}"
        for index in (0, 5, 19):
            try:
                one = seen(spec, drive.read(index), index=index)
                two = seen(spec, drive.read(index), index=index)
            except DroppedFrameError:
                continue
            for image, again in zip(one, two, strict=True):
                assert image.dtype == np.uint8
                assert image.shape == (160, 320)
                np.testing.assert_array_equal(image, again)


def test_laws_that_draw_nothing_say_so():
    drive = drive_of()
    for name, kind in LAWS.items():
        strength = (kind.weakest + kind.strongest) / 2.0
        pair = [seen(f"{name}:{strength:g}", drive.read(5), 5, s) for s in (0, 1)
                if name not in ("drop", "outage")]  # fmt: skip
        same = all(np.array_equal(*two) for two in zip(*pair, strict=True))
        if not kind.drawn:
            assert same, name


def test_what_the_data_lack_is_said():
    mono = drive_of(CAMERA.left_camera())
    fit, unfit = laws_for(mono)
    assert set(LAWS) - set(fit) == {
        "fog", "stereo_gain", "desync", "baseline", "yaw", "pitch", "black_right", "black_left",
    }  # fmt: skip
    with pytest.raises(InputError, match="--perturb fog: needs stereo or depth images"):
        parse_perturbation("fog", 0).bound_to(mono)
    with pytest.raises(InputError, match="--perturb yaw: needs stereo images"):
        parse_perturbation("brightness,yaw:3", 0).bound_to(mono)
    assert laws_for(drive_of()) == (list(LAWS), {})
    assert list(unfit) == [law for law in LAWS if law not in fit]
    assert unfit["fog"].startswith("--perturb fog: needs stereo")


def samples_under(spec: str, seed: int = 0) -> np.ndarray:
    drive = drive_of()
    return parse_perturbation(spec, seed).bound_to(drive).of_imu(drive.imu).recorded.samples


def test_noise_of_the_imu_is_a_multiple_of_its_densities():
    added = (samples_under("imu-noise:20") - SAMPLES)[:, 1:]
    density = added.std(axis=0) * np.sqrt(0.005)
    np.testing.assert_allclose(density, 20 * np.repeat([NOISE.gyro, NOISE.accel], 3), rtol=0.05)
    assert np.abs(np.corrcoef(added.T) - np.eye(6)).max() < 0.06


def test_biases_of_the_imu_have_the_lengths_of_their_units():
    added = (samples_under("imu-bias:2", 1) - SAMPLES)[:, 1:]
    np.testing.assert_allclose(added, added[:1].repeat(len(added), axis=0), atol=1e-12)
    assert np.degrees(np.linalg.norm(added[0, :3])) == pytest.approx(2.0)
    assert np.linalg.norm(added[0, 3:]) == pytest.approx(0.2)
    other = (samples_under("imu-bias:2", 2) - SAMPLES)[0, 1:]
    assert np.linalg.norm(other - added[0]) > 0.01


def test_samples_of_the_imu_are_missing_once_in_ten_seconds():
    kept = samples_under("imu-gap:1.5", 3)
    steps = np.diff(kept[:, 0])
    assert (steps > 0.006).sum() == 3
    assert steps.max() == pytest.approx(1.505, abs=0.006)
    begun = kept[:-1][steps > 0.006, 0] - SAMPLES[0, 0]
    assert [int(t // 10) for t in begun] == [0, 1, 2]
    assert begun[0] > 0.99


def test_a_late_imu_has_later_times_only():
    late = samples_under("imu-delay:-30")
    np.testing.assert_allclose(late[:, 0], SAMPLES[:, 0] - 0.03)
    np.testing.assert_array_equal(late[:, 1:], SAMPLES[:, 1:])


def test_a_turned_imu_measures_the_same_lengths_along_other_axes():
    turned = samples_under("imu-axes:12", 4)
    for at in (slice(1, 4), slice(4, 7)):
        lengths = np.linalg.norm(turned[:, at], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(SAMPLES[:, at], axis=1))
    cosines = [turned[0, at] @ SAMPLES[0, at] / (SAMPLES[0, at] @ SAMPLES[0, at])
               for at in (slice(1, 4), slice(4, 7))]  # fmt: skip
    angles = np.degrees(np.arccos(cosines))
    assert angles.max() <= 12.0 + 1e-9  # the axis need not be perpendicular
    assert angles.max() > 1.0


def test_laws_of_the_imu_leave_the_images_alone_and_need_samples():
    drive = drive_of()
    mixed = parse_perturbation("imu-gap:1,noise:1,imu-delay:5", 0).bound_to(drive)
    assert mixed.name == "imu-gap:1,noise:1,imu-delay:5"
    alone = parse_perturbation("noise:1", 0).bound_to(drive)
    images = drive.read(3)
    for one, other in zip(mixed.apply(3, 0.3, *images), alone.apply(3, 0.3, *images), strict=True):
        np.testing.assert_array_equal(one, other)
    both = mixed.of_imu(drive.imu).recorded.samples
    np.testing.assert_allclose(both[:, 0] - 0.005, samples_under("imu-gap:1")[:, 0])
    with pytest.raises(InputError, match="--perturb imu-bias: needs the recorded samples"):
        parse_perturbation("imu-bias", 0).bound_to(replace(drive, imu=None))
    live = replace(drive.imu, live=True)
    with pytest.raises(InputError, match="--perturb imu-bias: needs the recorded samples"):
        parse_perturbation("imu-bias", 0).bound_to(replace(drive, imu=live))


def test_a_stream_has_no_next_frame():
    law = parse_perturbation("motion", 0).laws[0]
    with pytest.raises(InputError, match="--perturb motion: needs the next frame"):
        law.bound_to(Scene(CAMERA))


def test_a_law_that_does_not_know_its_scene_says_so():
    left, right = wall(20.0)
    with pytest.raises(RuntimeError, match="bound_to"):
        parse_perturbation("fog", 0).apply(0, 0.0, left, right)


def test_faults_are_of_the_images_so_far():
    """Fog computes depth from the unperturbed images.

    Noise that is applied before fog does not change where the fog is.
    """
    images = wall(20.0)
    noisy_fog = seen("noise:1,fog:20", images)[0]
    fog = seen("fog:20", images)[0]
    assert np.abs(noisy_fog.astype(float) - fog).mean() < 2.0


def test_units_are_refused_out_of_their_range():
    with pytest.raises(InputError, match="from 1 to 100 quality; the default is 10"):
        parse_perturbation("jpeg:0", 0)
    with pytest.raises(InputError, match=r"0\.5 to 100000 m; the default is 60"):
        parse_perturbation("fog:0", 0)


def test_a_pair_without_a_right_image_passes_the_faults_of_one_side():
    pair = Pair(0, 0.0, np.zeros((160, 320), np.uint8), None, (np.zeros((160, 320)), None))
    assert pair.right is None


def test_the_table_of_laws_is_that_of_the_code(monkeypatch):
    tools = Path(__file__).parents[2] / "tools"
    monkeypatch.syspath_prepend(str(tools))
    import law_table

    assert law_table.TABLE.read_text() == law_table.table(), "run: python tools/law_table.py"
