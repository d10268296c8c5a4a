"""``vslam doctor`` finds every planted fault, and no fault in clean sequences."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import StereoSequence
from source_files import write_calibration, write_video
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.config import Config, as_config
from vslam.datasets.association import Pairing
from vslam.datasets.euroc import open_euroc
from vslam.datasets.frames import stored_frames
from vslam.datasets.kitti import open_kitti
from vslam.datasets.times import Timing, in_order
from vslam.datasets.tum import open_tum
from vslam.doctor.checks import check_depth, check_times
from vslam.doctor.examine import examine
from vslam.support.errors import ResultsError, UnreadableImageError
from vslam.types.camera import Camera

REAL = Path(__file__).parents[3] / "shared/data"
FEW = as_config({"orb": {"n_features": 500}})  # for images of 480x160


@dataclass(frozen=True)
class Seen:
    """A sequence of images in memory. ``second`` contains right images or depth."""

    camera: Camera
    left: list
    second: list
    timestamps: np.ndarray
    ground_truth: np.ndarray | None = None
    dataset: str = "drawn"
    name: str = "corridor"
    pairing: Pairing | None = None
    timing: Timing | None = None
    imu: None = None

    def __len__(self):
        return len(self.left)

    def read(self, index, image_map=map):
        if self.left[index] is None:
            raise UnreadableImageError(Path("000.png"), "cannot be decoded; download it again.")
        return self.left[index], self.second[index]

    @property
    def stored(self):
        return stored_frames(self.timestamps, self.read)


@pytest.fixture(scope="module")
def clean(corridor: StereoSequence) -> Seen:
    return Seen(corridor.camera, corridor.left, corridor.right, corridor.timestamps)


def both(seen: Seen, change) -> Seen:
    return replace(
        seen, left=[change(i) for i in seen.left], second=[change(i) for i in seen.second]
    )


def right(seen: Seen, change) -> Seen:
    return replace(seen, second=[change(i) for i in seen.second])


def turned(image: np.ndarray, degrees: float) -> np.ndarray:
    height, width = image.shape
    M = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, 1.0)
    return cv2.warpAffine(image, M, (width, height), borderMode=cv2.BORDER_REFLECT)


def dimmed(image: np.ndarray, gain: float) -> np.ndarray:
    return np.rint(image * gain).astype(np.uint8)


def shifted(times: np.ndarray) -> np.ndarray:
    return times + np.where(np.arange(len(times)) % 3 == 1, 0.06, 0.0)


def timed(seen: Seen, times: np.ndarray) -> Seen:
    """Return the left images alone, with different times."""
    return replace(seen, second=[None] * len(seen), timestamps=times)


def broken(seen: Seen) -> Seen:
    left = list(seen.left)
    left[-1] = None
    return replace(seen, left=left)


def swapped_times(times: np.ndarray) -> np.ndarray:
    order = np.arange(len(times))
    order[[4, 5]] = 5, 4
    return times[order]


FAULTS = {
    "right camera rolled": (lambda s: right(s, lambda i: turned(i, 1.5)), "rectification"),
    "right image lower": (lambda s: right(s, lambda i: np.roll(i, 3, axis=0)), "rectification"),
    "sides swapped": (lambda s: replace(s, left=s.second, second=s.left), "sides"),
    "one side twice": (lambda s: replace(s, second=s.left), "sides"),
    "right image darker": (lambda s: right(s, lambda i: dimmed(i, 0.6)), "exposure"),
    "right image late": (
        lambda s: replace(s, second=[s.second[0], *s.second[:-1]]),
        "synchronisation",
    ),
    "out of focus": (lambda s: both(s, lambda i: cv2.GaussianBlur(i, (0, 0), 2)), "sharpness"),
    "no texture": (lambda s: both(s, lambda i: dimmed(i, 0.008)), "features"),
    "jittering times": (lambda s: timed(s, shifted(s.timestamps)), "jitter"),
    "a gap": (
        lambda s: timed(s, s.timestamps + 0.4 * (np.arange(len(s)) > 12)),
        "gaps",
    ),
    "times that turn back": (
        lambda s: timed(s, swapped_times(s.timestamps)),
        "order of times",
    ),
    "a damaged file": (broken, "images"),
}


def faults(seen, config: Config = FEW) -> list[str]:
    found = examine(seen, config).faults
    assert all(finding.fix for finding in found)
    return [finding.check for finding in found]


@pytest.mark.slow
def test_nothing_is_wrong_with_the_corridor(clean):
    diagnosis = examine(clean, FEW)
    assert [f for f in diagnosis.findings if f.verdict != "good"] == []
    assert {f.check for f in diagnosis.findings} >= {check for _, check in FAULTS.values()}
    assert len(diagnosis.pictures) == 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_found_alone(clean, fault):
    plant, check = FAULTS[fault]
    assert faults(plant(clean)) == [check]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("baseline", "verdict"), [(0.12, "good"), (12.0, "fault"), (1e-4, "fault")]
)
def test_what_the_calibration_says_of_lengths_is_shown(clean, baseline, verdict):
    """A baseline in a wrong unit is recognised by the depths of the matches."""
    seen = replace(clean, camera=replace(clean.camera, baseline=baseline))
    (finding,) = (f for f in examine(seen, FEW).findings if f.check == "scale")
    assert finding.verdict == verdict
    depths = [
        float(re.search(r"nearer than (\S+) m", f.measured)[1])
        for f in (*examine(clean, FEW).findings, finding)
        if f.check == "scale"
    ]
    assert depths[1] / depths[0] == pytest.approx(baseline / clean.camera.baseline, rel=0.02)
    assert re.search(r"480x160 pixels see 90 x 37 degrees", finding.measured)


@pytest.mark.slow
def test_a_calibration_of_larger_images(clean):
    c = clean.camera
    twice = replace(clean, camera=replace(c, cx=2 * c.cx, cy=2 * c.cy, fx=2 * c.fx, fy=2 * c.fy))
    found = {f.check: f for f in examine(twice, FEW).faults}
    assert "images of twice this size" in found["calibration"].measured
    assert "--calib" in found["calibration"].fix


def test_how_late_the_right_side_is(clean):
    late = replace(clean, second=[*clean.second[2:], *clean.second[:2]])
    (finding,) = examine(late, FEW).faults
    assert finding.check == "synchronisation"
    assert "2 frames early" in finding.fix


@pytest.mark.slow
def test_a_camera_that_stands_still_says_nothing_of_synchronisation(clean):
    still = replace(clean, left=clean.left[:1] * len(clean), second=clean.second[:1] * len(clean))
    found = {f.check: f.verdict for f in examine(still, FEW).findings}
    assert found["synchronisation"] == "unknown"
    assert "fault" not in found.values()


@pytest.mark.slow
def test_sides_of_different_places(clean):
    noise = np.random.default_rng(0).integers(0, 256, clean.left[0].shape).astype(np.uint8)
    assert faults(right(clean, lambda i: noise)) == ["stereo"]


def boxes(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Make an image of textured boxes at several depths, and their depth."""
    rng = np.random.default_rng(seed)
    image = rng.integers(90, 110, (240, 320)).astype(np.uint8)
    depth = np.full(image.shape, 4.0, np.float32)
    for z in (3.0, 2.2, 1.5):
        x, y = rng.integers(30, 220), rng.integers(30, 150)
        image[y : y + 60, x : x + 70] = rng.integers(20, 90, (60, 70)) + rng.integers(0, 120)
        depth[y : y + 60, x : x + 70] = z
    return cv2.GaussianBlur(image, (0, 0), 0.6), depth


