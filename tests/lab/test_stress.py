from __future__ import annotations

import csv
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.config import Config
from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.kitti import open_kitti
from vslam.datasets.perturbation import LAWS, parse_perturbation, sheet_of_laws
from vslam.report.schema import Machine, ReportJson
from vslam.run.options import RunOptions
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam_lab.bench.execute import Failed, Finished
from vslam_lab.bench.grid import Cell, make_grid
from vslam_lab.stress.criterion import Criterion, absolute_verdict
from vslam_lab.stress.external import check_template, export_kitti, run_external
from vslam_lab.stress.figures import draw_curves
from vslam_lab.stress.kitti_c import CORRUPTIONS
from vslam_lab.stress.orbslam3 import _moved_with_keyframes
from vslam_lab.stress.plan import Plan, parse_laws
from vslam_lab.stress.report import boundary_sections, render_csv, title, write_report
from vslam_lab.stress.report import cell as cell_text
from vslam_lab.stress.run import Results, run_all
from vslam_lab.stress.search import boundary, next_position, strength_at
from vslam_lab.stress.summary import corruption_entries, mean_error, summarise

CONFIG = Config().model_dump_json(indent=2) + "\n"


def report_of(cell: Cell, **figures: object) -> ReportJson:
    values: dict = {
        "lost_frames": 0, "weak_frames": 0, "skipped_frames": 0, "skipped_messages": [],
        "frames": 100, "interrupted": None, "alignment": "se3", "ate_rmse_m": 0.1,
        "causal_ate_rmse_m": 0.2, "rpe_m": 0.01, "rpe_deg": 0.01, "t_rel_percent": None,
        "r_rel_deg_per_100m": None, "evo_command": None, "fps": 20.0, "cpu_ms_per_frame": 40.0,
        "startup_s": 1.0, "peak_memory_mb": 300.0, "stage_ms": {}, "keyframes": 10,
        "landmarks": 1000, "submaps": 1, "loops_closed": 1, "loops_rejected": 0, "loops_found": 1,
        "loops_missed": 0, "loops_wrong": 0, "revisit_stretches": 1, "revisits": [], "loops": [],
        "dataset": cell.dataset, "sequence": cell.sequence,
        "perturb": cell.perturb, "detector": cell.detector, "sensor": "stereo", "seed": cell.seed,
        "threads": 1, "start": 0, "every": 1, "max_frames": cell.max_frames,
        "machine": Machine(cpu="x", cores=2, python="3", platform="x"), "versions": {},
        "created": "2026-11-23T12:00:00Z",
    }  # fmt: skip
    return ReportJson.model_validate(values | figures)


def searched(fails, steps: int = 5) -> tuple[list[float], dict[float, str]]:
    verdicts: dict[float, str] = {}
    order = []
    while (position := next_position({p: bool(v) for p, v in verdicts.items()}, steps)) is not None:
        verdicts[position] = "failed" if fails(position) else ""
        order.append(position)
        assert len(order) < 20
    return order, verdicts


def test_bisection_tests_the_strongest_first_and_closes_in():
    order, verdicts = searched(lambda p: p > 0.3)
    assert order == [1.0, 0.5, 0.25, 0.375, 0.3125, 0.28125, 0.140625]
    found = boundary(verdicts, LAWS["night"], 5)
    assert (found.holds_to, found.fails_at) == (2.81, 3.12)
    assert found.reason == "failed"
    assert found.also_failed == ()


def test_what_holds_at_its_strongest_has_no_boundary():
    order, verdicts = searched(lambda p: False)
    assert order == [1.0, 0.5]
    found = boundary(verdicts, LAWS["night"], 5)
    assert (found.holds_to, found.fails_at, found.reason) == (10.0, None, "")


def test_what_never_holds_fails_at_the_weakest_tested():
    order, verdicts = searched(lambda p: True, steps=3)
    assert order == [1.0, 0.5, 0.25, 0.125]
    found = boundary(verdicts, LAWS["night"], 3)
    assert (found.holds_to, found.fails_at) == (None, 1.25)


