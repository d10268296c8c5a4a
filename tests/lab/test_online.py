"""The online protocol: windows, decisions, curves, figures, report and command."""

from __future__ import annotations

import json
import re
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.loopclosure.vocabulary import load
from vslam.support.errors import InputError
from vslam_lab.loopbench import report as reporting
from vslam_lab.loopbench.drives import open_drives
from vslam_lab.loopbench.measure_online import measure_drive
from vslam_lab.loopbench.online import (
    Decisions,
    Window,
    decide,
    decision_curve,
    judge,
    parse_window,
)
from vslam_lab.loopbench.schema import LoopsJson
from vslam_lab.precision_recall import max_f1, recall_at_full_precision
from vslam_lab.sources.image_source import (
    DIFFERENT,
    SAME,
    UNKNOWN,
    ImageSource,
    read_loop_matrix,
)
from vslam_lab.sources.source_registry import open_source
from vslam_lab.towns import store

TRUTH = Path(__file__).parents[3] / "shared/data/loop_ground_truth"


@contextmanager
def no_bar(what: str, total: int):
    yield lambda: None


class Scores:
    name, probability = "told", False

    def __init__(self, scores) -> None:
        self._scores = np.array(scores, float)

    def store(self, gallery):
        return None

    def scores(self, queries, stored):
        return self._scores


# There are eight images and a window of two. Images 4, 5 and 6 show the places of 0, 1 and 2.
# Image 7 was taken near image 3, but is not marked as the same place.
RELATION = np.full((8, 8), DIFFERENT, np.int8)
for pair in ((4, 0), (5, 1), (6, 2), *((k, k) for k in range(8))):
    RELATION[pair] = RELATION[pair[::-1]] = SAME
RELATION[7, 3] = RELATION[3, 7] = UNKNOWN
SCORES = np.zeros((8, 8))
SCORES[2, 0] = 0.3  # far
SCORES[3, 1] = 0.2  # far
SCORES[4, :3] = 0.9, 0.1, 0.5  # right
SCORES[5, :4] = 0.4, 0.6, 0.5, 0.5  # right
SCORES[6, :5] = 0.1, 0.7, 0.4, 0.3, 0.3  # far: the right image 2 has the second highest score
SCORES[7, :6] = 0.1, 0.1, 0.2, 0.8, 0.2, 0.2  # near
SCORES[7, 7] = SCORES[6, 6] = 1.0  # an image is not compared with itself


def told(window: Window, relation=RELATION, scores=SCORES):
    searchable = window.searchable(len(relation), None)
    decisions = decide(scores, searchable)
    return decisions, judge(decisions, relation, searchable)


def test_decisions_and_figures_worked_out_by_hand():
    decisions, judged = told(parse_window("2"))
    assert decisions.match.tolist() == [-1, -1, 0, 1, 0, 1, 1, 3]
    assert decisions.score[2:].tolist() == [0.3, 0.2, 0.9, 0.6, 0.7, 0.8]
    assert np.flatnonzero(judged.answerable).tolist() == [4, 5, 6]
    assert np.flatnonzero(judged.right).tolist() == [4, 5]
    assert np.flatnonzero(judged.far).tolist() == [2, 3, 6]
    assert np.flatnonzero(judged.near).tolist() == [7]
    curve = decision_curve(judged)
    assert curve.thresholds.tolist() == [0.2, 0.3, 0.6, 0.7, 0.8, 0.9]
    assert curve.precision == pytest.approx([2 / 6, 2 / 5, 2 / 4, 1 / 3, 1 / 2, 1, 1])
    assert curve.recall == pytest.approx([2 / 3, 2 / 3, 2 / 3, 1 / 3, 1 / 3, 1 / 3, 0])
    assert recall_at_full_precision(curve) == pytest.approx(1 / 3)
    assert max_f1(curve) == pytest.approx((2 * (1 / 2) * (2 / 3) / (1 / 2 + 2 / 3), 0.6))
    without_near = decision_curve(judged, near_is_wrong=False)
    assert without_near.thresholds.tolist() == [0.2, 0.3, 0.6, 0.7, 0.9]
    assert without_near.precision == pytest.approx([2 / 5, 2 / 4, 2 / 3, 1 / 2, 1, 1])


