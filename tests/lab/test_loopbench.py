"""The comparison of loop detectors on images: conditions, sets, figures, report and command."""

from __future__ import annotations

import csv
import gc
import json
import re
import weakref
from contextlib import contextmanager
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.loopclosure.vocabulary import load
from vslam.support.errors import InputError
from vslam_lab.loopbench import report as reporting
from vslam_lab.loopbench.conditions import Condition, apply, clipped, parse_conditions, turned
from vslam_lab.loopbench.cost import cost
from vslam_lab.loopbench.detectors import BowScorer, DetectorSet, LocalDescriptorCache, describe
from vslam_lab.loopbench.measure import (
    LENGTH,
    MIN_CONFIRMED,
    TOP,
    confirmed_cells,
    epipolar_inliers,
    log_odds,
    measure,
    sequence_scores,
    thinned,
)
from vslam_lab.loopbench.schema import LoopsJson, Verified
from vslam_lab.loopbench.sets import QuerySet, TestSet, open_set
from vslam_lab.precision_recall import average_precision, precision_recall
from vslam_lab.sources.image_source import DIFFERENT, SAME, UNKNOWN
from vslam_lab.towns import store


@contextmanager
def no_bar(what: str, total: int):
    yield lambda: None


def texture(seed: int, height: int = 188, width: int = 620) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 4, width // 4), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def vocabulary():
    return load()


@pytest.mark.parametrize("apart", [10.0, 2.0])
def test_the_curve_that_is_drawn_has_the_area_of_the_whole_one(apart):
    """Only 50 of 20,000 pairs show the same place. A good detector ranks all of them first."""
    rng = np.random.default_rng(0)
    same = np.arange(20_000) < 50
    whole = precision_recall(same, rng.standard_normal(same.size) + apart * same)
    drawn = thinned(whole)
    assert len(drawn.recall) <= 201
    assert (drawn.recall[0], drawn.recall[-1]) == (1.0, 0.0)
    area = -np.trapezoid(drawn.precision, drawn.recall)
    assert area == pytest.approx(average_precision(whole), abs=0.02)


def test_conditions_are_kinds_times_strengths():
    names = [c.name for c in parse_conditions("light,none,all,light", "0.5,1")]
    assert names == ["none", "light:0.5", "light:1", "all:0.5", "all:1"]
    strong, mild = Condition("viewpoint", 1.0), Condition("all", 1.0)
    assert strong.lateral == (-3.2, -3.2)
    assert strong.heading == (30.0, 30.0)
    assert mild.heading == (15.0, 15.0)
    assert Condition("change", 0.5).change == 0.5
    assert Condition("change", 1.0).change == 0.9
    assert Condition("light", 1.0).change == 0.0


@pytest.mark.parametrize(
    ("kinds", "strengths", "said"),
    [
        ("fog", "1", "--perturb fog: unknown"),
        ("light", "2", "at most 1"),
        ("light", "x", "numbers"),
    ],
)
def test_conditions_that_are_refused(kinds, strengths, said):
    with pytest.raises(InputError, match=said):
        parse_conditions(kinds, strengths)


def test_clipping_takes_a_share_of_the_pixels():
    image = texture(0)
    assert np.mean(clipped(image, 0.6, True) == 255) == pytest.approx(0.6, abs=0.02)
    assert np.mean(clipped(image, 0.6, False) == 0) == pytest.approx(0.6, abs=0.02)


def test_a_turned_camera_sees_in_its_middle_what_was_aside():
    image = np.zeros((200, 800), np.uint8)
    focal = 400 / np.tan(np.radians(40.0))
    column = round(400 + focal * np.tan(np.radians(15.0)))
    image[:, column - 2 : column + 3] = 255
    bright = np.flatnonzero(turned(image, 15.0)[100] > 128)
    assert bright.mean() == pytest.approx(400, abs=1)
    # Outside the original image.
    assert (turned(np.full_like(image, 90), 30.0)[:, -200:] == 0).mean() > 0.9


def test_conditions_repeat_with_their_seed_and_leave_the_rest_alone():
    images = [texture(k) for k in range(3)]
    for kind in ("light", "clipping", "viewpoint", "occlusion", "noise", "blur", "all"):
        once = apply(Condition(kind, 1.0), images, 5, rendered=False)
        again = apply(Condition(kind, 1.0), images, 5, rendered=False)
        other = apply(Condition(kind, 1.0), images, 6, rendered=False)
        assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))
        assert any((a != b).any() for a, b in zip(once, images, strict=True)), kind
        assert kind == "blur" or any((a != b).any() for a, b in zip(once, other, strict=True)), kind
    rendered = apply(Condition("viewpoint", 1.0), images, 5, rendered=True)
    assert all(a is b for a, b in zip(rendered, images, strict=True))


