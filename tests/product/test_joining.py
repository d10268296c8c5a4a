"""Maps of several drives are joined to one map, and parts of maps are extracted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ring import CAMERA, LAP, Ring
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.config import Config
from vslam.loopclosure.registry import create_detector
from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap, appended, in_box, near_frames, near_point
from vslam.method.joining import join_maps
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.features import Extracted
from vslam.types.geometry import inverse, inverses
from vslam.types.loops import PerKeyframe

CONFIG = Config()


def driven(ring: Ring, places: range, seed: int) -> StoredMap:
    slam = Slam(CAMERA, CONFIG, create_detector("bow", CONFIG), threads=1)
    for i, k in enumerate(places):
        slam.step_features(Extracted(ring.see(k, seed)), 0.1 * i)
    slam.finish()
    return slam.stored_map(f"ring {places.start}").compact()


@pytest.fixture(scope="module")
def ring() -> Ring:
    return Ring.create()


@pytest.fixture(scope="module")
def drives(ring) -> list[StoredMap]:
    """Three drives with their own world frames. The third one overlaps with both others."""
    parts = (range(80), range(110, 180), range(55, 130))
    return [driven(ring, part, seed) for seed, part in enumerate(parts)]


@pytest.fixture(scope="module")
def elsewhere() -> StoredMap:
    return driven(Ring.create(seed=5), range(60), 9)


def jpegs(drive: StoredMap, content: int) -> PerKeyframe:
    """Return files of four bytes that begin like JPEG files."""
    n = drive.map.n_keyframes
    files = np.array([[255, 216, 255, content]] * n, np.uint8)
    return PerKeyframe(np.arange(0, 4 * n + 1, 4), files.ravel())


def create():
    return create_detector("bow", CONFIG), None


def frames_of(drives: list[StoredMap], starts: list[int]) -> list[np.ndarray]:
    return [start + np.array(drive.map.frames) for drive, start in zip(drives, starts, strict=True)]


def errors(map_, ring: Ring, starts: list[int]) -> np.ndarray:
    """Return the position error of each keyframe in metres, in the world of the first drive."""
    places = [starts[s] + f for s, f in zip(map_.sessions, map_.frames, strict=True)]
    true = np.array([inverse(ring.pose(starts[0])) @ ring.pose(k) for k in places])
    T_wc = inverses(map_.arrays.T_cw[: map_.n_keyframes])
    return np.linalg.norm(T_wc[:, :3, 3] - true[:, :3, 3], axis=1)


def test_an_appended_map_is_as_it_was(drives, check_map):
    one, other = drives[0], drives[1]
    both = appended(one, other)
    check_map(both.map)
    n, k = one.map.n_keyframes, 7
    assert both.map.restarts == both.map.unpredicted_restarts == [n]
    assert both.map.n_keyframes == n + other.map.n_keyframes
    assert np.array_equal(both.map.arrays.T_cw[n + k], other.map.arrays.T_cw[k])
    seen, before = both.map.landmarks_of(n + k), other.map.landmarks_of(k)
    assert np.array_equal(both.map.arrays.xyz[seen], other.map.arrays.xyz[before])
    words = both.detector.tables["words"]
    assert np.array_equal(words.of(n + k), other.detector.tables["words"].of(k))
    assert both.map.sessions.tolist() == [0] * n + [1] * other.map.n_keyframes
    assert both.drives == ("ring 0", "ring 110")
    # Each drive is a separate part until a loop joins them.
    assert np.unique(both.map.submaps()).tolist() == [0, n]


@pytest.mark.parametrize("with_images", [(0,), (1,), (0, 1)])
def test_images_are_kept_if_only_one_map_has_them(drives, with_images, tmp_path):
    one, other = (
        replace(drive, images=jpegs(drive, k)) if k in with_images else drive
        for k, drive in enumerate(drives[:2])
    )
    both, n = appended(one, other), one.map.n_keyframes
    save_map(tmp_path / "both.npz", both)
    images = load_map(tmp_path / "both.npz").images
    assert images is not None
    assert len(images) == n + other.map.n_keyframes
    for k, keyframe in enumerate((3, n + 3)):
        assert images.of(keyframe).tolist() == ([255, 216, 255, k] if k in with_images else [])
    assert appended(*drives[:2]).images is None


def test_drives_that_meet_become_one_map(drives, ring, check_map, tmp_path):
    """The first and the second drive are connected only through the third drive."""
    joined = join_maps(drives, CONFIG, create)
    assert joined.joined == [2, 1]
    assert joined.left_out == []
    map_ = joined.stored.map
    check_map(map_)
    assert map_.n_keyframes == sum(drive.map.n_keyframes for drive in drives)
    assert joined.stored.drives == ("ring 0", "ring 55", "ring 110")
    alone = np.concatenate(
        [
            errors(drive.map, ring, [start])
            for drive, start in zip(drives, (0, 110, 55), strict=True)
        ]
    )
    assert alone.max() < 0.5
    assert errors(map_, ring, [0, 55, 110]).max() < 1.0
    # Keyframes of two drives see the same landmarks.
    sessions = np.array(map_.sessions)
    shared = [set(sessions[map_.covisible(k)[0]]) for k in range(map_.n_keyframes)]
    assert any({0, 1} <= seen | {sessions[k]} for k, seen in enumerate(shared))
    assert any({1, 2} <= seen | {sessions[k]} for k, seen in enumerate(shared))

    # In the joined map, a camera can be relocalised in all three parts.
    save_map(tmp_path / "town.npz", joined.stored)
    for place in (10, 90, 170):
        slam = Slam.load(tmp_path / "town.npz", threads=1, localize=True)
        assert slam.step_features(Extracted(ring.see(place, seed=7)), 0.0).relocalised
        true = inverse(ring.pose(0)) @ ring.pose(place)
        assert np.linalg.norm(slam.trajectory().T_wc[0, :3, 3] - true[:3, 3]) < 1.0


def test_the_same_maps_give_the_same_map(drives, tmp_path):
    for name in ("a", "b"):
        save_map(tmp_path / name, join_maps(drives[::2], CONFIG, create).stored)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_map_of_another_place_is_left_out(drives, elsewhere):
    joined = join_maps([drives[0], elsewhere, drives[2]], CONFIG, create)
    assert joined.joined == [2]
    assert joined.left_out == [1]
    assert set(joined.stored.map.sessions) == {0, 1}


def test_a_joined_map_is_joined_again(drives, ring):
    first = join_maps([drives[0], drives[2]], CONFIG, create).stored
    joined = join_maps([first, drives[1]], CONFIG, create)
    assert joined.joined == [1]
    assert errors(joined.stored.map, ring, [0, 55, 110]).max() < 1.0
    assert len(joined.stored.loops) > len(first.loops)


def test_maps_of_another_camera_or_detector_are_refused(drives):
    camera = Camera(400.0, 400.0, 400.0, 150.0, 0.5, 800, 300)
    with pytest.raises(ValueError, match="another camera"):
        join_maps([drives[0], StoredMap(drives[1].map, camera)], CONFIG, create)
    with pytest.raises(ValueError, match="the detector none, not bow"):
        join_maps([drives[0], StoredMap(drives[1].map, CAMERA)], CONFIG, create)


# -- crop -----------------------------------------------------------------------------------------


def test_crop_by_box_point_and_frames(drives):
    map_ = drives[0].map
    position = inverses(map_.arrays.T_cw[: map_.n_keyframes])[:, :3, 3]
    x, z = position[:, 0], position[:, 2]
    box = [x.min() - 1, x.max() + 1, 10.0, 30.0]
    assert in_box(map_, box).tolist() == np.flatnonzero((z >= 10) & (z <= 30)).tolist()
    distance = np.hypot(x - x[5], z - z[5])
    assert near_point(map_, [x[5], z[5]], 12.0).tolist() == np.flatnonzero(distance <= 12).tolist()
    first, last = map_.frames[4], map_.frames[6]
    kept = near_frames(map_, 0, first, last, 1e-6)
    assert kept.tolist() == [4, 5, 6]
    assert len(near_frames(map_, 0, first, last, 8.0)) > 3
    assert not len(near_frames(map_, 1, first, last, 8.0))


# -- the command line -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(drives, elsewhere, tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("maps")
    for number, stored in enumerate([*drives, elsewhere]):
        save_map(folder / f"{number}.npz", stored)
    return [folder / f"{number}.npz" for number in range(4)]


def run(*words: object):
    return CliRunner().invoke(every_command(), list(map(str, words)))


def refusal(*words: object) -> str:
    result = run(*words)
    assert isinstance(result.exception, InputError), result.output
    assert "\n" not in str(result.exception)
    return str(result.exception)


def test_merge_names_what_meets_and_what_does_not(files, tmp_path):
    out = tmp_path / "town.npz"
    result = run("map", "merge", files[0], files[3], files[2], "--out", out)
    assert result.exit_code == 0, result.output
    assert f"{files[2]}: joined by " in result.output
    assert f"{files[3]}: left out" in result.output
    assert load_map(out).drives == ("ring 0", "ring 55")
    assert "drives 2: ring 0, ring 55" in " ".join(run("map", "info", out).output.split())
    quiet = ("--out", tmp_path / "again.npz", "--quiet")
    (line,) = run("map", "merge", files[0], files[3], files[2], *quiet).output.splitlines()
    assert line.startswith(f"{files[3]}: left out")


def test_maps_are_joined_with_the_thresholds_of_the_first(drives, tmp_path):
    strict = {"verification.min_inliers": 100_000}
    for name, stored in (
        ("usual", drives[0]),
        ("strict", replace(drives[0], thresholds=strict)),
        ("other", drives[2]),
    ):
        save_map(tmp_path / f"{name}.npz", stored)
    usual, strict_file, other = (tmp_path / f"{n}.npz" for n in ("usual", "strict", "other"))
    merge = ("map", "merge", "--quiet", "--out", tmp_path / "town.npz")
    result = run(*merge, strict_file, other)
    assert result.exit_code == 1
    assert f"{other}: made with other thresholds than {strict_file}" in result.output
    (tmp_path / "config.json").write_text("{}")
    result = run(*merge, strict_file, other, "--config", tmp_path / "config.json")
    assert result.exit_code == 0
    assert "other thresholds" not in result.output
    (tmp_path / "town.npz").unlink()
    result = run(*merge, usual, other)
    assert result.exit_code == 0
    assert "other thresholds" not in result.output


def test_a_joined_map_is_exported(drives, tmp_path):
    joined = join_maps([drives[0], drives[2]], CONFIG, create).stored
    save_map(tmp_path / "town.npz", joined)
    for words in (("g2o",), ("ply", "--no-colours")):
        result = run("export", words[0], tmp_path / "town.npz", *words[1:])
        assert result.exit_code == 0, result.output
    text = (tmp_path / "town.g2o").read_text()
    lines = text.splitlines()
    ids = [line.split()[1] for line in lines if line.startswith("VERTEX")]
    assert ids == [str(k) for k in range(joined.map.n_keyframes)]
    assert (tmp_path / "town.ply").stat().st_size > 0
    # The edges are weighted by the thresholds with which the map was made.
    drifting = replace(joined, thresholds={"pose_graph.rotation_drift": 0.1})
    save_map(tmp_path / "drifting.npz", drifting)
    result = run("export", "g2o", tmp_path / "drifting.npz")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "drifting.g2o").read_text() != text


def test_merge_of_maps_that_do_not_meet_writes_nothing(files, tmp_path):
    result = run("map", "merge", files[0], files[3], "--out", tmp_path / "m.npz", "--quiet")
    assert result.exit_code == 1
    assert "nothing was written" in result.output
    assert not list(tmp_path.iterdir())


def test_crop_writes_a_map_to_localise_in(files, ring, tmp_path):
    out = tmp_path / "part.npz"
    words = ("map", "crop", files[0], "--frames", "30:60", "--within", "1", "--out", out)
    assert run(*words).exit_code == 0
    assert 5 < load_map(out).map.n_keyframes < load_map(files[0]).map.n_keyframes
    slam = Slam.load(out, threads=1, localize=True)
    assert slam.step_features(Extracted(ring.see(45, seed=7)), 0.0).relocalised
    true = inverse(ring.pose(0)) @ ring.pose(45)
    assert np.linalg.norm(slam.trajectory().T_wc[0, :3, 3] - true[:3, 3]) < 0.5


def test_refusals(files, tmp_path):
    out = ("--out", tmp_path / "m.npz")
    assert "two or more" in refusal("map", "merge", files[0], *out)
    assert "exists already" in refusal("map", "merge", *files[:2], "--out", files[2])
    assert "given twice" in refusal("map", "merge", files[0], files[1], files[0], *out)
    nowhere = ("--out", tmp_path / "gone" / "m.npz")
    assert "there is no folder" in refusal("map", "merge", *files[:2], *nowhere)
    assert "there is no folder" in refusal("map", "crop", files[0], "--box=0,1,0,1", *nowhere)
    assert "cannot be read" in refusal("map", "merge", files[0], tmp_path / "gone", *out)
    assert "give exactly one" in refusal("map", "crop", files[0], *out)
    assert "4 numbers" in refusal("map", "crop", files[0], "--box", "1,2,x", *out)
    assert "has no keyframe there" in refusal(
        "map", "crop", files[0], "--point", "900,900", "--within", "5", *out
    )
    assert not (tmp_path / "m.npz").exists()
    assert "give --no-colours, or the folder" in refusal("export", "ply", files[0])


assert LAP > 180  # the drives are parts of one lap
