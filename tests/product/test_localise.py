"""Continuing in a saved map: relocalisation, extension, resuming, and localisation only."""

from __future__ import annotations

import errno
import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ring import CAMERA, LAP, Ring
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.config import Config
from vslam.evaluation.map_alignment import name_of_world
from vslam.loopclosure.registry import create_detector
from vslam.maps.storage import load_map, save_map
from vslam.report import folder
from vslam.slam import Slam
from vslam.support.errors import InputError, ResultsError
from vslam.types.features import Extracted, TrackingState, TrackResult
from vslam.types.geometry import inverse
from vslam_lab.towns import parse_drive

CONFIG = Config()
NOTHING = Extracted.nothing()


@pytest.fixture(scope="module")
def ring() -> Ring:
    return Ring.create()


def new(threads: int = 1) -> Slam:
    return Slam(CAMERA, CONFIG, create_detector("bow", CONFIG), threads=threads)


def drive(slam: Slam, ring: Ring, places, seed: int, start: float = 0.0) -> list[TrackResult]:
    """Track ten frames per second. None stands for a black image."""
    results = [
        slam.step_features(NOTHING if k is None else Extracted(ring.see(k, seed)), start + 0.1 * i)
        for i, k in enumerate(places)
    ]
    slam.finish()
    return results


def states(results: list[TrackResult]) -> str:
    return "".join(result.state[0] for result in results)


def off(slam: Slam, ring: Ring, places, first: float = 0.0) -> np.ndarray:
    """Return the distance in metres of each frame to its true position, in the world of the map."""
    true = np.array([inverse(ring.pose(first)) @ ring.pose(k) for k in places])
    return np.linalg.norm(slam.trajectory().T_wc[:, :3, 3] - true[:, :3, 3], axis=1)


def everything(slam: Slam) -> bytes:
    """Return everything that a map file would hold, and everything that it leaves out."""
    map_, memory = slam.map, slam.detector.memory()
    arrays = [*map_.arrays, *map_.keyframes, *(table.values for table in memory.tables.values())]
    return b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)


@pytest.fixture(scope="module")
def file(ring, tmp_path_factory) -> Path:
    slam = new()
    drive(slam, ring, range(100), seed=0)
    path = tmp_path_factory.mktemp("maps") / "ring.npz"
    slam.save(path, "ring")
    return path


def test_localising_finds_every_frame_and_changes_nothing(file, ring):
    slam = Slam.load(file, threads=1, localize=True)
    before = everything(slam)
    places = range(20, 80)
    results = drive(slam, ring, places, seed=1, start=500.0)
    assert states(results) == "O" * 60
    assert [result.relocalised for result in results] == [True] + 59 * [False]
    assert not any(result.is_keyframe for result in results)
    assert off(slam, ring, places).max() < 0.3
    assert slam.in_map().all()
    assert everything(slam) == before
    assert not slam.loops


def test_localising_backwards_through_the_map_looks_around_where_it_is(file, ring):
    """The reference keyframe follows the camera."""
    slam = Slam.load(file, threads=1, localize=True)
    places = [80 - 0.5 * k for k in range(120)]
    results = drive(slam, ring, places, seed=2)
    assert states(results).count("L") == 0
    assert off(slam, ring, places).max() < 0.3


def test_localising_outside_the_map_is_lost_and_found_again(file, ring):
    slam = Slam.load(file, threads=1, localize=True)
    places = [*range(150, 160), *range(30, 40), *range(150, 155), *range(60, 65)]
    results = drive(slam, ring, places, seed=3)
    assert states(results) == "L" * 10 + "O" * 10 + "L" * 5 + "O" * 5
    assert slam.in_map().tolist() == [False] * 10 + [True] * 10 + [False] * 5 + [True] * 5
    # Earlier frames have the pose at which the camera was found.
    T_wc = slam.trajectory().T_wc
    assert np.array_equal(T_wc[0], T_wc[10])
    assert np.array_equal(T_wc[9], T_wc[10])


def test_a_camera_that_is_never_found_has_poses_all_the_same(file):
    slam = Slam.load(file, threads=1, localize=True)
    slam.skip(0.0)
    for k in range(5):
        assert slam.step_features(NOTHING, 1.0 + k).state == TrackingState.LOST
    slam.finish()
    assert len(slam.trajectory()) == 6
    assert not slam.in_map().any()