@pytest.fixture(scope="module")
def depth_images(clean) -> Seen:
    images, depths = zip(*(boxes(k) for k in range(8)), strict=True)
    return replace(clean, left=list(images), second=list(depths), timestamps=0.1 * np.arange(8))


def test_registered_depth(depth_images):
    diagnosis = examine(depth_images, FEW)
    assert diagnosis.faults == []
    assert {"depth", "registration"} <= {f.check for f in diagnosis.findings}
    assert len(diagnosis.pictures) == 1


def test_depth_of_another_camera(depth_images):
    assert faults(right(depth_images, lambda d: np.roll(d, 9, axis=1))) == ["registration"]


def test_one_view_does_not_tell_that_depth_is_off(depth_images):
    """Eight frames of the same view count as one piece of evidence.

    Its edges may agree with a different calibration by chance.
    """
    image, depth = depth_images.left[0], np.roll(depth_images.second[0], 9, axis=1)
    shaken = [np.roll(image, k, axis=1) for k in range(8)]
    moved = [np.roll(depth, k, axis=1) for k in range(8)]
    found = {
        f.check: f for f in examine(replace(depth_images, left=shaken, second=moved), FEW).findings
    }
    assert found["registration"].verdict == "unknown"
    assert "one view" in found["registration"].measured
    shaken[4:], moved[4:] = (
        depth_images.left[4:],
        [np.roll(d, 9, axis=1) for d in depth_images.second[4:]],
    )
    assert faults(replace(depth_images, left=shaken, second=moved)) == ["registration"]