def test_a_weaker_strength_that_failed_is_told():
    order, verdicts = searched(lambda p: p > 0.8 or p == 0.390625)
    assert order[-1] == 0.390625
    assert boundary(verdicts, LAWS["night"], 5).also_failed == (3.91,)


def test_strengths_go_from_weak_to_strong_by_ratio_or_difference():
    assert [strength_at(LAWS["fog"], p) for p in (0.0, 0.5, 1.0)] == [2000.0, 63.2, 2.0]
    assert [strength_at(LAWS["dirt"], p) for p in (0.0, 0.5, 1.0)] == [0.0, 47.5, 95.0]
    for name, kind in LAWS.items():
        for position in np.linspace(0.0, 1.0, 33):
            strength = strength_at(kind, position)
            assert kind.least <= strength <= kind.most, name
            spec = f"{name}:{strength:g}"
            assert parse_perturbation(spec, 0).name == spec


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ({}, ""),
        ({"lost_frames": 5}, ""),
        ({"lost_frames": 6}, "6 % lost"),
        ({"lost_frames": 5, "dropped_frames": 10}, "6 % lost"),
        ({"dropped_frames": 50}, ""),
        ({"ate_rmse_m": 0.3}, ""),
        ({"ate_rmse_m": 0.31}, "ATE 0.31 m"),
        ({"ate_rmse_m": None}, "ATE unknown"),
        ({"loops_found": 0}, "revisit missed"),
        ({"loops_wrong": 1}, "wrong loop"),
    ],
)
def test_criterion(figures, verdict):
    clean = report_of(Cell("kitti", "00", "none", "bow", 0))
    found = report_of(Cell("kitti", "00", "fog:20", "bow", 0), **figures)
    assert Criterion().verdict(found, clean) == verdict


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ({"longest_loss_s": 10.0, "ate_rmse_m": 1.0}, ""),
        ({"longest_loss_s": 10.6, "ate_rmse_m": 20.0}, "lost for 11 s"),
        ({"longest_loss_s": None, "ate_rmse_m": None}, ""),
        ({"ate_rmse_m": 1.1}, "ATE above 1 m"),
        ({"ate_rmse_m": 10.1}, "ATE above 10 m"),
    ],
)
def test_absolute_verdict(figures, verdict):
    found = report_of(Cell("kitti", "00", "fog:20", "bow", 0), **figures)
    assert absolute_verdict(found) == verdict


def test_three_times_nothing_is_nothing():
    clean = report_of(Cell("kitti", "00", "none", "bow", 0), ate_rmse_m=0.02)
    assert Criterion().ate_limit(clean) == 0.25
    assert Criterion().ate_limit(clean.model_copy(update={"ate_rmse_m": None})) is None
    assert "5 %" in Criterion().words
    assert "0.25 m" in Criterion().words


PLAN = Plan(
    make_grid("kitti", ["00"], ["none"], ["bow", "other"], 1), ("blur", "night"), 3, 4, "bow",
    Criterion(), repeated=("other",),
)  # fmt: skip


def strength_of(cell: Cell) -> float:
    return 0.0 if cell.perturb == "none" else float(cell.perturb.partition(":")[2])