def test_a_drive_asks_for_what_lies_long_before(tmp_path):
    folder = tmp_path / "sequences" / "00" / "image_0"
    folder.mkdir(parents=True)
    for k in range(60):
        cv2.imwrite(str(folder / f"{k:06d}.png"), texture(k, 40, 80))
    poses = np.tile(np.eye(3, 4), (60, 1, 1))
    poses[:, 2, 3] = 10.0 * np.arange(60)
    poses[55, 2, 3] = poses[2, 2, 3]
    (tmp_path / "poses").mkdir()
    np.savetxt(tmp_path / "poses" / "00.txt", poses.reshape(60, 12))
    (found,) = open_set(f"kitti:{tmp_path}", tmp_path, threads=1, progress_bar=no_bar)
    asked = found.query_set(Condition("none"), 0)
    assert asked.relation.shape == (10, 10)
    same = np.argwhere(asked.relation == SAME)
    assert same.tolist() == [[5, 2]]
    # Image 50 is not compared with image 1 and later images.
    assert (asked.relation[0, 1:] == UNKNOWN).all()
    assert asked.relation[9, 0] == DIFFERENT
    assert found.query_set(Condition("change", 1.0), 0) is None
    assert asked.in_order
    with pytest.raises(InputError, match="00 has only 50 images; give more than 50"):
        open_set(f"kitti:{tmp_path}[last=49]", tmp_path, threads=1, progress_bar=no_bar)