def windows_of_desk() -> list[tuple[list, list]]:
    """Return images and depth of nine windows of 60 frames. Each window has eight frames."""
    desk = open_tum(REAL / "tum", "rgbd_dataset_freiburg1_desk")
    starts = range(0, 9 * 60, 60)
    frames = [np.linspace(k, k + 59, 8).round().astype(int).tolist() for k in starts]
    return [tuple(zip(*map(desk.read, window), strict=True)) for window in frames]


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "tum").is_dir(), reason="TUM sequence absent")
def test_depth_of_fr1_desk_is_no_fault_but_moved_it_is():
    windows = windows_of_desk()
    found = [check_depth(*window)[1].verdict for window in windows]
    assert "fault" not in found
    assert found.count("good") >= 3
    moved = [
        check_depth(images, [np.roll(depth, 25, axis=1) for depth in depths])[1].verdict
        for images, depths in windows
    ]
    assert "good" not in moved
    assert moved.count("fault") >= 4


@pytest.mark.parametrize("shifts", [(14, 38), (47, 47)], ids=["two peaks", "end of the search"])
def test_no_fault_where_no_shift_of_depth_is_clearly_best(depth_images, shifts):
    moved = [np.roll(depth, shifts[k % 2], axis=1) for k, depth in enumerate(depth_images.second)]
    found = {f.check: f.verdict for f in examine(replace(depth_images, second=moved), FEW).findings}
    assert found["registration"] == "unknown"


def test_hardly_any_depth(depth_images):
    def thinned(depth):
        depth = depth.copy()
        depth[:, 70:] = np.nan
        return depth

    assert faults(right(depth_images, thinned))[0] == "depth"


def test_depth_without_edges_says_nothing(depth_images):
    flat = right(depth_images, lambda d: np.full_like(d, 2.0))
    found = {f.check: f.verdict for f in examine(flat, FEW).findings}
    assert found["registration"] == "unknown"


def test_one_camera_alone(clean):
    camera = clean.camera.left_camera()
    alone = replace(clean, second=[None] * len(clean), camera=camera)
    found = {f.check for f in examine(alone, FEW).findings}
    assert found == {
        "images", "calibration", "features", "sharpness", "order of times", "frame rate", "gaps",
        "jitter", "scale", "start",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("frames", "verdict", "measured"),
    [
        (slice(None), "good", "the map can begin with frames"),
        ([0] * 8, "unknown", "no map begins in the first 8 frames: the camera hardly moves"),
        (slice(0, 1), "unknown", "no map begins in the first 1 frame"),
    ],
)
def test_whether_the_map_of_one_camera_can_begin(clean, frames, verdict, measured):
    left = list(np.array(clean.left)[frames])
    times = clean.timestamps[: len(left)]
    alone = replace(clean, left=left, second=[None] * len(left), timestamps=times)
    alone = replace(alone, camera=clean.camera.left_camera())
    found = {f.check: f for f in examine(alone, FEW).findings}["start"]
    assert (found.verdict, found.measured[: len(measured)]) == (verdict, measured)