class World:
    """A world in which a cell needs no time.

    bow fails beyond strength 3. The other system fails beyond 1 + seed, and ends with an error
    beyond 9.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.ran = out, []

    def run(self, cells):
        for cell in cells:
            self.ran.append(cell)
            strength = strength_of(cell)
            if cell.detector == "other" and strength > 9:
                yield Failed(cell, "it broke")
                continue
            limit = 3.0 if cell.detector == "bow" else 1.0 + cell.seed
            folder = self.out / cell.name
            folder.mkdir()
            (folder / "config.json").write_text(CONFIG)
            report = report_of(cell, lost_frames=50 if strength > limit else 0)
            (folder / "report.json").write_text(report.model_dump_json())
            yield Finished(cell, str(folder), {})


def conducted(out: Path, plan: Plan = PLAN):
    world, results, searches = World(out), Results(out, CONFIG), plan.searches()
    run_all(plan.clean, searches, plan.preset_cells(), results, plan.criterion, world.run)
    return world, summarise(plan, searches, results, [])


def test_searches_find_the_boundaries_of_every_system_and_seed(tmp_path):
    world, report = conducted(tmp_path)
    assert [cell.perturb for cell in world.ran[:2]] == ["none", "none"]
    # If neither the perturbation nor the system is random, there is only one search.
    counts = {
        (law, system): sum((e.law, e.system) == (law, system) for e in report.boundaries)
        for law in PLAN.laws
        for system in ("bow", "other")
    }
    assert counts == {
        ("blur", "bow"): 1, ("blur", "other"): 3, ("night", "bow"): 3, ("night", "other"): 3,
    }  # fmt: skip
    for entry in report.boundaries:
        limit = 3.0 if entry.system == "bow" else 1.0 + entry.seed
        assert entry.holds_to <= limit < entry.fails_at
        assert entry.reason == "50 % lost"
        assert not entry.also_failed
        assert all(bool(t.verdict) == (t.strength > limit) for t in entry.tested)
    strongest = [e.tested[-1] for e in report.boundaries if e.system == "other"]
    assert {test.verdict for test in strongest} == {"it broke"}


def test_a_stress_test_goes_on_where_it_was_stopped_with_equal_bytes(tmp_path):
    first, report = conducted(tmp_path)
    again, same = conducted(tmp_path)
    assert {cell.detector for cell in again.ran} == {"other"}  # failed runs are tried again
    assert len(again.ran) < len(first.ran) / 2
    assert same.model_dump_json() == report.model_dump_json()


def test_a_system_that_fails_on_clean_images_is_left_out_with_a_note(tmp_path):
    world, results, searches = World(tmp_path), Results(tmp_path, CONFIG), PLAN.searches()

    def run(cells):
        for cell in cells:
            if cell.detector == "other":
                yield Failed(cell, "no licence")
            else:
                yield from world.run([cell])

    run_all(PLAN.clean, searches, [], results, PLAN.criterion, run)
    report = summarise(PLAN, searches, results, [])
    assert {entry.system for entry in report.boundaries} == {"bow"}
    assert any("other" in note and "no licence" in note for note in report.notes)


@pytest.mark.slow
def test_the_report_says_it_in_every_form(tmp_path):
    _, report = conducted(tmp_path)
    write_report(tmp_path, report, {})
    assert json.loads((tmp_path / "stress.json").read_text())["kind"] == "stress"
    rows = list(csv.DictReader((tmp_path / "boundaries.csv").open()))
    assert len(rows) == len(report.boundaries) == 10
    assert rows[0]["law"] == "blur"
    assert float(rows[0]["holds_to"]) <= 3.0 < float(rows[0]["fails_at"])
    html = (tmp_path / "report.html").read_text()
    for text in ((tmp_path / "report.md").read_text(), html):
        assert "night" in text
        assert "50 % lost" in text
        assert Criterion().words in text
        assert "an ATE of at most 10 m" in text
    assert html.count("<svg") == 2
    assert 'src="http' not in html
    assert [figure.name for figure in draw_curves(report)] == ["00-blur", "00-night"]
    assert render_csv(report) == (tmp_path / "boundaries.csv").read_text()
    (boundaries,) = boundary_sections(report)
    assert ("night", "stops", "10") in [row[:3] for row in boundaries.parts[0].rows]


def test_the_title_is_a_sentence(tmp_path):
    _, report = conducted(tmp_path)
    assert title(report) == "Where do bow, other break? kitti 00"
    alone = report.model_copy(update={"clean": report.clean[:1]})
    assert title(alone) == "Where does bow break? kitti 00"


def test_a_sheet_of_laws_has_no_empty_half_for_one(tmp_path):
    sequence = open_kitti(make_kitti(tmp_path), "00")
    one, two, three = (
        sheet_of_laws(sequence, ["blur:1", "night:3", "yaw:5"][:n], 0, 0) for n in (1, 2, 3)
    )
    height, width = one.shape
    assert two.shape == (height, 2 * width)
    assert three.shape == (2 * height, 2 * width)
    np.testing.assert_array_equal(one, two[:, :width])


def test_a_cell_of_the_table_tells_median_and_spread(tmp_path):
    _, report = conducted(tmp_path)
    mine = [e for e in report.boundaries if (e.law, e.system) == ("night", "other")]
    least, middle, greatest = sorted(entry.fails_at for entry in mine)
    assert cell_text(mine) == f"{middle:g} ({least:g}-{greatest:g}), 50 % lost"
    held = [e.model_copy(update={"fails_at": None, "reason": ""}) for e in mine]
    assert cell_text(held) == ">10"


def test_preset_compares_with_a_baseline(tmp_path):
    clean = make_grid("kitti", ["00"], ["none"], ["bow", "worse"], 1)
    plan = Plan(clean, (), 1, 4, "bow", Criterion(), preset="kitti-c")
    cells = plan.preset_cells()

    def reports(cell):
        return report_of(cell, ate_rmse_m=0.2 if cell.detector == "bow" else 0.5)

    entries = corruption_entries(cells, reports, "bow")
    assert len(entries) == len(CORRUPTIONS) == 18
    with_law = [entry for entry in entries if entry.specs]
    assert len(with_law) == 13
    for entry in with_law:
        assert entry.error_percent == pytest.approx({"bow": 100.0, "worse": 250.0})
        assert entry.ate_sum_m["bow"] == pytest.approx(1.0)
    assert mean_error(entries, "worse") == pytest.approx(250.0)
    assert all(entry.note == "no law" for entry in entries if not entry.specs)
    write_report(tmp_path, summarise(plan, [], reports, []), {})
    text = (tmp_path / "report.md").read_text()
    assert "Corruption error against bow, preset kitti-c" in text
    assert "| mean " in text
    assert "250 %" in text
    assert not (tmp_path / "boundaries.csv").exists()


def test_a_seed_that_ends_with_an_error_counts_against_its_system():
    clean = make_grid("kitti", ["00"], ["none"], ["bow"], 1)
    cells = Plan(clean, (), 2, 4, "bow", Criterion(), preset="kitti-c").preset_cells()
    seeds = {cell.seed for cell in cells}
    assert len(seeds) == 2

    def reports(cell):
        return report_of(cell, ate_rmse_m=0.2) if cell.seed == min(seeds) else "killed"

    with_law = [entry for entry in corruption_entries(cells, reports, "bow") if entry.specs]
    drawn = [one for one in with_law if one.ate_sum_m["bow"] is None]
    assert drawn  # random perturbations are run with both seeds
    assert all(one.ate_sum_m["bow"] == pytest.approx(1.0) for one in with_law if one not in drawn)


def test_laws_are_named_without_strengths():
    assert parse_laws("fog, rain,fog") == ["fog", "rain"]
    assert parse_laws("all") == list(LAWS)
    with pytest.raises(InputError, match="unknown law 'fog:3'"):
        parse_laws("fog:3")
    with pytest.raises(InputError, match="no law"):
        parse_laws(" ,")


# Another system: a script whose camera moves straight ahead, or that does what the test needs.

CAMERA = Camera(100.0, 100.0, 32.0, 24.0, 0.5, 64, 48)


def make_kitti(root: Path, frames: int = 12) -> Path:
    import cv2

    folder = root / "sequences" / "00"
    (root / "poses").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for side in (0, 1):
        (folder / f"image_{side}").mkdir(parents=True)
        for k in range(frames):
            image = rng.integers(0, 256, (48, 64), dtype=np.uint8)
            cv2.imwrite(str(folder / f"image_{side}" / f"{k:06d}.png"), image)
    rows = [f"P{k}: 100 0 32 {-50.0 * (k % 2)} 0 100 24 0 0 0 1 0" for k in range(4)]
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(frames)))
    poses = [f"1 0 0 {0.1 * (k % 3)} 0 1 0 0 0 0 1 {k}\n" for k in range(frames)]
    (root / "poses" / "00.txt").write_text("".join(poses))
    return root


def settings(detector: str = "ruler") -> RunOptions:
    return RunOptions(detector=detector)


RULER = """
import sys
from pathlib import Path
folder, out = Path(sys.argv[1]), Path(sys.argv[2])
times = (folder / "times.txt").read_text().split()
n = len(list((folder / "image_1").iterdir()))
assert n == len(times) and (folder / "calib.txt").read_text().startswith("P0: 1")
"""
DRIVES = """
k = [round(10 * float(t)) for t in times]
rows = [f"1 0 0 {0.1 * (i % 3)} 0 1 0 0 0 0 1 {i}" for i in k]
(out / "trajectory.txt").write_text("\\n".join(rows))
"""


def run_script(root: Path, script: str, perturb: str = "none") -> ReportJson:
    sequence = open_kitti(root, "00")
    file = Path(tempfile.mkdtemp(dir=root)) / "ruler.py"
    file.write_text(RULER + script)
    template = f"{sys.executable} {file} {{folder}} {{out}}"
    law = parse_perturbation(perturb, 0)
    return run_external(sequence, law, settings(), template, file.parent)


def test_another_system_is_judged_by_its_trajectory(tmp_path):
    root = make_kitti(tmp_path)
    report = run_script(root, DRIVES)
    assert (report.frames, report.lost_frames, report.detector) == (12, 0, "ruler")
    assert report.ate_rmse_m == pytest.approx(0.0, abs=1e-6)
    assert report.causal_ate_rmse_m == pytest.approx(0.0, abs=1e-6)
    assert report.loops_missed is None


def test_another_system_gets_no_dropped_frames_and_is_not_blamed_for_them(tmp_path):
    report = run_script(make_kitti(tmp_path), DRIVES, "drop:40")
    assert 1 <= report.dropped_frames <= 8
    assert (report.frames, report.lost_frames) == (12, 0)


def test_another_system_skips_an_unreadable_image_like_vslam(tmp_path):
    root = make_kitti(tmp_path)
    damaged = root / "sequences" / "00" / "image_1" / "000004.png"
    damaged.write_bytes(damaged.read_bytes()[:200])
    report = run_script(root, DRIVES)
    assert (report.frames, report.lost_frames, report.dropped_frames) == (12, 1, 0)
    (message,) = report.skipped_messages
    assert message.startswith(f"frame 4: {damaged}: ")
    assert 0.0 < report.ate_rmse_m < 0.1


def test_frames_without_a_pose_are_lost(tmp_path):
    tum = """