def test_of_pairs_the_second_images_ask(tmp_path):
    rows = []
    (tmp_path / "images").mkdir()
    for k in range(3):
        for side in "ab":
            cv2.imwrite(str(tmp_path / "images" / f"{k}{side}.png"), texture(k, 40, 80))
        place = {"x_a": 0.0, "z_a": 200.0 * k, "yaw_a": 0.0}
        moved = {"x_b": 1.0, "z_b": 200.0 * k, "yaw_b": 20.0}
        rows.append({"a": f"images/{k}a.png", "b": f"images/{k}b.png", "same": 1, **place, **moved})
    with (tmp_path / "pairs.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    (found,) = open_set(f"pairs:{tmp_path}", tmp_path, threads=1, progress_bar=no_bar)
    asked = found.query_set(Condition("none"), 0)
    assert asked.relation.tolist() == (2 * np.eye(3) - 1).astype(int).tolist()


@pytest.mark.parametrize(
    "spec", ["town:nowhere", "town:demo[sed=1]", "town:demo[seed=x]", "town:", "pears:x"]
)
def test_sets_that_are_refused(spec, tmp_path):
    with pytest.raises(InputError, match=re.escape(f"--data {spec}")):
        open_set(spec, tmp_path, threads=1, progress_bar=no_bar)


def test_one_epipolar_geometry_tells_a_place_from_another(vocabulary):
    image = texture(1)
    H = np.array([[1.02, 0.01, 6.0], [-0.01, 0.99, -3.0], [2e-5, 0.0, 1.0]])
    moved = cv2.warpPerspective(image, H, image.shape[::-1])
    one, two, other = describe([image, moved, texture(2)], vocabulary, 1)
    assert epipolar_inliers(one, two) > 100
    assert epipolar_inliers(one, other) == 0


class Told:
    """A detector that knows the ground truth, or its opposite."""

    probability = True

    def __init__(self, name: str, relation: np.ndarray, sign: float) -> None:
        self.stored: list[int] = []
        self.name, self._p = name, np.where(relation == SAME, 0.5 + 0.45 * sign, 0.5 - 0.45 * sign)

    def store(self, gallery):
        self.stored.append(len(gallery))

    def scores(self, queries, stored):
        return self._p


def test_figures_of_detectors_that_know_and_that_err(vocabulary):
    images = [texture(k) for k in range(6)]
    relation = (2 * np.eye(6) - 1).astype(np.int8)
    relation[0, 1] = UNKNOWN
    test_set = TestSet("walls", lambda condition, seed: QuerySet(images, images, relation))
    scorers = [Told("liar", relation, -1.0), Told("sage", relation, 1.0)]
    cells, gains = measure(test_set, Condition("none"), DetectorSet(scorers, vocabulary, 1), 0)
    liar, sage = cells
    assert sage.figures["average_precision"] == 1.0
    assert sage.figures["recall_at_100_precision"] == 1.0
    assert sage.accuracy == {"0.5": 1.0, "0.9": 1.0}
    assert sage.accepted == (1.0, 1.0)
    assert (sage.queries, sage.first_right) == (6, 1.0)
    assert sage.top_average_precision == (1.0,) * TOP
    assert liar.top_average_precision[0] == 0.0
    # Query 0 has only five images whose relation is known, so that its match is among the top five.
    assert liar.top_average_precision[-1] == pytest.approx(1 / 6 / 30)
    assert liar.top_curve.recall[0] == pytest.approx(1 / 6, abs=1e-5)
    names = ("orb", "learned", "both")
    assert sage.verified == {name: Verified(right=1.0, wrong=0) for name in names}
    assert liar.accuracy == {"0.5": 0.0, "0.9": 0.0}
    assert liar.accepted == (0.0, 0.0)
    # The best images of the inverted detector show other walls, so that verification fails.
    assert liar.first_right == 0.0
    assert liar.verified == {name: Verified(right=0.0, wrong=0) for name in names}
    (gain,) = gains
    assert gain.low > 0.7
    assert gain.difference == pytest.approx(1.0 - liar.figures["average_precision"])
    assert test_set.query_set(Condition("none"), 0).relation[0, 1] == UNKNOWN


def test_a_sequence_is_the_mean_along_the_best_line():
    """There are three queries and three images.

    At all speeds from 0.8 to 1.2, a line advances by one image over two queries.
    """
    scores = np.array([[0.3, 0.0, 0.6], [0.0, 0.9, 0.0], [0.6, 0.0, 0.3]])
    found = sequence_scores(scores)
    np.testing.assert_allclose(found[0], scores[0])
    # There is no image before image 0. It is replaced with the mean of query 0.
    np.testing.assert_allclose(found[1], [(0.0 + 0.3) / 2, (0.9 + 0.3) / 2, 0.0])
    np.testing.assert_allclose(found[2, 2], (0.3 + 0.9 + 0.3) / 3)


@pytest.mark.slow
def test_a_sequence_outvotes_an_image_that_looks_like_all(vocabulary):
    """The same route is queried, but one gallery image is the most similar one for every query."""
    n = 30
    relation = np.where(np.eye(n) > 0, SAME, DIFFERENT).astype(np.int8)
    p = np.full((n, n), 0.1) + 0.6 * np.eye(n)
    p[:, 3] = 0.8
    told = Told("misled", relation, 1.0)
    told._p = p
    images, found = [texture(0)] * n, {}
    for in_order in (True, False):
        query_set = QuerySet(images, images, relation, in_order)
        test_set = TestSet("way", lambda condition, seed, found=query_set: found)
        (cell,), _ = measure(test_set, Condition("none"), DetectorSet([told], vocabulary, 1), 0)
        assert cell.first_right == pytest.approx(1 / n)
        found[in_order] = cell.sequence_right
    assert found[True] > 0.8
    assert found[False] is None
    # In the opposite direction, the images have a different order.
    backwards = sequence_scores(log_odds(p[::-1])).argmax(1)[LENGTH:]
    assert (backwards == np.arange(n)[::-1][LENGTH:]).mean() < 0.2


def test_what_is_made_of_images_asked_for_is_kept_while_they_are_asked_for(vocabulary):
    told = Told("sage", np.ones((2, 2)), 1.0)
    detectors = DetectorSet([told], vocabulary, 1)
    galleries = [[texture(k), texture(k + 1)] for k in range(5)]
    views, _ = detectors.gallery(galleries[0])
    for k in (0, 1, 2, 0, 3):  # a set with a different gallery in between
        detectors.gallery([image.copy() for image in galleries[k]])
    assert detectors.gallery(galleries[0])[0] is views
    assert len(told.stored) == 4
    detectors.gallery(galleries[1])
    assert len(told.stored) == 5
    assert detectors.gallery(galleries[0][::-1])[0] is not views


def test_local_descriptors_are_kept_as_long_as_their_image(vocabulary):
    local, images = LocalDescriptorCache(), describe([texture(0), texture(1)], vocabulary, 1)
    kept, freed = (weakref.ref(local.of(image).coarse) for image in images)
    assert local.of(images[0]).coarse is kept()
    images.pop()
    gc.collect()
    assert local.of(images[0]).coarse is kept()
    assert freed() is None


def test_fine_local_descriptors_are_kept_for_the_last_few_images_only(vocabulary):
    local = LocalDescriptorCache()
    images = describe([texture(k)[:64, :64] for k in range(9)], vocabulary, 1)
    first = local.with_fine(images[0])
    assert first.fine.shape[:2] == (160, 160)
    assert local.with_fine(images[0]) is first
    for image in images[1:]:
        local.with_fine(image)
    assert local.with_fine(images[8]) is local.with_fine(images[8])
    assert local.with_fine(images[0]) is not first


def test_matching_cells_count_little_if_the_keypoints_disagree(vocabulary):
    images = describe([texture(0), texture(1)], vocabulary, 1)
    local = LocalDescriptorCache()
    seen_again = confirmed_cells(images[0], images[0], local)
    assert seen_again > 2 * MIN_CONFIRMED
    told = LocalDescriptorCache()
    told.of = lambda image: local.of(images[0])  # all cells of all images match
    assert confirmed_cells(images[0], images[1], told) < seen_again / 5


def test_report_says_who_wins_in_all_three_files(vocabulary, tmp_path):
    images = [texture(k) for k in range(4)]
    relation = (2 * np.eye(4) - 1).astype(np.int8)
    test_set = TestSet("walls", lambda condition, seed: QuerySet(images, images, relation))
    scorers = [BowScorer(vocabulary), Told("liar", relation, -1.0)]
    cells, gains = measure(test_set, Condition("none"), DetectorSet(scorers, vocabulary, 1), 0)
    found = LoopsJson(
        seed=0, cells=cells, gains=gains, costs=[], machine="a <b> machine", versions={},
        created=datetime(2026, 1, 1, tzinfo=UTC),
    )  # fmt: skip
    reporting.write_report(found, tmp_path)
    read = LoopsJson.model_validate_json((tmp_path / "loops.json").read_text())
    assert read == found
    text, page = (tmp_path / "loops.md").read_text(), (tmp_path / "loops.html").read_text()
    for shown in (text, page):
        assert "none: AP of liar minus that of bow is -0." in shown
        assert "worse on walls" in shown
        assert "1.000" in shown
    assert "Average precision over the top K candidates" in shown
    assert page.count("<svg") == 2  # over all pairs, and over the top candidates
    assert "&lt;b&gt; machine" in page
    assert not re.search(r"(src|href)=\"http", page)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--detectors", "none"], "--detectors none: finds no loops"),
        (["--detectors", "magic"], "--detectors magic: unknown"),
        (["--detectors", ""], "unknown"),
        (["--detectors", "bow", "--weights", "capsule=x"], "must be NAME=FILE"),
        (["--detectors", "bow", "--perturb", "fog"], "--perturb fog"),
        (["--detectors", "bow", "--data", "kitti:/nowhere"], "/nowhere"),
        (["--detectors", "bow", "--out", f"{__file__}/x"], "give another folder with --out"),
        (
            ["--protocol", "online", "--perturb", "light"],
            "--perturb, --strengths, --seed: only for",
        ),
        (["--protocol", "online", "--seed", "1"], "--perturb, --strengths, --seed: only for"),
        (["--protocol", "online", "--window", "x"], "--window x: must be a positive"),
        (["--protocol", "online", "--detectors", "magic"], "--detectors magic: unknown"),
        (["--protocol", "online", "--data", "town:demo"], "--protocol online needs drives"),
        (["--window", "30s"], "--window: only for --protocol online"),
        (["--detectors", "bow", "--weights", "bow=x"], "x: no such file; give a vocabulary"),
    ],
)
def test_command_refuses_in_one_sentence(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(every_command(), ["loops", "bench", *arguments])
    assert isinstance(result.exception, InputError)
    assert said in str(result.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_on_a_rendered_town(tmp_path, monkeypatch):
    monkeypatch.setenv("VSLAM_CACHE", str(tmp_path / "cache"))
    arguments = ["--detectors", "bow,capsule", "--perturb", "viewpoint", "--strengths", "1"]
    arguments += ["--quiet"]
    arguments += ["--data", "town:demo[seed=7,places=4]", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(
        every_command(), ["loops", "bench", *arguments], catch_exceptions=False
    )
    assert result.exit_code == 0
    found = json.loads((tmp_path / "out" / "loops.json").read_text())
    cells = {(cell["condition"], cell["detector"]): cell for cell in found["cells"]}
    assert list(cells) == [(c, d) for c in ("none", "viewpoint:1") for d in ("bow", "capsule")]
    assert cells["none", "bow"]["figures"]["average_precision"] == 1.0
    assert cells["none", "capsule"]["first_right"] > 0.5
    assert [cost["detector"] for cost in found["costs"]] == ["bow", "capsule"]
    assert [gain["second"] for gain in found["gains"]] == ["capsule", "capsule"]
    rendered = next((tmp_path / "cache").rglob("*view1*/pairs.csv"))
    rows = list(csv.DictReader(rendered.open()))
    assert {float(row["lateral_m"]) for row in rows} == {-3.2}
    assert {abs(float(row["heading_deg"])) for row in rows} == {30.0}
    assert store.clean(store.cache_folder()) > 0
    assert not rendered.exists()


@pytest.mark.slow
def test_cost_is_measured_in_a_process_of_its_own():
    found = cost("bow", None)
    assert set(found.query_ms) == {"1000", "5000"}
    assert min(found.query_ms.values()) > 0
    assert 50 < found.memory_mb < 2000