@pytest.mark.parametrize(
    ("n", "missing", "verdict"),
    [(10, 1, "good"), (20, 2, "good"), (20, 4, "fault"), (200, 10, "good"), (200, 20, "fault")],
)
def test_one_frame_missing_in_a_short_clip_is_no_fault(n, missing, verdict):
    steps = np.full(n - 1, 0.1)
    steps[np.linspace(0, n - 2, missing).astype(int)] = 0.2
    found = {f.check: f.verdict for f in check_times(np.cumsum(steps))}
    assert found["gaps"] == verdict


def test_few_frames_have_no_rhythm():
    assert [f.verdict for f in check_times(np.array([0.0, 1.0]))] == ["unknown"]


@pytest.mark.parametrize(
    ("times", "verdict", "measured"),
    [
        (0.1 * np.arange(9), "good", "10.0 Hz"),
        (3.0 * np.arange(9), "good", "0.33 Hz"),
        (104_499.0 * np.arange(9), "fault", "one frame every 1.04e+05 s"),
        (1e-5 * np.arange(9), "fault", "100000.0 Hz"),
    ],
)
def test_a_rate_that_no_camera_has_is_a_fault(times, verdict, measured):
    (rate,) = (f for f in check_times(times) if f.check == "frame rate")
    assert (rate.verdict, rate.measured) == (verdict, measured)


def test_the_order_of_times_is_that_of_the_recording():
    """The reader has left out frames, so that the times of the others increase."""
    timing = Timing("x", ["x: the names are read as nanoseconds: 10.0 Hz."])
    recorded = np.r_[0.1 * np.arange(20), 0.1 * np.arange(20) - 30.0]
    kept = [t for t, _ in in_order(((t, None) for t in recorded.tolist()), timing)]
    for found in (check_times(np.array(kept), timing), check_times(recorded)):
        order, rate = found[:2]
        assert order.verdict == "fault"
        assert order.measured.startswith("the clock was set back by 32 s after 1.900 s")
        assert "clock" in order.fix
        assert "sort" not in order.fix
        assert rate.verdict == "good"
    assert check_times(np.array(kept), timing)[1].measured == (
        "10.0 Hz; x: the names are read as nanoseconds: 10.0 Hz"
    )


@pytest.mark.slow
@pytest.mark.parametrize(("n_pairs", "verdict"), [(9, "good"), (8, "fault")])
def test_many_images_without_a_partner_are_a_fault(clean, n_pairs, verdict):
    pairing = Pairing(Path("bag"), "right image", 0.005, "correct the times")
    pairing.count(np.arange(10.0), np.arange(n_pairs), np.arange(n_pairs))
    (found,) = (
        f
        for f in examine(replace(clean, pairing=pairing), FEW).findings
        if "left out" in f.measured
    )
    assert (found.check, found.verdict) == ("partners", verdict)
    assert found.measured.startswith(f"{10 - n_pairs} of 10 images are left out because no right ")


def test_the_command(kitti_tree, tmp_path):
    page, config = tmp_path / "page.html", tmp_path / "config.json"
    config.write_text('{"orb": {"n_features": 500}}')
    options = ["--config", str(config), "--out", str(page)]
    done = CliRunner().invoke(every_command(), ["doctor", str(kitti_tree), *options])
    assert done.exit_code == 0, done.output
    assert "no faults" in done.output
    text = page.read_text()
    assert text.count("data:image/jpeg") == 2
    assert "median vertical error" in text


@pytest.mark.slow
def test_the_command_looks_at_the_beginning_of_a_video(corridor, tmp_path, monkeypatch):
    """The frames of a stream cannot be read again. Therefore, the first frames are kept."""
    monkeypatch.setattr("vslam.datasets.frames.first_frames.__defaults__", (9,))
    pairs = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)]
    video = write_video(tmp_path / "drive.mkv", pairs)
    calibration = write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    config = tmp_path / "config.json"
    config.write_text('{"orb": {"n_features": 500}}')
    options = ["--side-by-side", "--calib", str(calibration), "--config", str(config)]
    page = ["--out", str(tmp_path / "page.html")]
    done = CliRunner().invoke(every_command(), ["doctor", str(video), *options, *page])
    assert done.exit_code == 0, done.output
    assert "the times of 9 frames increase" in done.output
    assert "10.0 Hz" in done.output
    assert "median vertical error" in done.output


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--sensor rgbd", "--sensor rgbd: 00 has the sensor stereo"),
        ("--depth-scale 9", "--depth-scale: only for --dataset tum or images or bag, not kitti"),
        ("--dataset images --seq 00", "--seq 00: only for data sets, not images"),
    ],
)
def test_the_command_refuses_the_options_that_a_run_refuses(kitti_tree, tmp_path, words, part):
    words = [*words.split(), "--out", str(tmp_path / "page.html")]
    done = CliRunner().invoke(every_command(), ["doctor", str(kitti_tree), *words])
    assert done.exit_code == 1
    assert part in done.output


