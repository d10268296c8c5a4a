"""Pairs of images: which images belong together, and which cannot be a stereo pair."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import pytest
from source_files import run_source

from vslam.datasets.association import pair_clocks
from vslam.datasets.frames import Source, TimedFrame, stored_frames
from vslam.datasets.image_files import same_images
from vslam.datasets.image_folders import open_images
from vslam.datasets.names import pair_names
from vslam.run.options import RunOptions
from vslam.run.pair import PairCheck, how_to_swap
from vslam.support.errors import InputError, UnreadableImageError

RNG = np.random.default_rng(0)
N = 30
# Times in ns of a camera at 10 Hz whose steps vary by 0.2 ms
TIMES = [
    1_700_000_000_000_000_000 + 10**8 * k + int(j) for k, j in enumerate(RNG.normal(0.0, 2e5, N))
]
LEFT = [k for k in range(N) if k != 7]  # each camera has missed a different frame
RIGHT = [k for k in range(N) if k != 21]
BOTH = [k for k in range(N) if k not in (7, 21)]


def frames_paired(left_name, right_name) -> list[tuple[int, int]] | None:
    """Pair the frames that each camera has, and return the frame of each image."""
    pairs = pair_names([left_name(k) for k in LEFT], [right_name(k) for k in RIGHT])
    if pairs is None:
        return None
    return [(LEFT[i], RIGHT[j]) for i, j in zip(pairs.first, pairs.second, strict=True)]


@pytest.mark.parametrize(
    ("left_name", "right_name"),
    [
        (lambda k: f"{k:06}", lambda k: f"{k:06}"),
        (lambda k: f"{k:06}", lambda k: f"{k:03}"),
        (lambda k: f"left_{k:04}", lambda k: f"right_{k:04}"),
        (lambda k: f"{k:04}_L", lambda k: f"{k:04}_R"),
        (lambda k: f"cam0_{k:04}", lambda k: f"cam1_{k:04}"),
        (lambda k: f"{TIMES[k]}", lambda k: f"{TIMES[k] + 200_000}"),
        (lambda k: f"{TIMES[k]}", lambda k: f"{(TIMES[k] + 200_000) // 1000}"),
        (lambda k: f"{TIMES[k] / 1e9:.6f}", lambda k: f"{TIMES[k] / 1e9 + 2e-4:.6f}"),
        (lambda k: f"l_{TIMES[k]}", lambda k: f"r_{TIMES[k] + 20_000_000}"),
        (lambda k: f"{TIMES[k]}", lambda k: f"{TIMES[k] + 60_000_000}"),
        (lambda k: f"{TIMES[k]}", lambda k: f"{TIMES[k] - 7_130_000_000}"),
        (lambda k: f"{TIMES[k]}", lambda k: f"{TIMES[k] % 10**12}"),
        (lambda k: f"run_{k // 10}_{k % 10}", lambda k: f"run_{k // 10}_{k % 10}"),
    ],
)
def test_frames_that_one_camera_missed_are_left_out(left_name, right_name):
    """By order, the frames between the two gaps would be paired one frame apart."""
    assert frames_paired(left_name, right_name) == [(k, k) for k in BOTH]


@pytest.mark.parametrize(
    ("left_name", "right_name"),
    [
        # Even steps do not tell by how much two clocks differ.
        (lambda k: f"{10**11 * k + 10**17}", lambda k: f"{10**11 * k + 3 * 10**17}"),
        (lambda k: f"{k:04}", lambda k: f"{k + 500:04}"),
    ],
)
def test_clocks_that_cannot_be_compared(left_name, right_name):
    assert frames_paired(left_name, right_name) is None
    pairs = pair_names([left_name(k) for k in range(N)], [right_name(k) for k in range(N)])
    assert pairs.first.tolist() == pairs.second.tolist() == list(range(N))


def test_order_decides_only_where_names_cannot_be_compared():
    by_order = pair_names(["ann", "bob", "eve"], ["x", "y", "z"])
    assert by_order.second.tolist() == [0, 1, 2]
    assert pair_names(["ann", "bob", "eve"], ["x", "y"]) is None
    assert pair_names(["ann", "bob", "eve"], ["bob", "eve", "ida"]).first.tolist() == [1, 2]
    assert pair_names(["0", "1", "preview"], ["0", "1", "2"]).second.tolist() == [0, 1]


def test_the_largest_difference_follows_from_the_step():
    times = np.arange(20.0)
    assert len(pair_clocks(times, times + 0.25).first) == 20
    assert pair_clocks(times, times + 0.45) is None  # this frame or the next one?
    late = times + np.where(np.arange(20) == 5, 0.4, 0.0)
    assert pair_clocks(times, late).first.tolist() == [k for k in range(20) if k != 5]


def scene(k: int, side: int) -> np.ndarray:
    image = np.random.default_rng(100 + k).integers(0, 256, (40, 64)).astype(np.uint8)
    return np.roll(image, -5 * side, axis=1)


def write(folder: Path, name: str, image: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(folder / name), image)


def test_folders_in_which_each_side_lacks_a_frame(tmp_path):
    for side, (name, frames) in enumerate({"left": LEFT, "right": RIGHT}.items()):
        for k in frames:
            write(tmp_path / name, f"{TIMES[k] + 200_000 * side}.png", scene(k, side))
    found = open_images(tmp_path)
    assert [path.stem for path in found.sides[0]] == [str(TIMES[k]) for k in BOTH]
    assert [path.stem for path in found.sides[1]] == [str(TIMES[k] + 200_000) for k in BOTH]
    np.testing.assert_allclose(found.timestamps, np.array(TIMES)[BOTH] / 1e9)
    (said,) = found.pairing.warnings()
    assert said == (
        f"{tmp_path / 'left'}: 1 of 29 images are left out because no right image has the same "
        "number or time in its name; of the right images, 1 of 29 are left out; restore the "
        "missing files, or run with --sensor mono."
    )
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in LEFT))
    np.testing.assert_allclose(open_images(tmp_path).timestamps, 0.1 * np.array(BOTH))


def test_clocks_that_differ_are_reported(tmp_path):
    for k in range(N):
        write(tmp_path / "left", f"{TIMES[k]}.png", scene(k, 0))
        write(tmp_path / "right", f"{TIMES[k] + 7_130_000_000}.png", scene(k, 1))
    found = open_images(tmp_path)
    assert len(found.timestamps) == N
    (said,) = found.pairing.warnings()
    assert "the times of the right images are 7.13 s later" in said


def test_names_that_tell_nothing(tmp_path):
    for k, name in enumerate("abc"):
        write(tmp_path / "left", f"{name}.png", scene(k, 0))
    for k, name in enumerate("xy"):
        write(tmp_path / "right", f"{name}.png", scene(k, 1))
    with pytest.raises(InputError, match="do not tell which images were taken together"):
        open_images(tmp_path, fps=10.0)


def test_one_folder_twice(tmp_path):
    for k in range(3):
        write(tmp_path / "left", f"{k}.png", scene(k, 0))
    (tmp_path / "right").symlink_to(tmp_path / "left")
    with pytest.raises(InputError, match=r"--right .* is also the folder of --data"):
        open_images(tmp_path / "left", tmp_path / "left" / ".", fps=10.0)
    with pytest.raises(InputError, match="shows the same image as"):
        open_images(tmp_path, fps=10.0).source(None)


@pytest.mark.parametrize("change", [
    lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], 0),
    lambda image: (0.8 * image + 10).astype(np.uint8),
])  # fmt: skip
def test_copies_are_told_from_pairs(corridor, change):
    left, right = corridor.left[0], corridor.right[0]
    assert same_images(left, change(left))
    assert not same_images(left, change(right))
    black = np.zeros_like(left)
    assert same_images(black, black) is None


def test_left_and_right_in_one_folder(tmp_path):
    for k in range(4):
        write(tmp_path, f"left_{k}.png", scene(k, 0))
        write(tmp_path, f"right_{k}.png", scene(k, 1))
    found = open_images(tmp_path, fps=10.0)
    assert [[path.name for path in side] for side in found.sides] == [
        [f"{side}_{k}.png" for k in range(4)] for side in ("left", "right")
    ]
    (alone,) = open_images(tmp_path, fps=10.0, sensor="mono").sides
    assert alone == found.sides[0]


def test_images_and_depth_in_one_folder(tmp_path):
    for k in range(4):
        write(tmp_path, f"frame{k:04}.png", scene(k, 0))
        write(tmp_path, f"depth{k:04}.png", scene(k, 0).astype(np.uint16) * 100)
    found = open_images(tmp_path, fps=10.0)
    assert found.depth
    assert [side[1].name for side in found.sides] == ["frame0001.png", "depth0001.png"]
    (alone,) = open_images(tmp_path, fps=10.0, sensor="mono").sides
    assert alone == found.sides[0]
    with pytest.raises(InputError, match="found no pairs"):
        open_images(tmp_path, fps=10.0, sensor="stereo")


@pytest.mark.parametrize("names", [("a_{}.png", "b_{}.png"), ("{}0.png", "{}5.png")])
def test_images_of_two_kinds_are_refused(tmp_path, names):
    for k in range(1, 4):
        write(tmp_path, names[0].format(k), scene(k, 0))
        write(tmp_path, names[1].format(k), scene(k, 0).astype(np.uint16) * 100)
    match = r"grey, 8 bits\) and .* grey, 16 bits\) are images of different kinds"
    with pytest.raises(InputError, match=match):
        open_images(tmp_path, fps=10.0, sensor="mono")


def test_three_kinds_of_images(tmp_path):
    for k in range(3):
        for name in ("rgb", "mask", "depth"):
            write(tmp_path, f"{name}_{k}.png", scene(k, 0))
    with pytest.raises(InputError, match="images of different kinds"):
        open_images(tmp_path, fps=10.0, sensor="mono")


def test_depth_as_right_image(tmp_path):
    for k in range(3):
        write(tmp_path / "a", f"{k}.png", scene(k, 0))
        write(tmp_path / "b", f"{k}.png", scene(k, 0).astype(np.uint16) * 100)
    with pytest.raises(InputError, match="are not a stereo pair; give depth images with --depth"):
        open_images(tmp_path / "a", tmp_path / "b", fps=10.0)


def source_of(corridor, change) -> Source:
    """Make a source of the corridor whose pairs have been changed."""
    pairs = change(list(zip(corridor.left, corridor.right, strict=True)))
    frames = stored_frames(0.1 * np.arange(len(pairs)), lambda k, image_map: pairs[k])
    return Source(dataset="images", name="corridor", camera=corridor.camera, stored=frames)


def checked(source: Source) -> list[str]:
    check = PairCheck(source.camera, "images", RunOptions(data="a", right=Path("b")))
    frames = list(check.watch(iter(source.stored)))
    assert frames == list(source.stored)
    return check.warnings()


def late(pairs, n):
    return [(pairs[k][0], pairs[k - n][1]) for k in range(max(n, 0), len(pairs) + min(n, 0))]


def sloping(image):
    height, width = image.shape
    M = cv2.getRotationMatrix2D((width / 2, height / 2), 1.5, 1.0)
    return cv2.warpAffine(image, M, (width, height), borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        (lambda pairs: pairs, None),
        (lambda pairs: late(pairs, 1), "seem to be 1 frame late"),
        (lambda pairs: late(pairs, -3), "seem to be 3 frames early"),
        (lambda pairs: late(pairs, 3), "seem to be 3 frames late"),
        (lambda pairs: [(a, np.roll(b, 3, axis=0)) for a, b in pairs], "not rectified"),
        (lambda pairs: [(a, sloping(b)) for a, b in pairs], "not rectified"),
        (lambda pairs: [(a, np.roll(b, 9, axis=1)) for a, b in pairs], "turned outwards"),
        (
            lambda pairs: [(a, np.random.default_rng(0).permuted(b, axis=1)) for a, b in pairs],
            "no points in common",
        ),
        # Images that prove nothing
        (lambda pairs: [(a, a) for a, _ in pairs[:8]] + pairs, None),  # a title
        (lambda pairs: pairs[:1] * 20, None),
        (lambda pairs: [(a, 0 * b) for a, b in pairs], None),
        (lambda pairs: late(pairs, 1)[:3], None),
        (lambda pairs: late(pairs[:6], 1) + pairs[5:], None),  # a fault that is found only once
    ],
)
def test_faults_of_a_pair(corridor, change, warning):
    said = checked(source_of(corridor, change))
    assert len(said) == (warning is not None)
    if warning is not None:
        assert warning in said[0]
        assert said[0].endswith(".")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda pairs: [(a, a) for a, _ in pairs], "images are the same"),
        (lambda pairs: [(b, a) for a, b in pairs], r"are swapped.*; swap the folders of"),
        (lambda pairs: [(b, a) for a, b in pairs[:1] * 20], "are swapped"),
    ],
)
def test_what_cannot_be_a_pair_is_refused(corridor, change, message):
    with pytest.raises(InputError, match=message):
        run_source(source_of(corridor, change))


def test_a_late_side_is_reported_but_not_that_of_a_perturbation(corridor):
    outcome = run_source(source_of(corridor, lambda pairs: late(pairs, 1)))
    assert any("seem to be 1 frame late" in said for said in outcome.warnings)
    sound = source_of(corridor, lambda pairs: pairs)
    outcome = run_source(sound, perturb="desync:2")
    assert not any("seem to be" in said for said in outcome.warnings)


def test_frames_that_cannot_be_read_are_passed_on(corridor):
    sound = source_of(corridor, lambda pairs: pairs).stored

    def broken(image_map):
        raise UnreadableImageError(Path("0.png"), "cannot be decoded.")

    frames = [TimedFrame(-0.1, broken), *sound]
    check = PairCheck(corridor.camera, "images", RunOptions())
    assert list(check.watch(iter(frames))) == frames
    check = PairCheck(corridor.camera, "images", RunOptions())
    assert list(check.watch(chain(sound[:1]))) == list(sound[:1])


@pytest.mark.parametrize(("dataset", "options", "advice"), [
    ("images", {"data": "a", "right": "b"}, "swap them: --data b --right a"),
    ("images", {"data": "a"}, "swap the folders of the left and the right images"),
    ("bag", {"topics": "/a,/b"}, "swap them: --topics /b,/a"),
    ("bag", {}, "give both topics with --topics, that of the left images first"),
])  # fmt: skip
def test_how_to_swap_names_only_options_that_help(dataset, options, advice):
    assert how_to_swap(dataset, RunOptions(**options)) == advice