rows = [f"{t} {0.1 * (i % 3)} 0 {i} 0 0 0 1" for i, t in enumerate(times) if i not in (4, 5)]
(out / "trajectory.txt").write_text("\\n".join(rows))
"""
    states = """
(out / "states.txt").write_text(" ".join(["OK"] * 8 + ["LOST"] * 4))
"""
    root = make_kitti(tmp_path)
    report = run_script(root, tum)
    assert report.lost_frames == 2
    assert 0.0 < report.ate_rmse_m < 0.1  # unknown poses are interpolated
    assert run_script(root, tum + states).lost_frames == 6


def test_states_and_causal_poses_of_another_system_count(tmp_path):
    more = (
        DRIVES
        + """
(out / "states.txt").write_text(" ".join(["LOST"] * 3 + ["OK"] * 9))
rows = [f"1 0 0 {0.1 * (i % 3) + (i > 6)} 0 1 0 0 0 0 1 {i}" for i in k]
(out / "causal.txt").write_text("\\n".join(rows))
"""
    )
    report = run_script(make_kitti(tmp_path), more)
    assert report.lost_frames == 3
    assert report.ate_rmse_m < 1e-6 < 0.1 < report.causal_ate_rmse_m


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("sys.exit('no vocabulary')", "exit code 1: no vocabulary"),
        ("import os; os.kill(os.getpid(), 11)", r"crashed \(SIGSEGV\)"),
        ("sys.stdout.buffer.write(b'\\xff'); sys.stdout.flush(); sys.exit(3)", "exit code 3"),
        ("", "no trajectory.txt"),
        (DRIVES + "(out / 'states.txt').write_text('OK')", "1 states for 12 frames"),
        ("(out / 'trajectory.txt').write_text('a b')", "trajectory.txt"),
    ],
)
def test_another_system_that_breaks_is_told(tmp_path, script, said):
    with pytest.raises(InputError, match=said):
        run_script(make_kitti(tmp_path), script)


def test_the_exported_folder_is_read_again(tmp_path):
    root = make_kitti(tmp_path / "data")
    sequence = open_kitti(root, "00")
    target = tmp_path / "again" / "sequences" / "00"
    kept, _ = export_kitti(sequence, parse_perturbation("stereo_gain:1", 0), target)
    again = open_kitti(tmp_path / "again", "00")
    assert kept.tolist() == list(range(12))
    assert again.camera == sequence.camera
    np.testing.assert_allclose(again.timestamps, sequence.timestamps)
    left, right = again.read(3)
    np.testing.assert_array_equal(left, sequence.read(3)[0])
    np.testing.assert_array_equal(right, np.rint(sequence.read(3)[1] / 2.0))


def test_a_single_camera_is_exported_without_right_images(tmp_path):
    sequence = open_kitti(make_kitti(tmp_path / "data"), "00", monocular=True)
    export_kitti(sequence, parse_perturbation("none", 0), tmp_path / "out")
    assert len(list((tmp_path / "out" / "image_0").iterdir())) == 12
    assert not (tmp_path / "out" / "image_1").exists()


def test_depth_is_exported_in_millimetres(tmp_path):
    import cv2

    depth = np.full((48, 64), 1.2344, np.float32)
    depth[0, :4] = 0.0, 65.6, np.inf, np.nan
    frames = [TimedFrame(0.5, lambda _map: (np.zeros((48, 64), np.uint8), depth))]
    camera = Camera(100.0, 100.0, 32.0, 24.0, baseline=0.08, width=64, height=48, depth=True)
    sequence = Source(dataset="tum", name="d", camera=camera, stored=tuple(frames))
    export_kitti(sequence, parse_perturbation("none", 0), tmp_path)
    written = cv2.imread(str(tmp_path / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert written.dtype == np.uint16
    assert written[0, :5].tolist() == [0, 0, 0, 0, 1234]
    assert not (tmp_path / "image_1").exists()


def test_the_costs_of_another_system_are_those_it_writes(tmp_path):
    root = make_kitti(tmp_path)
    costs = '(out / "costs.json").write_text(\'{"wall_s": 2.0, "cpu_s": 3.0}\')\n'
    report = run_script(root, DRIVES + costs)
    assert (report.fps, report.cpu_ms_per_frame) == (6.0, 250.0)
    with pytest.raises(InputError, match="is malformed"):
        run_script(root, DRIVES + '(out / "costs.json").write_text("[1]")\n')


def test_frames_move_with_the_corrected_keyframe_before_them(tmp_path):
    def pose(x: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.1, -2.0, 0.3]).as_matrix()
        T[0, 3] = x
        return T

    def corrected(x: float) -> np.ndarray:  # turned by 0.5 rad and twice as large
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()
        return T @ pose(2.0 * x)

    causal = [(0.1 * k, pose(float(k))) for k in range(6)]
    file = tmp_path / "keyframes.tum"
    rows = []
    for k in (1, 3):
        T = corrected(k)
        rows.append([0.1 * k, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])
    np.savetxt(file, rows, fmt="%.9f")
    moved = _moved_with_keyframes(file, causal)
    assert [t for t, _ in moved] == [t for t, _ in causal[1:]]  # no keyframe before the first frame
    for (_, T), k in zip(moved, range(1, 6), strict=True):
        np.testing.assert_allclose(T, corrected(k), atol=1e-7)


@pytest.mark.parametrize(
    "template",
    ["slam {folder}", "slam {out}", "slam {folder} {oot}", "{", "slam {folder.x} {out}",
     "slam '{folder} {out}"],
)  # fmt: skip
def test_a_template_must_hold_both_places(template):
    with pytest.raises(InputError, match="--system slam"):
        check_template("slam", template)


@pytest.mark.slow
def test_from_the_command_line_with_another_system(tmp_path):
    """The run on unperturbed images is perfect. In dark images, the trajectory is wrong."""
    root = make_kitti(tmp_path / "data")
    script = tmp_path / "ruler.py"
    measured = """