def test_what_verification_refuses_is_no_detection_at_any_threshold():
    decisions, _ = told(parse_window("2"))
    searchable = parse_window("2").searchable(8, None)
    kept = judge(decisions.only(np.arange(8) == 5), RELATION, searchable)
    curve = decision_curve(kept)
    assert curve.thresholds.tolist() == [0.6]
    assert recall_at_full_precision(curve) == pytest.approx(1 / 3)
    nothing = decision_curve(judge(decisions.only(np.zeros(8, bool)), RELATION, searchable))
    assert (nothing.precision.tolist(), nothing.recall.tolist()) == ([1.0], [0.0])


def test_recall_at_full_precision_is_the_lowest_threshold_s_without_a_wrong_one():
    scores = SCORES.copy()
    scores[6, 1], scores[2, 0], scores[3, 1], scores[7, 3] = 0.0, -1.0, -2.0, -3.0
    scores[7] = -3.0
    _, judged = told(parse_window("2"), scores=scores)
    assert recall_at_full_precision(decision_curve(judged)) == 1.0


def test_a_wrong_one_on_top_leaves_no_recall_at_full_precision():
    scores = SCORES.copy()
    scores[2, 0] = 5.0
    _, judged = told(parse_window("2"), scores=scores)
    assert recall_at_full_precision(decision_curve(judged)) == 0.0
    scores[2, 0] = 0.9  # no threshold separates it from the best right match
    _, judged = told(parse_window("2"), scores=scores)
    assert recall_at_full_precision(decision_curve(judged)) == 0.0


def test_recall_never_grows_with_the_threshold():
    rng = np.random.default_rng(0)
    relation = np.where(rng.random((300, 300)) < 0.01, SAME, DIFFERENT).astype(np.int8)
    relation = np.maximum(relation, relation.T)
    scores = rng.random((300, 300)).round(2) + 0.2 * (relation == SAME)
    _, judged = told(Window(20, timed=False), relation, scores)
    curve = decision_curve(judged)
    assert (np.diff(curve.thresholds) > 0).all()
    assert (np.diff(curve.recall) <= 0).all()
    assert curve.recall[0] == judged.right.sum() / judged.answerable.sum()
    for point in range(0, len(curve.thresholds), 7):
        accepted = judged.score >= curve.thresholds[point]
        assert curve.precision[point] == pytest.approx(judged.right[accepted].mean())
        assert curve.recall[point] == pytest.approx(
            judged.right[accepted].sum() / judged.answerable.sum()
        )


def test_windows_of_images_and_of_seconds():
    times = np.array([0.0, 1.0, 1.5, 4.0, 4.0, 9.0])
    assert Window(2, timed=False).searchable(6, times).tolist() == [0, 0, 1, 2, 3, 4]
    assert Window(3, timed=True).searchable(6, times).tolist() == [0, 0, 0, 2, 2, 5]
    # Without times, there is one image per second: image 2 is 3 s before image 5.
    assert Window(3, timed=True).searchable(6, None).tolist() == [0, 0, 0, 1, 2, 3]
    assert (parse_window("20s"), parse_window("200")) == (Window(20, True), Window(200, False))
    assert [str(parse_window(text)) for text in ("1.5s", "7")] == ["1.5 s", "7 images"]


@pytest.mark.parametrize("text", ["", "s", "0", "-3", "20m", "1.5", "nans", "infs"])
def test_windows_that_are_refused(text):
    with pytest.raises(InputError, match=re.escape(f"--window {text}: must be a positive")):
        parse_window(text)


def test_what_cannot_be_measured_is_said():
    with pytest.raises(InputError, match="no image has a true match before the window"):
        told(parse_window("6"))
    with pytest.raises(InputError, match="a score is NaN"):
        Decisions(np.array([0]), np.array([np.nan]))


# Ground truth matrices