@pytest.mark.slow
def test_going_on_extends_the_map_and_closes_the_ring(file, ring, check_map):
    slam = Slam.load(file, threads=1)
    n = slam.map.n_keyframes
    places = [*range(90, LAP + 25)]
    results = drive(slam, ring, places, seed=4)
    check_map(slam.map)
    assert set(states(results)) <= {"O", "W"}
    assert states(results).count("W") <= 1
    assert results[0].relocalised
    assert not slam.map.restarts
    assert (slam.map.sessions[:n] == 0).all()
    assert set(slam.map.sessions[n:]) == {1}
    # The camera reached the start of the first drive, which closes a loop between both drives.
    closed = [edge for edge in slam.loops if edge.accepted]
    assert closed
    assert all(edge.match < n <= edge.query for edge in closed)
    assert off(slam, ring, places).max() < 1.0
    assert len(slam.keyframe_trajectory()) == sum(
        bool(slam.map.arrays.keyframe_alive[k]) for k in range(n, slam.map.n_keyframes)
    )


def test_elsewhere_a_submap_begins_until_a_loop_joins_it(file, ring, check_map, tmp_path):
    slam = Slam.load(file, threads=1)
    n = slam.map.n_keyframes
    places = [*range(150, LAP + 25)]
    results = drive(slam, ring, places, seed=5)
    check_map(slam.map)
    assert states(results).startswith("LL")
    assert slam.map.restarts == slam.map.unpredicted_restarts == [n]
    assert any(edge.accepted for edge in slam.loops)
    tracked = np.array([result.state != TrackingState.LOST for result in results])
    assert slam.in_map()[tracked].mean() > 0.99
    assert off(slam, ring, places)[tracked].max() < 1.5
    # Parts that were joined are still one part after saving.
    slam.save(tmp_path / "joined.npz", "again")
    again = Slam.load(tmp_path / "joined.npz", threads=1, localize=True)
    drive(again, ring, range(160, 165), seed=6)
    assert again.in_map().all()


def test_what_was_not_joined_is_not_in_the_map(file, ring):
    slam = Slam.load(file, threads=1)
    results = drive(slam, ring, range(130, 160), seed=7)
    assert states(results)[5:] == "O" * 25
    assert not slam.in_map().any()


@pytest.mark.slow
def test_a_resumed_drive_has_all_its_frames(ring, tmp_path):
    whole, first = new(), new()
    drive(whole, ring, range(120), seed=8)
    drive(first, ring, range(60), seed=8)
    first.save(tmp_path / "half.npz", "half")
    second = Slam.load(tmp_path / "half.npz", threads=1, resume=True)
    results = drive(second, ring, range(60, 120), seed=8, start=6.0)
    assert states(results) == "O" * 60
    assert not results[0].relocalised  # it was known where the camera was
    assert len(second.trajectory()) == 120
    errors = [np.sqrt((off(slam, ring, range(120)) ** 2).mean()) for slam in (whole, second)]
    assert errors[1] < 1.2 * errors[0]
    assert set(second.map.sessions) == {0}
    assert second.map.frames[-1] > 100
    second.save(tmp_path / "whole.npz", "whole")
    assert second.stored_map("x").drives == ("x",)
    with pytest.raises(ValueError, match="not later than the last one"):
        second.step_features(NOTHING, 5.0)


def test_a_drive_without_a_detector_resumes_where_it_was(ring, tmp_path, caplog):
    first = Slam(CAMERA, CONFIG, threads=1)
    drive(first, ring, range(30), seed=9)
    first.save(tmp_path / "whole.npz", resumable=True)
    Slam.load(tmp_path / "whole.npz", threads=1, resume=True)
    assert not caplog.messages
    first.save(tmp_path / "half.npz")
    second = Slam.load(tmp_path / "half.npz", threads=1, resume=True)
    assert "will differ from those of an uninterrupted" in caplog.messages[0]
    assert states(drive(second, ring, range(30, 60), seed=9, start=3.0)) == "O" * 30
    assert off(second, ring, range(60)).max() < 0.3


def test_a_part_of_a_map_has_no_drive_to_resume(ring, tmp_path):
    slam = Slam(CAMERA, CONFIG, threads=1)
    drive(slam, ring, range(30), seed=9)
    save_map(tmp_path / "part.npz", slam.stored_map().select(np.arange(2)))
    with pytest.raises(InputError, match="no drive to continue; load it without resume"):
        Slam.load(tmp_path / "part.npz", threads=1, resume=True)
    assert Slam.load(tmp_path / "part.npz", threads=1).map.n_keyframes == 2