def test_the_command_turns_bad_input_into_a_finding(kitti_tree, tmp_path):
    page, own = tmp_path / "page.html", tmp_path / "own.yaml"
    one = "{focal: [240, 240], centre: [320, 240], size: [640, 480]}"
    own.write_text(f"left: {one}\nright: {one}\nbaseline: 0.5\n")
    options = ["--calib", str(own), "--out", str(page)]
    done = CliRunner().invoke(every_command(), ["doctor", str(kitti_tree), *options])
    assert done.exit_code == 1
    assert "made for 640x480 pixels but the images have 480x160" in done.output
    assert "fix: take the calibration of these images" in done.output
    text = page.read_text()
    banner = text.index('role="alert"')
    assert banner < text.index("made for 640x480") < text.index("Fix: take the calibration")


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "kitti").is_dir(), reason="KITTI sample absent")
def test_nothing_is_wrong_with_kitti():
    assert faults(open_kitti(REAL / "kitti", "06"), Config()) == []


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "euroc").is_dir(), reason="EuRoC clip absent")
def test_nothing_is_wrong_with_euroc():
    sequence = open_euroc(REAL / "euroc/V1_01_start", "")
    diagnosis = examine(sequence, Config())
    assert diagnosis.faults == []
    (rows,) = [f.measured for f in diagnosis.findings if f.check == "rectification"]
    assert float(rows.split()[3]) < 0.3


@pytest.mark.slow
def test_what_was_found_is_said_where_the_page_cannot_be_written(kitti_tree):
    options = ["--seq", "00", "--out", str(kitti_tree / "poses" / "00.txt" / "page.html")]
    done = CliRunner().invoke(every_command(), ["doctor", str(kitti_tree), *options])
    assert "rectification" in done.output
    assert isinstance(done.exception, ResultsError)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.7, 0.9, 1.1, 1.3])
def test_a_wrong_focal_length_shows_when_the_camera_turns(clean, factor):
    c = clean.camera
    wrong = replace(clean, camera=replace(c, fx=factor * c.fx, fy=factor * c.fy))
    (found,) = examine(wrong, FEW).faults
    assert found.check == "focal length"
    assert found.measured.endswith(f"the calibration has {factor * c.fx:.0f} px")
    said = float(re.findall(r"fit (\d+) px", found.measured)[0])
    assert said == pytest.approx(c.fx, rel=0.03)


@pytest.mark.slow
def test_straight_ahead_no_focal_length_shows(clean):
    """In the frames 0 to 7, the camera moves straight ahead."""
    straight = replace(
        clean, left=clean.left[:8], second=clean.second[:8], timestamps=clean.timestamps[:8],
        camera=replace(clean.camera, fx=1.3 * clean.camera.fx, fy=1.3 * clean.camera.fy),
    )  # fmt: skip
    (found,) = [f for f in examine(straight, FEW).findings if f.check == "focal length"]
    assert found.verdict == "unknown"


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_depth_of_another_unit(depth_images, factor):
    (found,) = examine(right(depth_images, lambda d: d * np.float32(factor)), FEW).faults
    assert found.check == "depth"
    assert "--depth-scale" in found.fix


def test_faint_images_that_a_run_can_use_have_no_fault(clean):
    """A run raises the contrast of images with few grey levels, and so does the doctor."""
    faint = both(clean, lambda image: np.rint(100 + image * 0.04).astype(np.uint8))
    findings = {finding.check: finding for finding in examine(faint, FEW).findings}
    assert findings["features"].verdict == "good"
    assert findings["rectification"].verdict == "good"
