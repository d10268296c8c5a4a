"""The KITTI reader rejects invalid input. One sentence names the file and the fix."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.datasets import open_sequence
from vslam.datasets.kitti import list_kitti, open_kitti
from vslam.support.errors import InputError, UnreadableImageError

REAL = Path(__file__).parents[3] / "shared/data/kitti"
WIDTH, HEIGHT, FRAMES = 64, 32, 6
P0 = [50.0, 0, 30, 0, 0, 50, 16, 0, 0, 0, 1, 0]
P1 = [50.0, 0, 30, -25, 0, 50, 16, 0, 0, 0, 1, 0]


def row(numbers) -> str:
    return " ".join(f"{x:e}" for x in numbers)


def write_image(path: Path, seed: int = 0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(seed).integers(0, 256, size, dtype=np.uint8)
    assert cv2.imwrite(str(path), image)


def write_poses(path: Path, n: int) -> None:
    poses = np.tile(np.eye(4)[:3], (n, 1, 1))
    poses[:, 2, 3] = np.arange(n)
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, poses.reshape(n, 12))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "sequences" / "00"
    for k in range(FRAMES):
        write_image(folder / "image_0" / f"{k:06d}.png", seed=k)
        write_image(folder / "image_1" / f"{k:06d}.png", seed=100 + k)
    (folder / "calib.txt").write_text(f"P0: {row(P0)}\nP1: {row(P1)}\n")
    np.savetxt(folder / "times.txt", 0.1 * np.arange(FRAMES))
    write_poses(tmp_path / "poses" / "00.txt", FRAMES)
    return tmp_path


def refused(root: Path, *parts: str, name: str = "00", **selection) -> None:
    with pytest.raises(InputError) as caught:
        open_kitti(root, name, **selection)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    for part in parts:
        assert part in message


def test_reads_a_sequence(root):
    sequence = open_sequence("kitti", root, "00")
    assert (sequence.dataset, sequence.name, len(sequence)) == ("kitti", "00", FRAMES)
    camera = sequence.camera
    assert (camera.fx, camera.cx, camera.cy, camera.baseline) == (50, 30, 16, 0.5)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(sequence.timestamps, 0.1 * np.arange(FRAMES))
    np.testing.assert_array_equal(sequence.ground_truth[:, 2, 3], np.arange(FRAMES))
    left, right = sequence.read(2)
    expected = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    np.testing.assert_array_equal(left, expected)
    assert right.shape == (HEIGHT, WIDTH)
    assert right.dtype == np.uint8


def test_selection(root):
    sequence = open_kitti(root, "00", start=1, every=2, max_frames=2)
    np.testing.assert_allclose(sequence.timestamps, [0.1, 0.3])
    np.testing.assert_array_equal(sequence.ground_truth[:, 2, 3], [1, 3])
    assert [frame.file.stem for frame in sequence.stored] == ["000001", "000003"]


def test_only_selected_frames_are_checked(root):
    (root / "sequences/00/image_1/000004.png").unlink()
    (root / "sequences/00/image_1/000005.png").write_bytes(b"")
    assert len(open_kitti(root, "00", max_frames=4)) == 4


@pytest.mark.parametrize("suffix", [".jpg", ".webp"])
def test_other_image_formats(root, suffix):
    for side in "01":
        for path in (root / f"sequences/00/image_{side}").iterdir():
            write_image(path.with_suffix(suffix), seed=int(side))
            path.unlink()
    assert open_kitti(root, "00").read(0)[0].shape == (HEIGHT, WIDTH)


def test_archives_unpacked_into_dataset(root):
    (root / "dataset").mkdir()
    for part in ("sequences", "poses"):
        (root / part).rename(root / "dataset" / part)
    assert len(open_kitti(root, "00")) == FRAMES
    assert open_kitti(root, "00").ground_truth is not None


def test_calibration_without_prefixes(root):
    (root / "sequences/00/calib.txt").write_text(f"{row(P0)}\n{row(P1)}\n")
    assert open_kitti(root, "00").camera.baseline == 0.5


@pytest.mark.parametrize("text", [f"P0: {row(P0)}\nP1: {row(P0)}\n", f"P0: {row(P0)}\n"])
def test_one_camera_needs_no_baseline(root, text):
    (root / "sequences/00/calib.txt").write_text(text)
    camera = open_kitti(root, "00", monocular=True).camera
    assert (camera.sensor, camera.fx, camera.cx, camera.cy) == ("mono", 50, 30, 16)
    with pytest.raises(InputError):
        open_kitti(root, "00")


def test_excerpt_is_matched_by_number_to_longer_times_and_poses(root):
    for side in "01":
        for k in (0, 1):
            (root / f"sequences/00/image_{side}/{k:06d}.png").unlink()
    sequence = open_kitti(root, "00")
    np.testing.assert_allclose(sequence.timestamps, [0.2, 0.3, 0.4, 0.5])
    np.testing.assert_array_equal(sequence.ground_truth[:, 2, 3], [2, 3, 4, 5])
    np.savetxt(root / "sequences/00/times.txt", 0.1 * np.arange(5))
    refused(root, "times.txt: has 5 rows but none for image 000005")


def to_colour(root, keep=()):
    """Replace the grey images with colour images. Camera 2 is 6 cm left of camera 0."""
    folder = root / "sequences/00"
    for grey, colour in ((0, 2), (1, 3)):
        for path in sorted((folder / f"image_{grey}").iterdir()):
            image = cv2.cvtColor(cv2.imread(str(path), 0), cv2.COLOR_GRAY2BGR)
            (folder / f"image_{colour}").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"image_{colour}" / path.name), image)
            if grey not in keep:
                path.unlink()
    # The last column is K t. The camera has the centre -t in the frame of camera 0.
    K = np.array(P0).reshape(3, 4)[:, :3]
    t = {2: [0.06, 0.001, -0.002], 3: [-0.47, 0.001, -0.002]}
    rows = {k: row(np.column_stack([K, K @ one]).ravel()) for k, one in t.items()}
    text = f"P0: {row(P0)}\nP1: {row(P1)}\nP2: {rows[2]}\nP3: {rows[3]}\n"
    (folder / "calib.txt").write_text(text)


def test_colour_images_are_read_without_grey_ones(root):
    grey = open_kitti(root, "00").read(1)
    to_colour(root)
    sequence = open_kitti(root, "00")
    assert sequence.camera.baseline == pytest.approx(0.53, abs=1e-6)
    for image, expected in zip(sequence.read(1), grey, strict=True):
        np.testing.assert_array_equal(image, expected)
    # The poses of the ground truth are those of camera 0, and its rotations are the identity.
    np.testing.assert_allclose(sequence.ground_truth[0, :3, 3], [-0.06, -0.001, 0.002], atol=1e-6)
    np.testing.assert_allclose(sequence.ground_truth[2, :3, 3], [-0.06, -0.001, 2.002], atol=1e-6)
    assert open_kitti(root, "00", monocular=True).camera.sensor == "mono"
    assert list_kitti(root) == [("00", FRAMES, FRAMES)]


def test_grey_images_come_first_where_they_are_complete(root):
    to_colour(root, keep=(0, 1))
    assert open_kitti(root, "00").camera.baseline == 0.5
    for path in (root / "sequences/00/image_1").iterdir():
        path.unlink()
    assert open_kitti(root, "00").camera.baseline == pytest.approx(0.53, abs=1e-6)
    assert open_kitti(root, "00", monocular=True).stored[0].file.parent.name == "image_0"


def test_colour_images_need_their_own_matrices(root):
    text = (root / "sequences/00/calib.txt").read_text()
    to_colour(root)
    (root / "sequences/00/calib.txt").write_text(text)
    refused(root, "calib.txt: P2 is not a row of 12 numbers")


def test_no_ground_truth(root):
    (root / "poses/00.txt").unlink()
    assert open_kitti(root, "00").ground_truth is None


def test_list(root):
    (root / "sequences/07").mkdir()
    assert list_kitti(root) == [("00", FRAMES, FRAMES), ("07", 0, 0)]


def test_missing_root_says_where_to_get_the_data(tmp_path):
    refused(
        tmp_path / "nowhere",
        "nowhere",
        "https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
        "22 GB",
        "--data",
        "$KITTI_ROOT",
        "--dataset synthetic needs no download",
    )


def test_missing_sequence_lists_those_with_images(root):
    (root / "sequences/05").mkdir()
    shutil.copytree(root / "sequences/00", root / "sequences/07")
    refused(root, "sequences/03: no such sequence; choose one of 00, 07.", name="03")
    refused(root, "no such sequence", name="../sequences/00")


@pytest.mark.parametrize(
    "selection", [{"start": -1}, {"every": 0}, {"max_frames": 0}], ids=lambda s: next(iter(s))
)
def test_bad_selection(root, selection):
    refused(root, "--start", "--every", "--max-frames", **selection)


def test_start_beyond_the_end(root):
    refused(root, "--start 6", "has 6 frames", "at most 5", start=6)


@pytest.mark.parametrize(("side", "word"), [(0, "left"), (1, "right")])
def test_no_images_of_one_camera(root, side, word):
    for path in (root / f"sequences/00/image_{side}").iterdir():
        path.unlink()
    refused(root, f"image_{side}", f"no images of the {word} camera")


def test_the_left_camera_alone(root):
    for path in (root / "sequences/00/image_1").iterdir():
        path.unlink()
    (root / "sequences/00/image_1").rmdir()
    refused(root, "no images of the right camera", "--sensor mono")
    sequence = open_kitti(root, "00", monocular=True, max_frames=3)
    assert len(sequence) == 3
    assert sequence.camera.monocular
    assert sequence.camera.fx == 50
    left, right = sequence.read(2)
    assert left.shape == (HEIGHT, WIDTH)
    assert right is None
    (root / "sequences/00/image_0/000001.png").write_bytes(b"")
    refused(root, "image_0/000001.png", "empty", monocular=True)
    for path in (root / "sequences/00/image_0").iterdir():
        path.unlink()
    refused(root, "no images in image_0", monocular=True)


def test_no_images(root):
    (root / "sequences/01").mkdir()
    refused(root, "sequences/01: no images", "22 GB", name="01")


def test_unequal_counts(root):
    for k in (4, 5):
        (root / f"sequences/00/image_1/{k:06d}.png").unlink()
    refused(root, "6 left and 4 right", "4 frames have both", "image_1/000004", "--max-frames 4")
    refused(root, "; restore ", "image_1/000004.", start=4)


def test_left_image_missing(root):
    (root / "sequences/00/image_0/000000.png").unlink()
    refused(root, "5 left and 6 right", "; restore ", "image_0/000000.")


def test_zero_byte_image_anywhere(root):
    (root / "sequences/00/image_1/000004.png").write_bytes(b"")
    refused(root, "image_1/000004.png", "empty", "download")


def test_first_image_unreadable(root):
    (root / "sequences/00/image_0/000000.png").write_bytes(b"\0not an image")
    refused(root, "image_0/000000.png", "cannot be decoded", "download")


def test_cameras_of_different_size(root):
    write_image(root / "sequences/00/image_1/000000.png", size=(30, 60))
    refused(root, "image_1/000000.png", "60x30", "64x32")


def test_damaged_image_is_reported_when_read(root):
    path = root / "sequences/00/image_1/000003.png"
    path.write_bytes(path.read_bytes()[:200])
    sequence = open_kitti(root, "00")
    sequence.read(2)
    with pytest.raises(UnreadableImageError, match="cannot be decoded") as caught:
        sequence.read(3)
    assert caught.value.path == path


def test_image_of_another_size_is_reported_when_read(root):
    write_image(root / "sequences/00/image_0/000003.png", size=(30, 60))
    with pytest.raises(UnreadableImageError, match=r"000003\.png: has 60x30 .* 64x32"):
        open_kitti(root, "00").read(3)


def replaced(numbers, index: int, value: float):
    return [value if k == index else x for k, x in enumerate(numbers)]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "not two rows of 12"),
        (f"P0: {row(P0)}\n", "not two rows of 12"),
        (f"P0: {row(P0)}\nP1: {row(P1[:11])}\n", "not two rows of 12"),
        (f"P0: {row(P0)}\nP1: a b c\n", "not two rows of 12"),
        (f"P0: {row(replaced(P0, 0, np.nan))}\nP1: {row(P1)}\n", "NaN"),
        (f"P0: {row(P0)}\nP1: {row(P0)}\n", "baseline of P0 and P1 is 0.000 m"),
        (f"P0: {row(P1)}\nP1: {row(P0)}\n", "baseline of P0 and P1 is -0.500 m"),
        (f"P0: {row(P0)}\nP1: {row(replaced(P1, 0, 60.0))}\n", "not rectified"),
        (
            f"P0: {row(replaced(P0, 2, 80.0))}\nP1: {row(replaced(P1, 2, 80.0))}\n",
            "principal point (80.0, 16.0) lies outside the 64x32 image",
        ),
    ],
)
def test_bad_calibration(root, text, part):
    (root / "sequences/00/calib.txt").write_text(text)
    refused(root, "calib.txt", part, "calibration files")


def test_missing_calibration(root):
    (root / "sequences/00/calib.txt").unlink()
    refused(root, "calib.txt", "missing", "calibration files")


@pytest.mark.parametrize(
    ("times", "part"),
    [
        (
            [0, 0.1, 0.2, 0.2, 0.4, 0.5],
            "1 of 6 times are not later than those before them (time 4 is the first)",
        ),
        ([0, 0.1, np.nan, 0.3, 0.4, 0.5], "line 3 holds NaN"),
        ([0, 0.1, 0.2], "only 3 rows for 6 images"),
        ([], "empty"),
    ],
)
def test_bad_times(root, times, part):
    np.savetxt(root / "sequences/00/times.txt", times)
    refused(root, "times.txt", part)


def test_missing_times(root):
    (root / "sequences/00/times.txt").unlink()
    refused(root, "times.txt", "cannot read")


def test_poses_of_another_length(root):
    write_poses(root / "poses/00.txt", FRAMES - 1)
    refused(root, "poses/00.txt", "has 5 poses, but there are 6 images", "remove it")


@pytest.mark.parametrize(
    ("line", "part"),
    [
        (row(replaced(P0, 3, np.nan)), "NaN"),
        ("1 2 3", "has 3 numbers"),
        ("one two", 'no numbers (it begins with "one two")'),
        (row(P0), "not a rotation"),
    ],
)
def test_bad_poses(root, line, part):
    (root / "poses/00.txt").write_text(f"{line}\n" * FRAMES)
    refused(root, "poses/00.txt", part)


def test_another_calibration_than_its_own(root):
    """A given calibration may have distortion. ``calib.txt`` may be missing."""
    raw = open_kitti(root, "00").read(0)[0]
    (root / "sequences/00/calib.txt").unlink()
    one = "{focal: [60, 60], centre: [31, 15], distortion: [-0.1, 0, 0, 0]}"
    (root / "own.yaml").write_text(f"left: {one}\nright: {one}\nbaseline: 0.4\n")
    sequence = open_sequence("kitti", root, "00", calib=[root / "own.yaml"])
    assert sequence.camera.baseline == 0.4
    assert (sequence.camera.width, sequence.camera.height) == (WIDTH, HEIGHT)
    assert not np.array_equal(sequence.read(0)[0], raw)
    alone = open_sequence("kitti", root, "00", monocular=True, calib=[root / "own.yaml"])
    assert alone.camera.monocular
    with pytest.raises(InputError, match="--calib: rendered towns have their own calibration"):
        open_sequence("synthetic", root, "demo", calib=[root / "own.yaml"])


def test_unknown_data_set(root):
    with pytest.raises(InputError, match="--dataset nuscenes: unknown"):
        open_sequence("nuscenes", root, "00")


@pytest.mark.skipif(not REAL.is_dir(), reason="KITTI sample absent")
def test_real_sample():
    sequence = open_kitti(REAL, "00", max_frames=216)
    assert len(sequence) == 216
    assert sequence.camera.baseline == pytest.approx(0.53716, abs=1e-5)
    assert sequence.read(215)[1].shape == (376, 1241)
    refused(REAL, "1700 left and 216 right", "216 frames have both", "--max-frames 216")