import cv2
import numpy as np
folder0 = folder / "image_0"
mean = np.mean([cv2.imread(str(p), 0).mean() for p in folder0.iterdir()])
k = [round(10 * float(t)) for t in times]
far = 5.0 * max(0.0, 100.0 - mean)
rows = [f"1 0 0 {0.1 * (i % 3) + far * (i % 2)} 0 1 0 0 0 0 1 {i}" for i in k]
(out / "trajectory.txt").write_text("\\n".join(rows))
"""
    script.write_text(RULER + measured)
    words = [
        "stress", "--data", str(root), "--seqs", "00", "--systems", "ruler",
        "--system", f"ruler={sys.executable} {script} {{folder}} {{out}}", "--laws", "night",
        "--steps", "2", "--seeds", "1", "--out", str(tmp_path / "out"), "--quiet",
    ]  # fmt: skip
    done = CliRunner().invoke(every_command(), words)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "stress.json").read_text())
    (entry,) = report["boundaries"]
    assert entry["holds_to"] is None  # 2.5 stops darker, which is a mean of 23 instead of 128
    assert entry["fails_at"] == 2.5
    assert entry["reason"].startswith("ATE")
    first = (tmp_path / "out" / "stress.json").read_bytes()
    assert CliRunner().invoke(every_command(), words).exit_code == 0
    assert (tmp_path / "out" / "stress.json").read_bytes() == first


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--laws snow", "unknown law 'snow'"),
        ("--systems orbslam3", "--vocabulary"),
        ("--systems dso", "--systems dso: unknown"),
        ("--system x", "write NAME=COMMAND"),
        ("--system both={folder}{out}", "--system both: a detector of this test has the same name"),
        ("--preset kitti-c --baseline capsule", "--baseline capsule: is not tested"),
    ],
)
def test_stress_refuses_before_it_starts(tmp_path, words, said):
    root = make_kitti(tmp_path / "data")
    arguments = ["stress", "--data", str(root), "--out", str(tmp_path / "out"), *words.split()]
    done = CliRunner().invoke(every_command(), arguments)
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_boundaries_of_two_systems_are_compared_by_their_medians(tmp_path, monkeypatch):
    tools = Path(__file__).parents[2] / "tools" / "experiments" / "stress"
    monkeypatch.syspath_prepend(str(tools))
    import compare_boundaries

    # The visibility in fog is smaller if the fog is denser. An empty strength is the weakest one.
    held = {
        ("gamma", "bow"): ["10", "1.78", "5.62"], ("gamma", "orbslam3"): ["7.5", "4.22", "4.22"],
        ("fog", "bow"): ["63.2"], ("fog", "orbslam3"): ["17.3"],
        ("black_left", "bow"): ["12.5"], ("black_left", "orbslam3"): [""],
        ("blur", "bow"): ["3.16"], ("blur", "orbslam3"): ["3.16"],
        ("noise", "bow"): ["3.13"],
    }  # fmt: skip
    rows = [
        f"00,{law},{system},{seed},{strength}\n"
        for (law, system), strengths in held.items()
        for seed, strength in enumerate(strengths)
    ]
    (tmp_path / "in.csv").write_text("sequence,law,system,seed,holds_to\n" + "".join(rows))
    medians = compare_boundaries.read_medians([tmp_path / "in.csv"])
    (row,) = compare_boundaries.compare(medians, "bow", "orbslam3")
    assert row["laws_first_more"] == "gamma black_left"
    assert row["laws_second_more"] == "fog"
    assert row["laws_equal"] == "blur"
    assert row["laws_one_step"] == "gamma"
    assert (row["first_more"], row["second_more"], row["equal"]) == (2, 1, 1)
    assert compare_boundaries.compare(medians, "both", "orbslam3") == []
