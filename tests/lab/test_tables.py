"""The tables that tools/tables.py writes from the results of benchmarks."""

from __future__ import annotations

import csv
import importlib
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from vslam_lab.loopbench.curves import draw_curves
from vslam_lab.loopbench.schema import (
    Cost,
    Curve,
    DecisionCurve,
    Gain,
    LoopsJson,
    OnlineScore,
    Score,
    Verified,
)
from vslam_lab.overview.schema import MEASURES, Drive, OverviewJson, RunEntry

ROOT = Path(__file__).parents[2]


def score(data: str, detector: str, ap: float, sequence: float | None) -> Score:
    figures = {"average_precision": ap, "recall_at_100_precision": 0.25, "max_f1": 0.5}
    figures["precision_at_70_recall"] = 0.75
    verified = {by: Verified(right=0.625, wrong=3) for by in ("orb", "learned", "both")}
    return Score(
        data=data, condition="none", detector=detector, figures=figures, queries=8,
        accuracy={"0.5": None if detector == "bow" else 0.875, "0.9": None}, first_right=0.8125,
        accepted=None if detector == "bow" else (0.9, 0.1), sequence_right=sequence,
        verified=verified, curve=Curve(precision=[0.5, 1.0], recall=[1.0, 0.0]),
        top_average_precision=(0.9, 0.8, 0.4),
        top_curve=Curve(precision=[0.5, 1.0], recall=[0.9, 0.0]),
    )  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tables of two detectors, on a town and on KITTI. Only KITTI has an order."""
    online = OnlineScore(
        data="kitti00", detector="bow", window="20 s", verified_by="orb", images=10, answerable=4,
        right=3, near=1, far=0, recall_at_100_precision=0.5, recall_at_100_precision_far=0.75,
        max_f1=0.8, max_f1_far=0.9, max_f1_threshold=None,
        curve=DecisionCurve(threshold=[0.0], precision=[1.0], recall=[0.5]),
    )  # fmt: skip
    gain = Gain(data="town", condition="none", first="bow", second="capsule",
                difference=0.1, low=0.05, high=0.15)  # fmt: skip
    cost = Cost(detector="bow", load_s=0.19, image_ms=0.4, query_ms={"1000": 0.125},
                parameters=100_000, memory_mb=467.4)  # fmt: skip
    report = LoopsJson(
        seed=0, gains=[gain], costs=[cost], machine="", versions={}, online=(online,),
        cells=[score("town", "bow", 0.75, None), score("town", "capsule", 0.85, None),
               score("kitti00", "bow", 0.25, 0.875), score("kitti00", "capsule", 0.35, 1.0)],
        created=datetime(2026, 1, 1, tzinfo=UTC),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("loops")
    (folder / "loops.json").write_text(report.to_json())
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        patch.setattr(
            sys, "argv", ["x", "loops", str(folder / "loops.json"), "--out", str(folder / "tables")]
        )
        importlib.import_module("tables").main()
    return folder / "tables"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("table", "row"),
    [
        ("average_precision", "town none 0.750 0.850 +0.100 +0.050 +0.150 yes"),
        ("average_precision", "kitti00 none 0.250 0.350    "),
        ("average_precision", "mean of all none 0.500 0.600    "),
        ("places_found", "kitti00 none 0.812 0.625 3 0.812 0.625 3"),
        ("scores", "town none capsule 0.850 0.250 0.750 0.900 0.100 0.812 0.625 3"),
        ("top_k", "town none capsule 0.850 0.900 0.400 0.700 0.812"),
        ("online", "kitti00 bow 20 s orb 10 4 3 1 0 0.500 0.750 0.800 0.900"),
        ("cost", "bow 0.19 0.4 0.12 0.10 467"),
    ],
)
def test_a_table_holds_the_figures_of_the_report(written, table, row):
    assert row in [" ".join(one.values()) for one in rows(written / f"{table}.csv")]


@pytest.mark.parametrize("name", ["average_precision", "places_found"])
def test_columns_have_the_names_that_pages_use(written, name):
    """The tables in the documentation have more detectors, which are no longer part of vslam."""
    kept = rows(ROOT / "docs" / "research" / "loops" / f"{name}.csv")
    here = rows(written / f"{name}.csv")
    assert {"condition", *kept[0]} >= here[0].keys() - {"images"}


def test_a_legend_names_each_detector_once():
    cells = [
        score("town", name, 0.5, None).model_copy(update={"condition": condition})
        for condition in ("none", "light:1")
        for name in ("bow", "capsule")
    ]
    report = LoopsJson(
        seed=0, cells=cells, machine="", versions={}, created=datetime(2026, 1, 1, tzinfo=UTC)
    )
    for figure in draw_curves(report):
        assert [figure.svg.count(f">{name}<") for name in ("bow", "capsule")] == [1, 1]


def test_curves_are_drawn_for_each_set(written):
    assert [path.name for path in sorted(written.glob("*.png"))] == [
        "online.png", "precision_recall_0.png", "precision_recall_1.png",
        "precision_recall_top_0.png", "precision_recall_top_1.png",
    ]  # fmt: skip


def test_a_benchmark_becomes_a_table_with_a_row_for_each_run(tmp_path, monkeypatch):
    def entry(town: int, ate: float | None) -> RunEntry:
        measures = dict.fromkeys((name for name, *_ in MEASURES), 2.0) | {"ate_rmse_m": ate}
        drive = Drive(dataset="synthetic", sequence="block", excerpt="", perturb="change:1")
        return RunEntry(drive=drive, system="bow", seed=0, town=town, frames=279,
                        measures=measures, source="", machine=None)  # fmt: skip

    for name, runs in (("a", [entry(501, 0.01936)]), ("b", [entry(502, None)])):
        report = OverviewJson(notes=[], systems=["bow"], rows=[], comparisons=[], runs=runs,
                              versions={}, created=datetime(2026, 1, 1, tzinfo=UTC))  # fmt: skip
        (tmp_path / f"{name}.json").write_text(report.to_json())
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    words = [str(tmp_path / "a.json"), str(tmp_path / "b.json"), "--out", str(tmp_path / "x.csv")]
    monkeypatch.setattr(sys, "argv", ["tables.py", "runs", *words])
    importlib.import_module("tables").main()
    head, first, second = (tmp_path / "x.csv").read_text().splitlines()
    assert head.startswith("dataset,sequence,excerpt,perturb,system,seed,town,alignment,frames,")
    assert first.startswith("synthetic,block,,change:1,bow,0,501,se3,279,2,0.019,2.000,2.0000,")
    assert second.startswith("synthetic,block,,change:1,bow,0,502,se3,279,2,,2.000,")


def test_tables_of_runs_are_compared_pairwise_with_one_pair_for_each_sequence(
    tmp_path, monkeypatch
):
    head = "dataset,sequence,excerpt,perturb,system,seed,alignment,frames,ate_rmse_m,rpe_m\n"
    drives = range(6)
    ours = [f"kitti,{k},,none,both,{s},se3,9,{k}.{s},1.0\n" for k in drives for s in (0, 1, 2, 9)]
    theirs = [
        f"kitti,{k},,none,orbslam3,{s},se3,9,{k}.{s + 3},1.0\n" for k in drives for s in (0, 1, 2)
    ]
    for name, rows in (("ours", ours), ("theirs", theirs)):
        (tmp_path / f"{name}.csv").write_text(head + "".join(rows))
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    words = [str(tmp_path / f"{name}.csv") for name in ("ours", "theirs", "paired")]
    monkeypatch.setattr(sys, "argv", ["tables.py", "pairs", *words[:2], "--out", words[2]])
    importlib.import_module("tables").main()
    assert (tmp_path / "paired.csv").read_text().splitlines() == [
        "first,second,perturb,measure,sequences,second_smaller,first_smaller,equal,"
        "median_difference,p_value",
        "both,orbslam3,none,ate_rmse_m,6,0,6,0,0.3000,0.031",
        "both,orbslam3,none,rpe_m,6,0,0,6,0.0000,",
    ]