@pytest.mark.parametrize("kind", ["lower", "upper", "symmetric", "sparse"])
@pytest.mark.parametrize("key", ["truth", "groundTruthMatrixKITTI00", "GT"])
def test_matrices_of_every_form_say_the_same(tmp_path, kind, key):
    truth = np.zeros((30, 30), np.uint8)
    truth[29, 2] = truth[28, 1] = 1
    form = {"lower": truth, "upper": truth.T, "symmetric": truth | truth.T,
            "sparse": csc_matrix(truth.astype(float))}  # fmt: skip
    for k in range(30):
        cv2.imwrite(str(tmp_path / f"lip6_{k:06d}.ppm"), np.full((8, 8, 3), k, np.uint8))
    savemat(tmp_path / "Lip6GroundTruth.mat", {"K": np.eye(3), key: form[kind]})
    (drive,) = open_drives(f"fabmap:{tmp_path}", tmp_path, threads=1, progress_bar=no_bar)
    searchable = parse_window("20s").searchable(30, drive.times)
    nothing = Decisions(np.full(30, -1), np.full(30, -np.inf))
    answerable = judge(nothing, drive.relation, searchable).answerable
    assert np.flatnonzero(answerable).tolist() == [28, 29]
    assert (drive.relation[29, 2], drive.relation[29, 1]) == (SAME, DIFFERENT)


@pytest.mark.skipif(not TRUTH.is_dir(), reason="no ground truth matrices")
@pytest.mark.parametrize(
    ("name", "images", "pairs", "queries"),
    [
        ("groundTruthKITTI00", 4541, 34648, 851),
        ("groundTruthKITTI02", 4661, 4025, 324),
        ("groundTruthKITTI05", 2761, 12348, 479),
        ("groundTruthKITTI06", 1101, 3289, 272),
        ("groundTruthCityCentre", 1237, 8252, 547),
        ("NewCollegeGroundTruth", 2146, 14832, 853),
        ("MILD_truthNewCollege", 1073, 9318, 537),
    ],
)
def test_published_matrices_mark_what_they_mark(name, images, pairs, queries):
    loops = read_loop_matrix(TRUTH / f"{name}.mat")
    assert loops.shape == (images, images)
    assert loops.sum() == pairs
    assert not np.triu(loops).any()  # only the row of the later image marks a pair
    searchable = parse_window("20").searchable(images, None)
    before = np.arange(images) < searchable[:, None]
    assert (loops & before).any(1).sum() == queries


def test_times_of_a_sequence_are_those_of_its_images(tmp_path):
    folder = tmp_path / "sequences" / "00"
    (folder / "image_0").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    for k in (2, 4, 5):
        cv2.imwrite(str(folder / "image_0" / f"{k:06d}.png"), np.zeros((8, 8), np.uint8))
    np.savetxt(tmp_path / "poses" / "00.txt", np.tile(np.eye(3, 4).reshape(1, 12), (6, 1)))
    (source,) = open_source(f"kitti:{tmp_path}")
    assert source.times is None
    (folder / "times.txt").write_text("0\n0.1\n0.2\n0.3\n0.4\n0.5\n")
    (source,) = open_source(f"kitti:{tmp_path}")
    assert source.times.tolist() == [0.2, 0.4, 0.5]
    assert source.select(np.array([0, 2])).times.tolist() == [0.2, 0.5]
    for damaged in ("0\n1\n", "0\n0.1\n0.2\n0.1\n0.4\n0.5\n"):
        (folder / "times.txt").write_text(damaged)
        with pytest.raises(
            InputError, match=r"times\.txt: the times must ascend and include image"
        ):
            open_source(f"kitti:{tmp_path}")


# Drives


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("town:demo", "--protocol online needs drives"),
        ("photos:x", "--protocol online needs drives"),
        ("drive:nowhere", "must be drive:ROUTE with a route of demo"),
        ("drive:demo[places=3]", "must be drive:ROUTE"),
        ("drive:demo[every=x]", "one of the options is not a number"),
        ("drive:demo[every=0]", "every at least 1"),
        ("drive:demo[change=2]", "change from 0 to 1"),
        ("kitti:/nowhere", "no images"),
    ],
)
def test_drives_that_are_refused(spec, said, tmp_path):
    with pytest.raises(InputError, match=re.escape(said)):
        open_drives(spec, tmp_path, threads=1, progress_bar=no_bar)