def test_a_drive_without_a_keyframe_yet_is_resumed(ring, tmp_path):
    first = new()
    drive(first, ring, [None, None], seed=1)
    first.save(tmp_path / "empty.npz", "ring")
    second = Slam.load(tmp_path / "empty.npz", threads=1, resume=True)
    assert states(drive(second, ring, range(10), seed=1, start=0.2)) == "O" * 10
    assert len(second.trajectory()) == 12
    again = Slam.load(tmp_path / "empty.npz", threads=1)
    drive(again, ring, range(2), seed=1)
    assert again.stored_map("ring").drives == ("ring",)  # only drives that have keyframes


def test_a_drive_through_known_places_is_resumed_by_its_own_clock(file, ring, tmp_path):
    first = Slam.load(file, threads=1)
    assert not any(result.is_keyframe for result in drive(first, ring, range(10, 14), seed=2))
    first.save(tmp_path / "second.npz", "ring")
    second = Slam.load(tmp_path / "second.npz", threads=1, resume=True)
    # The last keyframe of the map belongs to another drive, with a later time of day.
    results = drive(second, ring, [*range(14, 120)], seed=2, start=0.4)
    assert states(results) == "O" * 106


def test_the_first_frame_after_a_cut_tells_the_speed(ring, tmp_path):
    first = new()
    drive(first, ring, range(60), seed=8)
    first.save(tmp_path / "half.npz", "half")
    second = Slam.load(tmp_path / "half.npz", threads=1, resume=True)
    before = first.trajectory().T_wc[-1]
    now = second.step_features(Extracted(ring.see(60, seed=8)), 6.0).T_wc
    expected = now @ inverse(before) @ now
    np.testing.assert_allclose(second.skip(6.1).T_wc, expected, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("localize", [False, True])
def test_the_same_bytes_with_one_thread_and_two(file, ring, localize):
    places = [*range(60, 120), None, None, None, None, *range(20, 50)]
    done = []
    for threads in (1, 2, 1):
        slam = Slam.load(file, threads=threads, localize=localize)
        online = np.array([r.T_wc for r in drive(slam, ring, places, seed=10)])
        done.append(everything(slam) + online.tobytes() + slam.trajectory().T_wc.tobytes())
    assert done[0] == done[1] == done[2]


# -- the command line -----------------------------------------------------------------------------


def vslam(*words: object):
    return CliRunner().invoke(every_command(), [*map(str, words)])


def report_of(folder: Path) -> dict:
    return json.loads((folder / "latest" / "report.json").read_text())


def refusal(*words: object) -> str:
    result = vslam(*words)
    assert isinstance(result.exception, InputError), result.output
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.fixture(scope="module")
def mapped(kitti_tree, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("mapped")
    words = ("--data", kitti_tree, "--no-record", "--no-report", "--quiet", "--out", out)
    result = vslam("run", *words, "--max-frames", 20, "--save-map", out / "kept.npz")
    assert result.exit_code == 0, result.output
    assert (out / "kept.npz").read_bytes() == (out / "latest" / "map.npz").read_bytes()
    return out / "latest"


@pytest.mark.parametrize(("dataset", "one", "other", "same"), [
    ("synthetic", "lane", "lane+change:1+seed:1", True),
    ("synthetic", "lane", "night", True),
    ("synthetic", "lane", "block", False),
    ("images", "yard+1", "yard+2", False),
])  # fmt: skip
def test_only_rendered_drives_along_one_route_share_a_world(dataset, one, other, same):
    worlds = {
        name_of_world(
            SimpleNamespace(
                sequence=SimpleNamespace(
                    dataset=dataset,
                    name=name,
                    world=parse_drive(name)[0] if dataset == "synthetic" else "",
                )
            )
        )
        for name in (one, other)
    }
    assert (len(worlds) == 1) == same


@pytest.mark.slow
def test_localise_by_the_command_line(kitti_tree, mapped, tmp_path):
    before = (mapped / "map.npz").read_bytes()
    words = ("run", "--data", kitti_tree, "--no-record", "--out", tmp_path, "--start", 4)
    result = vslam(*words, "--map", mapped, "--localize")
    assert result.exit_code == 0, result.output
    assert re.search(r"In the map +100\.0 % +of the frames", result.output)
    assert re.search(r"Error in the map +0\.0\d+ m", result.output)
    assert "found in 1 of 1 attempt, first after 0.00 s" in result.output
    report = report_of(tmp_path)
    assert report["localize"]
    assert report["detector"] == "both"
    figures = report["in_map"]
    assert (figures["in_map_percent"], figures["found"], figures["sought"]) == (100.0, 1, 1)
    assert figures["first_fix_s"] == 0.0
    # The alignment of the map gives a larger error than an alignment of this drive.
    assert report["ate_rmse_m"] <= figures["error_m"] < 0.1
    assert not (tmp_path / "latest" / "map.npz").exists()
    assert (mapped / "map.npz").read_bytes() == before
    page = (tmp_path / "latest" / "report.md").read_text()
    assert "In the map" in page


@pytest.mark.parametrize("name", ["camera", "detector"])
def test_a_damaged_header_gets_a_sentence(kitti_tree, mapped, tmp_path, name):
    with np.load(mapped / "map.npz") as file:
        arrays = dict(file)
    header = json.loads(bytes(arrays["header"])) | {name: {"x": 1}}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(tmp_path / "m.npz", **arrays)
    run = ("run", "--data", kitti_tree, "--out", tmp_path / "out", "--map", tmp_path / "m.npz")
    assert "the map is damaged" in refusal(*run)
    assert not (tmp_path / "out").exists()


def test_a_map_that_cannot_be_written_elsewhere_is_in_the_folder(kitti_tree, tmp_path, monkeypatch):
    to = tmp_path / "town.npz"

    def full_there(path, stored):
        if path == to:
            raise OSError(errno.ENOSPC, "No space left on device")
        save_map(path, stored)

    monkeypatch.setattr(folder, "save_map", full_there)
    words = ("run", "--data", kitti_tree, "--no-record", "--no-report", "--quiet")
    result = vslam(*words, "--out", tmp_path, "--max-frames", 3, "--save-map", to)
    assert isinstance(result.exception, ResultsError)
    assert f"{to} could not be written (No space left on device)" in str(result.exception)
    assert load_map(tmp_path / "latest" / "map.npz").map.n_keyframes


def test_the_latest_run_is_that_before_this_one(kitti_tree, tmp_path):
    words = ("run", "--data", kitti_tree, "--no-record", "--no-report", "--quiet")
    words = (*words, "--out", tmp_path, "--max-frames", 6)
    assert vslam(*words).exit_code == 0
    first = (tmp_path / "latest").resolve()
    assert vslam(*words, "--map", tmp_path / "latest").exit_code == 0
    options = json.loads((tmp_path / "latest" / "run.json").read_text())
    assert options["map_file"] == str(first / "map.npz")
    assert len(load_map(tmp_path / "latest" / "map.npz").drives) == 2


def test_go_on_by_the_command_line(kitti_tree, mapped, tmp_path):
    words = ("run", "--data", kitti_tree, "--no-record", "--no-report", "--quiet")
    result = vslam(*words, "--out", tmp_path, "--start", 16, "--map", mapped / "map.npz")
    assert result.exit_code == 0, result.output
    figures = report_of(tmp_path)["in_map"]
    assert figures["in_map_percent"] == 100.0
    assert figures["error_m"] < 0.1
    info = vslam("map", "info", tmp_path / "latest").output
    assert "drives 2: kitti 00, kitti 00" in " ".join(info.split())
    images = ("--data", kitti_tree)
    assert "several drives" in refusal("export", "colmap", tmp_path / "latest", *images)


def test_refusals(kitti_tree, mapped, tmp_path):
    run = ("run", "--data", kitti_tree, "--no-record", "--out", tmp_path / "out")
    assert "--map" in refusal(*run, "--localize")
    assert "leave it out" in refusal(*run, "--map", mapped, "--compare", "none")
    assert "leave it out" in refusal(
        *run, "--map", mapped, "--localize", "--save-map", tmp_path / "m.npz"
    )
    assert "cannot be read" in refusal(*run, "--map", tmp_path)
    assert "made with the detector both" in refusal(*run, "--map", mapped, "--detector", "none")
    assert "camera is not that of the images" in refusal(*run, "--map", mapped, "--sensor", "mono")
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"orb": {"n_levels": 4}}))
    assert "another image pyramid" in refusal(*run, "--map", mapped, "--config", config)
    assert "there is no folder" in refusal(*run, "--save-map", tmp_path / "gone" / "m.npz")
    assert "is a folder" in refusal(*run, "--save-map", tmp_path)
    assert not list((tmp_path / "out").glob("*/report.json"))


def test_the_experiment_by_night_needs_images_beyond_its_map(kitti_tree, tmp_path, monkeypatch):
    script = Path(__file__).parents[2] / "tools/experiments/light/day_night.py"
    words = ["kitti", "00=6", "--data", kitti_tree, "--max-frames", "6", "--detectors", "bow"]
    words = [script, *words, "--out", tmp_path / "table.csv"]
    monkeypatch.setattr("sys.argv", list(map(str, words)))
    with pytest.raises(SystemExit, match="00: no image is left to localise; give a smaller"):
        runpy.run_path(str(script), run_name="__main__")