# Report and command


def texture(seed: int, height: int = 188, width: int = 620) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 4, width // 4), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def write_drive(folder, places) -> ImageSource:
    """Write a drive along textures. Equal places have the same texture."""
    files = []
    for k, place in enumerate(places):
        files.append(folder / f"{k:06d}.png")
        cv2.imwrite(str(files[-1]), texture(place))
    place = np.array(places)
    relation = np.where(place[:, None] == place, SAME, DIFFERENT).astype(np.int8)
    names = tuple(file.name for file in files)
    return ImageSource("walls <a>", "walls", names, tuple(files), relation, place)


def test_a_drive_is_measured_before_and_after_verification_and_reported(tmp_path):
    places = [0, 1, 2, 3, 0, 1, 4]
    drive = write_drive(tmp_path, places)
    scores = np.zeros((7, 7))
    scores[[2, 3, 4, 5, 6], [0, 0, 0, 1, 2]] = 0.1, 0.1, 0.8, 0.7, 0.9
    cells = measure_drive(drive, [Scores(scores)], parse_window("2"), load(), threads=1)
    assert [cell.verified_by for cell in cells] == ["nothing", "orb", "learned", "both"]
    for cell in cells:
        assert (cell.images, cell.answerable, cell.window) == (7, 2, "2 images")
        assert (cell.right, cell.near) == (2, 0)
    before, *after = cells
    assert (before.far, before.recall_at_100_precision) == (3, 0.0)
    assert before.max_f1 == pytest.approx(2 * (2 / 3) / (2 / 3 + 1))
    assert before.max_f1_threshold == 0.7
    for cell in after:
        assert (cell.far, cell.recall_at_100_precision, cell.max_f1) == (0, 1.0, 1.0)
    found = LoopsJson(
        seed=0, cells=[], gains=[], costs=[], online=cells, machine="one", versions={},
        created=datetime(2026, 1, 1, tzinfo=UTC),
    )  # fmt: skip
    reporting.write_report(found, tmp_path / "out")
    assert LoopsJson.model_validate_json((tmp_path / "out" / "loops.json").read_text()) == found
    text, page = ((tmp_path / "out" / f"loops.{kind}").read_text() for kind in ("md", "html"))
    assert "walls &lt;a&gt;" in page
    assert page.count("<svg") == 1
    assert (
        "(2 of 7 images have a true match), unverified: the highest recall at 100 % precision"
        in text
    )
    assert "| walls <a> | 7      | 2            | 2 images | nothing     | 0.000 (0.000) |" in text


@pytest.mark.slow
def test_command_on_a_rendered_drive(tmp_path, monkeypatch):
    monkeypatch.setenv("VSLAM_CACHE", str(tmp_path / "cache"))
    arguments = ["--protocol", "online", "--detectors", "bow,capsule", "--quiet"]
    arguments += ["--data", "drive:block[seed=7,every=14]", "--window", "10s"]
    arguments += ["--out", str(tmp_path / "out")]
    result = CliRunner().invoke(
        every_command(), ["loops", "bench", *arguments], catch_exceptions=False
    )
    assert result.exit_code == 0
    found = json.loads((tmp_path / "out" / "loops.json").read_text())
    assert found["cells"] == found["costs"] == []
    names = [(cell["detector"], cell["verified_by"]) for cell in found["online"]]
    verified = ("nothing", "orb", "learned", "both")
    assert names == [(d, v) for d in ("bow", "capsule") for v in verified]
    cell = found["online"][0]
    assert (cell["data"], cell["images"], cell["window"]) == ("block in town 7", 20, "10 s")
    assert cell["answerable"] > 0
    assert cell["right"] > 0
    rendered = next((tmp_path / "cache").rglob("drive-*/poses/block.txt"))
    assert store.clean(store.cache_folder()) > 0
    assert not rendered.exists()
