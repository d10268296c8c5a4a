"""Reports of complete and incomplete runs."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vslam.config import Config, load_config
from vslam.evaluation.loops import evaluate_loops
from vslam.evaluation.trajectories import evaluate_trajectory, read_pair
from vslam.method.gaps import Gap, GapKind
from vslam.method.inertia import IMU_REFUSED
from vslam.report.folder import write_results
from vslam.report.run_page import headlines
from vslam.report.schema import DetectorFigures, ReportJson
from vslam.report.summary import evaluate_run, summarize
from vslam.report.trajectory_figures import loop_closing, top_view
from vslam.run.loop_pictures import LoopPicture
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.types.camera import Camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.imu import ImuCalibration
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.odometry import PoseUncertainty
from vslam.types.trajectory import Trajectory, read_trajectory, write_tum

DOWN = np.array([0.0, 9.81, 0.0])
FIGURES = {
    "top_view",
    "loop_closing",
    "error_along_path",
    "error_histogram",
    "tracked_points",
    "stage_times",
    "stage_distribution",
}


CAMERA = Camera(718.9, 718.9, 607.2, 185.2, 0.537, 1241, 376)


@dataclass(frozen=True)
class _Sequence:
    timestamps: NDArray[np.float64]
    ground_truth: NDArray[np.float64] | None
    dataset: str = "kitti"
    camera: Camera = CAMERA
    name: str = "00"
    world: str = ""
    imu: object = None
    imu_refused: str = ""

    def __len__(self) -> int:
        return len(self.timestamps)

    def read(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        raise AssertionError("a report must not read images")


def _drive(frames: int) -> NDArray[np.float64]:
    """Return ``T_wc`` of a car on a bent loop. It moves 1 m per frame and looks ahead."""
    s = np.linspace(0.0, 2.0 * np.pi * frames / 600.0, frames)
    radius = 95.0 + 22.0 * np.sin(3.0 * s)
    x, z = radius * (1.0 - np.cos(s)), radius * np.sin(s)
    heading = np.arctan2(np.gradient(x), np.gradient(z)) if frames > 1 else np.zeros(1)
    T_wc = np.tile(np.eye(4), (frames, 1, 1))
    T_wc[:, 0, 0] = T_wc[:, 2, 2] = np.cos(heading)
    T_wc[:, 0, 2], T_wc[:, 2, 0] = np.sin(heading), -np.sin(heading)
    T_wc[:, 0, 3], T_wc[:, 2, 3] = x, z
    return np.linalg.inv(T_wc[:1]) @ T_wc


def make_outcome(
    frames: int = 160,
    *,
    lost: slice = slice(100, 106),
    ground_truth: bool = True,
    keyframe_every: int = 4,
) -> RunOutcome:
    """Make the outcome of a run with drift.

    The frames around the lost frames have few inliers, and keyframes take longer.
    """
    rng = np.random.default_rng(0)
    timestamps = np.arange(frames) * 0.1
    truth = _drive(frames)
    T_wc = truth.copy()
    T_wc[:, :3, 3] += np.cumsum(rng.normal(0.0, 0.02, (frames, 3)), axis=0)
    states = np.full(frames, TrackingState.OK, dtype=object)
    states[max(lost.start - 4, 0) : lost.stop + 4] = TrackingState.WEAK
    states[lost] = TrackingState.LOST
    tracks = []
    for i, state in enumerate(states):
        n_stereo = int(900 + 250 * np.sin(i / 40.0) + rng.integers(0, 60))
        share = {TrackingState.OK: 0.42, TrackingState.WEAK: 0.03, TrackingState.LOST: 0.008}[state]
        n_inliers = int(share * n_stereo)
        is_keyframe = i % keyframe_every == 0
        stage_ms = {
            "read": rng.gamma(20.0, 0.3),
            "extract": rng.gamma(80.0, 0.2),
            "stereo": rng.gamma(30.0, 0.1),
            "track": rng.gamma(25.0, 0.2),
        }
        if is_keyframe:
            stage_ms |= {"map": rng.gamma(12.0, 1.0), "bundle": rng.gamma(9.0, 2.0)}
        tracks.append(
            TrackResult(
                index=i,
                timestamp=float(timestamps[i]),
                T_wc=T_wc[i],
                state=state,
                n_features=2000,
                n_stereo=n_stereo,
                n_matches=int(1.3 * n_inliers) + 20,
                n_inliers=n_inliers,
                is_keyframe=is_keyframe,
                stage_ms=stage_ms,
            )
        )
    return RunOutcome(
        settings=RunOptions(
            perturb="brightness:1", detector="none", seed=3, threads=2, max_frames=frames
        ),
        sequence=_Sequence(timestamps, truth if ground_truth else None),
        trajectory=Trajectory(timestamps, T_wc),
        keyframes=Trajectory(timestamps[::keyframe_every], T_wc[::keyframe_every]),
        tracks=tracks,
        skipped=[],
        wall_s=frames * 0.04,
        cpu_s=frames * 0.055,
        startup_s=1.9,
        peak_memory_mb=612.0,
        n_keyframes=len(T_wc[::keyframe_every]),
        n_landmarks=60 * frames,
    )


def carried(seconds: float = 0.5) -> RunOutcome:
    """Make a run with an IMU that knew gravity after 1 s and carried two stretches."""
    outcome = make_outcome(lost=slice(0, 0))
    tracks, n = [], round(10 * seconds)
    for track in outcome.tracks:
        know = {}
        if track.index >= 10:
            bias = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
            know = {"gravity": DOWN, "imu_bias": bias, "imu_bias_sigma": 0.1 * bias}
        if 50 <= track.index < 50 + n or 90 <= track.index < 91:
            know["state"] = TrackingState.INERTIAL
        C = PoseUncertainty(np.diag([1e-4] * 3 + [1e-10] * 3), np.zeros((6, 6)), 0)
        T = outcome.sequence.ground_truth[track.index].copy()
        if "state" in know:
            T[:3, 3] += 0.04
        tracks.append(replace(track, T_odom_camera=T, uncertainty=C, **know))
    imu = SimpleNamespace(calibration=ImuCalibration(np.eye(4), time_offset=0.004))
    sequence = replace(outcome.sequence, imu=imu)
    return replace(outcome, tracks=tracks, sequence=sequence, gravity=DOWN)


def two_laps(frames: int = 500, *, keyframe_every: int = 4) -> RunOutcome:
    """Make a run of two laps around a circle of 200 m.

    It has four loops, of which one is wrong, and 300 rejected loops.
    """
    plain = make_outcome(frames, lost=slice(0, 0), keyframe_every=keyframe_every)
    angle = 2.0 * np.pi * np.arange(frames) / 250.0
    truth = np.tile(np.eye(4), (frames, 1, 1))
    truth[:, 0, 0] = truth[:, 2, 2] = np.cos(angle)
    truth[:, 0, 2], truth[:, 2, 0] = np.sin(angle), -np.sin(angle)
    truth[:, 0, 3], truth[:, 2, 3] = 32.0 * (1.0 - np.cos(angle)), 32.0 * np.sin(angle)
    estimate = truth.copy()
    estimate[:, 0, 3] += 0.2 * np.sin(7.0 * angle)
    keyframe_frames = np.arange(0, frames, keyframe_every)

    def edge(query: int, match: int, accepted: bool, reason: str, shift: float = 0.0) -> LoopEdge:
        T_wq, T_wm = (truth[keyframe_frames[k]] for k in (query, match))
        T_query_match = np.linalg.inv(T_wq) @ T_wm
        T_query_match[0, 3] += shift
        return LoopEdge(
            query, match, 0.7, accepted, reason, 120, 84, T_query_match, proposed_by="bow"
        )

    rejected = [
        LoopEdge(70 + k % 20, k % 9, 0.3, False, f"{k % 14} inliers, 20 needed | <b>", 40, k % 14)
        for k in range(299)
    ]
    loops = [
        edge(66, 3, True, "closed"),
        *rejected[:150],
        edge(80, 17, True, "closed", shift=0.5),
        edge(90, 50, True, "closed", shift=30.0),
        *rejected[150:],
        edge(92, 29, False, "not consistent with the group"),
        edge(100, 37, True, "closed"),
    ]
    corrections = []
    for loop in (loop for loop in loops if loop.accepted):
        living = np.setdiff1d(np.arange(loop.query + 1), [50])
        T_wc = truth[keyframe_frames[living]].copy()
        T_cw_after = np.linalg.inv(T_wc)
        # Drift before the correction, and none after it.
        T_wc[:, 0, 3] += 8.0 * living / len(keyframe_frames)
        corrections.append(LoopCorrection(loop, living, np.linalg.inv(T_wc), T_cw_after, 0.12))
    timestamps = np.arange(frames) * 0.1
    return replace(
        plain,
        settings=plain.settings.model_copy(update={"detector": "bow", "perturb": "none"}),
        sequence=_Sequence(timestamps, truth),
        trajectory=Trajectory(timestamps, estimate),
        keyframes=Trajectory(timestamps[keyframe_frames], estimate[keyframe_frames]),
        loops=loops,
        corrections=corrections,
        keyframe_frames=keyframe_frames,
        n_submaps=2,
        step_s=9.25,
        compared=(replace(plain, sequence=_Sequence(timestamps, truth), step_s=8.5),),
    )


def report_of(outcome: RunOutcome, folder: Path) -> ReportJson:
    """Write the report as the command line does, and check that the file equals the result."""
    report = write_results(folder, outcome)
    assert ReportJson.model_validate_json((folder / "report.json").read_bytes()) == report
    return report


def figures_of(folder: Path) -> set[str]:
    return {path.stem for path in (folder / "figures").glob("*.png")}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunOutcome, Path]:
    folder = tmp_path_factory.mktemp("run")
    outcome = replace(make_outcome(), skipped=["000007.png: truncated <file>"])
    report_of(outcome, folder)
    return outcome, folder


@pytest.fixture(scope="module")
def looped(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunOutcome, Path]:
    folder = tmp_path_factory.mktemp("loops")
    outcome = two_laps()
    report_of(outcome, folder)
    return outcome, folder


def test_all_files_are_written(written: tuple[RunOutcome, Path]) -> None:
    _, folder = written
    names = {path.name for path in folder.iterdir()}
    assert names >= {
        "config.json",
        "ground_truth_kitti.txt",
        "keyframes.tum",
        "report.html",
        "report.json",
        "report.md",
        "trajectory_kitti.txt",
    }
    assert figures_of(folder) == FIGURES - {"loop_closing"}
    assert load_config(folder / "config.json") == Config()


def test_json_holds_the_numbers_of_the_run(written: tuple[RunOutcome, Path]) -> None:
    outcome, folder = written
    truth = outcome.ground_truth
    assert truth is not None
    evaluation = evaluate_trajectory(outcome.trajectory, truth)
    report = json.loads((folder / "report.json").read_text())
    for name in (
        "ate_rmse_m",
        "ate_mean_m",
        "ate_max_m",
        "rpe_m",
        "rpe_deg",
        "t_rel_percent",
        "alignment",
    ):
        assert report[name] == getattr(evaluation, name)
    assert (report["lost_frames"], report["weak_frames"], report["frames"]) == (6, 8, 160)
    assert (report["skipped_frames"], report["skipped_messages"]) == (1, outcome.skipped)
    assert report["fps"] == pytest.approx(25.0)
    assert report["cpu_ms_per_frame"] == pytest.approx(55.0)
    assert report["keyframes"] == 40
    assert report["landmarks"] == 9600
    assert report["seed"] == 3
    assert report["schema_version"] == 5
    assert (report["loops"], report["revisits"], report["detectors"]) == ([], [], [])
    assert (report["loops_closed"], report["loops_missed"], report["revisit_stretches"]) == (
        0,
        0,
        0,
    )
    mapping = [track.stage_ms["map"] for track in outcome.tracks if track.is_keyframe]
    assert report["stage_ms"]["map"]["mean"] == pytest.approx(np.mean(mapping))
    assert report["stage_ms"]["map"]["median"] == pytest.approx(np.median(mapping))


@pytest.mark.slow
@pytest.mark.parametrize("fixture", ["written", "looped"])
def test_json_round_trips_through_its_schema(fixture: str, request: pytest.FixtureRequest) -> None:
    written = request.getfixturevalue(fixture)
    text = (written[1] / "report.json").read_text()
    assert ReportJson.model_validate_json(text).model_dump_json(indent=2) + "\n" == text


def test_causal_ate_is_of_the_poses_as_they_were_given(written: tuple[RunOutcome, Path]) -> None:
    outcome, folder = written
    report = json.loads((folder / "report.json").read_text())
    given = read_trajectory(folder / "trajectory_causal.tum")
    assert len(given) == report["frames"]
    np.testing.assert_allclose(given.T_wc, [track.T_wc for track in outcome.tracks], atol=1e-8)
    truth = outcome.ground_truth
    assert truth is not None
    assert report["causal_ate_rmse_m"] == pytest.approx(
        evaluate_trajectory(given, truth).ate_rmse_m, abs=1e-6
    )
    assert "Causal ATE" in (folder / "report.md").read_text()


@pytest.mark.parametrize(
    ("sensor", "scale", "says"),
    [
        ({}, 1.0, None),
        ({}, 1.1, None),
        ({}, 2.0, "2 times as large as the ground truth: check the baseline"),
        ({"depth": True}, 0.2, "0.2 times as large as the ground truth: check the depth scale"),
        ({"baseline": 0.0}, 5.0, None),
    ],
)
def test_a_trajectory_of_another_scale_is_reported(sensor, scale: float, says: str | None):
    outcome = make_outcome()
    T_wc = outcome.trajectory.T_wc.copy()
    T_wc[:, :3, 3] *= scale
    camera = replace(outcome.sequence.camera, **sensor)
    outcome = replace(
        outcome,
        trajectory=replace(outcome.trajectory, T_wc=T_wc),
        sequence=replace(outcome.sequence, camera=camera),
    )
    warnings = summarize(outcome, evaluate_run(outcome)[0], None, None).warnings
    assert len(warnings) == (says is not None)
    assert says is None or says in warnings[0]


@pytest.mark.parametrize(("step", "covered"), [(0.05, 19), (0.1, 10)])
def test_frames_between_others_get_a_ground_truth_as_in_eval(tmp_path: Path, step, covered):
    """A reader of another package may give a pose to every second frame."""
    outcome = make_outcome(20)
    times = step * np.arange(20)
    truth = outcome.sequence.ground_truth.copy()
    truth[1::2] = np.nan
    outcome = replace(
        outcome,
        sequence=_Sequence(times, truth),
        trajectory=replace(outcome.trajectory, timestamps=times),
    )
    found, remark = evaluate_run(outcome)
    assert found.frames == len(outcome.ground_truth) == covered
    assert remark == f"{covered} of 20 frames have a ground truth"
    estimate, given = tmp_path / "estimate.tum", tmp_path / "truth.tum"
    write_tum(estimate, outcome.trajectory)
    write_tum(given, Trajectory(times[::2], truth[::2]))
    again = evaluate_trajectory(*read_pair(estimate, given))
    assert again.frames == covered
    assert again.ate_rmse_m == pytest.approx(found.ate_rmse_m, abs=1e-6)


def test_a_camera_that_stands_still_has_no_scale():
    outcome = make_outcome()
    truth, rng = outcome.sequence.ground_truth.copy(), np.random.default_rng(0)
    truth[:, :3, 3] = rng.normal(0.0, 1e-3, (len(truth), 3))
    T_wc = truth.copy()
    T_wc[:, :3, 3] = rng.normal(0.0, 3e-3, (len(truth), 3))
    outcome = replace(
        outcome,
        trajectory=replace(outcome.trajectory, T_wc=T_wc),
        sequence=replace(outcome.sequence, ground_truth=truth),
    )
    assert not summarize(outcome, evaluate_run(outcome)[0], None, None).warnings


@pytest.mark.slow
def test_warnings_stand_above_the_numbers(written: tuple[RunOutcome, Path], tmp_path: Path) -> None:
    outcome, _ = written
    report = write_results(tmp_path, replace(outcome, warnings=["The right side was black."]))
    assert report.warnings == ("The right side was black.",)
    html = (tmp_path / "report.html").read_text()
    assert 0 < html.index("Warning: The right side was black.") < html.index("ATE RMSE")
    assert "**Warning: The right side was black.**" in (tmp_path / "report.md").read_text()


def test_evo_command_names_files_that_reproduce_the_ate(written: tuple[RunOutcome, Path]) -> None:
    _, folder = written
    report = ReportJson.model_validate_json((folder / "report.json").read_bytes())
    truth, estimate = folder / "ground_truth_kitti.txt", folder / "trajectory_kitti.txt"
    assert report.evo_command == f"evo_ape kitti {truth} {estimate} --align"
    again = evaluate_trajectory(*read_pair(estimate, truth))
    assert again.ate_rmse_m == pytest.approx(report.ate_rmse_m, abs=1e-9)


def test_lost_frames_come_first_in_every_text(written: tuple[RunOutcome, Path]) -> None:
    _, folder = written
    assert next(iter(json.loads((folder / "report.json").read_text()))) == "schema_version"
    for name in ("report.json", "report.md", "report.html"):
        text = (folder / name).read_text().lower().replace("_", " ")
        assert 0 < text.index("lost frames") < text.index("ate rmse")


@pytest.mark.parametrize(("fixture", "figures"), [("written", 6), ("looped", 7)])
def test_html_is_self_contained(fixture: str, figures: int, request: pytest.FixtureRequest) -> None:
    html = (request.getfixturevalue(fixture)[1] / "report.html").read_text()
    assert len(re.findall("<svg", html)) == figures
    assert not re.search(r"(src|href|action|data)\s*=\s*[\"']?\s*(https?:)?//", html)
    assert not re.search(r"@import|url\((?!#)|<script[^>]*\ssrc", html.replace("url('#", "url(#"))
    if fixture == "written":
        assert "truncated &lt;file&gt;" in html
    else:
        assert "20 needed | &lt;b&gt;" in html


@pytest.mark.slow
def test_figures_are_reproducible(written: tuple[RunOutcome, Path], tmp_path: Path) -> None:
    outcome, folder = written
    report_of(outcome, tmp_path)
    for path in (folder / "figures").iterdir():
        assert path.read_bytes() == (tmp_path / "figures" / path.name).read_bytes()


def test_json_judges_every_loop(looped: tuple[RunOutcome, Path]) -> None:
    outcome, folder = looped
    report = json.loads((folder / "report.json").read_text())
    assert len(report["loops"]) == len(outcome.loops) == 304
    counts = ("loops_closed", "loops_rejected", "loops_found", "loops_missed", "loops_wrong")
    assert [report[name] for name in counts] == [4, 300, 1, 0, 1]
    assert report["submaps"] == 2
    first = report["loops"][0]
    assert (first["query_frame"], first["match_frame"]) == (264, 12)
    assert (first["matches"], first["inliers"], first["accepted"]) == (120, 84, True)
    assert first["correction_s"] == 0.12
    assert first["moved_m"] == pytest.approx(8.0 * 66 / 125)
    assert [x["right"] for x in report["loops"] if x["accepted"]] == [True, True, False, True]
    assert [x["right"] for x in report["loops"] if not x["accepted"]] == [None] * 299 + [True]
    assert report["revisit_stretches"] == 1
    (stretch,) = report["revisits"]
    assert stretch["loop_frame"] == 264
    assert stretch["length_m"] == pytest.approx(2 * np.pi * 32 + 5, abs=2)


def test_comparison_is_in_every_text(looped: tuple[RunOutcome, Path]) -> None:
    outcome, folder = looped
    (other,), truth = outcome.compared, outcome.ground_truth
    assert truth is not None
    expected = evaluate_trajectory(other.trajectory, truth)
    report = ReportJson.model_validate_json((folder / "report.json").read_bytes())
    own, compared = report.detectors
    assert (own.detector, compared.detector) == ("bow", "none")
    for name in set(DetectorFigures.model_fields) & set(ReportJson.model_fields):
        assert getattr(own, name) == getattr(report, name), name
    for name in ("ate_rmse_m", "rpe_m", "rpe_deg", "t_rel_percent", "r_rel_deg_per_100m"):
        assert getattr(compared, name) == getattr(expected, name), name
    assert compared.causal_ate_rmse_m == expected.ate_rmse_m  # the stub has only these poses
    counts = ("loops_closed", "loops_found", "loops_missed", "loops_wrong")
    assert [getattr(own, name) for name in counts] == [4, 1, 0, 1]
    assert [getattr(compared, name) for name in counts] == [0, 0, 1, 0]
    assert (own.seconds, compared.seconds) == (9.25, 8.5)
    for name in ("report.md", "report.html"):
        text = (folder / name).read_text()
        for row, found in (("bow", own), ("none", compared)):
            cells = [
                row, str(found.lost_frames), f"{found.ate_rmse_m:.3f} m",
                f"{found.causal_ate_rmse_m:.3f} m", f"{found.rpe_m:.4f} m",
                f"{found.rpe_deg:.4f}°", f"{found.t_rel_percent:.3f} %",
                str(found.loops_found), str(found.loops_missed),
                str(found.loops_wrong), f"{found.seconds:.1f} s",
            ]  # fmt: skip
            between = r"\s*(\||</td><td[^>]*>)\s*"
            assert re.search(between.join(map(re.escape, cells)), text), (name, row)
        assert text.index("Detectors") < text.index("Loops closed")
    estimate = read_trajectory(folder / "trajectory_none.tum")
    np.testing.assert_allclose(estimate.T_wc, other.trajectory.T_wc, atol=1e-8)


def test_compared_trajectories_are_in_the_top_view(looped: tuple[RunOutcome, Path]) -> None:
    outcome, folder = looped
    T_elsewhere = np.eye(4)
    T_elsewhere[0, 3] = 40.0
    moved = Trajectory(outcome.trajectory.timestamps, T_elsewhere @ outcome.trajectory.T_wc)
    outcome = replace(outcome, compared=(replace(outcome, trajectory=moved, compared=()),))
    truth = outcome.ground_truth
    assert truth is not None
    evaluation = evaluate_trajectory(outcome.trajectory, truth)
    axes = top_view(outcome, evaluation, None).axes[0]
    own, compared = (line for line in axes.lines if line.get_label() == "bow")
    assert "truth" in {line.get_label() for line in axes.lines}
    np.testing.assert_allclose(own.get_xydata(), compared.get_xydata(), atol=1e-6)
    alone = top_view(outcome, None, None).axes[0].lines
    own, compared = (line for line in alone if line.get_label() == "bow")
    np.testing.assert_allclose(own.get_xdata() + 40.0, compared.get_xdata(), atol=1e-6)
    assert "Dashed lines: the detectors of --compare" in (folder / "report.html").read_text()


def test_rejected_loops_do_not_drown_the_table(looped: tuple[RunOutcome, Path]) -> None:
    text = (looped[1] / "report.md").read_text()
    blocks = {block.split("\n", 1)[0]: block for block in text.split("## ")}
    closed = blocks["Loops closed"].splitlines()
    rows = [line for line in closed if line.startswith("|")][2:]
    assert [row.split("|")[1].strip() for row in rows] == [
        "360",
        "264",
        "320",
        "400",
    ]  # wrong loops come first
    assert "wrong" in rows[0]
    reasons = [line for line in blocks["Loops rejected"].splitlines() if line.startswith("|")][2:]
    assert len(reasons) == 2
    assert "0-13 inliers, 20 needed \\| <b>" in reasons[0]
    assert [cell.strip() for cell in reasons[0].rsplit("|", 4)[1:4]] == ["299", "13", "n/a"]
    assert [cell.strip() for cell in reasons[1].rsplit("|", 4)[1:4]] == ["1", "84", "1 of 1"]
    assert text.count("needed") <= 14
    assert "1 of 1 revisit found, 0 missed, 1 wrong, 300 candidates rejected" in text


@pytest.mark.slow
def test_closed_loops_are_shown_in_pictures(tmp_path: Path) -> None:
    outcome = two_laps()
    loops = [
        replace(loop, matched_by="learned", proposed_by="bow+capsule") if loop.query == 80 else loop
        for loop in outcome.loops
    ]
    outcome = replace(outcome, loops=loops)
    grey = cv2.imencode(".jpg", np.full((50, 100), 90, np.uint8))[1].tobytes()
    xy = np.array([[20.0, 20.0]])
    rejected = (368, 116)
    pictures = [
        LoopPicture(query, match, grey, grey, xy, xy)
        for query, match in ((264, 12), (320, 68), (360, 200), rejected)
    ]
    write_results(tmp_path, outcome, pictures=pictures)
    # The wrong loop comes first, then the one by learned descriptors. Frame 400 has no picture.
    names = ["loop-360-200.jpg", "loop-320-68.jpg", "loop-264-12.jpg"]
    captions = [
        "Frame 360 (right) was wrongly matched to the place of frame 200 (left): 84 matches agree; "
        "proposed by bow, verified by ORB descriptors.",
        "Frame 320 (right) shows the place of frame 68 (left): 84 matches agree; "
        "proposed by bow and capsule, verified by learned descriptors.",
        "Frame 264 (right) shows the place of frame 12 (left): 84 matches agree; "
        "proposed by bow, verified by ORB descriptors.",
    ]
    html, markdown = ((tmp_path / f"report.{kind}").read_text() for kind in ("html", "md"))
    assert re.findall(r"<figcaption>(Frame .*)</figcaption>", html) == captions
    assert re.findall(r"^Frame .*", markdown, re.MULTILINE) == captions
    assert re.findall(r"\(figures/(loop-.*)\)", markdown) == names
    assert "3 of the 4 closed loops are shown." in html
    files = [(tmp_path / "figures" / name).read_bytes() for name in names]
    embedded = re.findall(r'<img src="data:image/jpeg;base64,([^"]*)"', html)
    assert [b64decode(picture) for picture in embedded] == files
    assert len(list((tmp_path / "figures").glob("*.jpg"))) == len(names)


@pytest.mark.slow
def test_a_report_shows_a_few_loops(tmp_path: Path) -> None:
    outcome = two_laps()
    grey = cv2.imencode(".jpg", np.full((50, 100), 90, np.uint8))[1].tobytes()
    loops = [LoopEdge(query, 3, 0.7, True, "closed", 120, 84) for query in range(66, 86)]
    pictures = [
        LoopPicture(4 * loop.query, 12, grey, grey, np.zeros((0, 2)), np.zeros((0, 2)))
        for loop in loops
    ]
    write_results(tmp_path, replace(outcome, loops=loops, corrections=[]), pictures=pictures)
    assert len(list((tmp_path / "figures").glob("loop-*.jpg"))) == 6
    assert "6 of the 20 closed loops are shown." in (tmp_path / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("recordings", [[], ["recording.rrd"], ["recording-from-9.rrd"]])
def test_the_pages_name_the_recordings_that_there_are(
    tmp_path: Path, recordings: list[str]
) -> None:
    for name in recordings:
        (tmp_path / name).touch()
    report_of(make_outcome(40), tmp_path)
    for page in ("report.md", "report.html"):
        text = (tmp_path / page).read_text()
        assert re.findall(r"rerun (\S+\.rrd)", text) == recordings
        assert ("Replay" in text) is bool(recordings)


@pytest.mark.slow
def test_missed_revisit_is_named(tmp_path: Path) -> None:
    outcome = two_laps()
    report = report_of(replace(outcome, loops=outcome.loops[1:3], corrections=[]), tmp_path)
    assert (report.loops_closed, report.loops_missed, report.loops_wrong) == (0, 1, 0)
    assert report.revisits[0].loop_frame is None
    assert "missed" in (tmp_path / "report.md").read_text().split("## Revisits")[1]
    assert "revisit missed (1)" in (tmp_path / "report.html").read_text()


def test_loops_without_ground_truth() -> None:
    outcome = two_laps()
    sequence = _Sequence(outcome.sequence.timestamps, None)
    lost = LoopEdge(-1, 3, 0.4, False, "too few matches")
    outcome = replace(outcome, sequence=sequence, loops=[*outcome.loops, lost], compared=())
    report = summarize(outcome, None, evaluate_loops(outcome), None)
    assert (report.loops_found, report.loops_missed, report.loops_wrong) == (None, None, None)
    assert report.revisit_stretches is None
    assert (report.loops_closed, report.loops_rejected) == (4, 301)
    assert {loop.right for loop in report.loops} == {None}
    assert report.loops[-1].query_frame is None
    assert (headlines(report)[-1].value, headlines(report)[-1].note) == (
        "4 closed",
        "301 candidates rejected",
    )
    labels = top_view(outcome, None, None).axes[0].get_legend_handles_labels()[1]
    assert labels == ["estimate", "start", "weak (4)", "loop (4)"]
    labels = loop_closing(outcome, None).axes[0].get_legend_handles_labels()[1]
    # In one loop, the matched keyframe was culled.
    assert labels == ["before", "after", "loop, before (3)"]


def test_interrupted_run_is_not_blamed_for_revisits_to_come() -> None:
    outcome = two_laps()
    done = np.arange(240)
    outcome = replace(outcome, trajectory=outcome.trajectory.select(done), loops=[], corrections=[])
    report = summarize(outcome, None, evaluate_loops(outcome), None)
    assert (report.revisit_stretches, report.loops_missed) == (0, 0)


def test_a_right_loop_on_a_revisit_too_short_to_count_is_explained() -> None:
    outcome = two_laps()
    done = np.arange(266)
    outcome = replace(
        outcome,
        trajectory=outcome.trajectory.select(done),
        loops=outcome.loops[:1],
        corrections=[],
    )
    report = summarize(outcome, None, evaluate_loops(outcome), None)
    assert (report.revisit_stretches, report.loops_closed, report.loops[0].right) == (0, 1, True)
    note = headlines(report)[-1].note
    assert note.startswith(
        "the drive revisits no stretch of 20 m or more (1 right on shorter ones), "
    )


def test_before_is_drawn_in_the_frame_of_the_ground_truth() -> None:
    """The keyframes before the correction are aligned in the same way as the estimate."""
    outcome = two_laps()
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = [50.0, 0.0, -20.0]
    first = outcome.corrections[0]
    turned = replace(first, T_cw_before=first.T_cw_after @ np.linalg.inv(T))
    truth = outcome.ground_truth
    assert truth is not None
    trajectory = Trajectory(outcome.trajectory.timestamps, T @ truth.T_wc)
    outcome = replace(outcome, trajectory=trajectory, corrections=[turned])
    for scale, alignment in ((1.0, "se3"), (1.5, "sim3")):
        poses = truth.T_wc.copy()
        poses[:, :3, 3] *= scale
        evaluation = evaluate_trajectory(trajectory, Trajectory(truth.timestamps, poses), alignment)
        axes = loop_closing(outcome, evaluation).axes[0]
        (before,) = (line for line in axes.lines if line.get_label() == "before")
        expected = scale * truth.T_wc[outcome.keyframe_frames[turned.keyframes]][:, [0, 2], 3]
        np.testing.assert_allclose(before.get_xydata(), expected, atol=1e-6)


def monocular(outcome: RunOutcome) -> RunOutcome:
    left = replace(outcome.sequence, camera=outcome.sequence.camera.left_camera())
    tracks = [replace(track, n_stereo=0) for track in outcome.tracks]
    return replace(outcome, sequence=left, tracks=tracks)


@pytest.mark.parametrize("make", [make_outcome, two_laps])
def test_a_monocular_report_speaks_of_no_stereo_and_no_metres(make, tmp_path: Path) -> None:
    outcome = monocular(make())
    without_truth = replace(outcome.sequence, ground_truth=None)
    report_of(replace(outcome, sequence=without_truth, compared=()), tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "stereo" not in text.lower().replace("| stereo ", "")  # the name of a stage
    assert "in units of the map" in text or "Moved" not in text
    assert not re.search(r"\d\.\d\d m\b", text)
    assert top_view(outcome, None, None).axes[0].get_xlabel() == "x (map units)"


def test_frames_lost_before_the_map_began_are_explained(tmp_path: Path) -> None:
    outcome = monocular(make_outcome(40, lost=slice(0, 3)))
    dropped = replace(outcome.tracks[1], state=TrackingState.DROPPED)
    late = replace(outcome.tracks[20], state=TrackingState.LOST)
    tracks = [outcome.tracks[0], dropped, *outcome.tracks[2:20], late, *outcome.tracks[21:]]
    outcome = replace(outcome, tracks=tracks)
    report = report_of(outcome, tmp_path)
    assert (report.lost_frames, report.lost_before_map) == (3, 2)
    assert report.longest_loss_s == tracks[3].timestamp - tracks[0].timestamp
    assert headlines(report)[0].note.startswith(
        "7.5 % of 40, 2 of them before the map began: a monocular map needs the camera to move "
        "sideways first; "
    )
    stereo = headlines(report.model_copy(update={"sensor": "stereo"}))[0].note
    assert "2 of them before the map began; " in stereo
    settings = outcome.settings.model_copy(update={"map_file": tmp_path / "map.npz"})
    continued = replace(outcome, settings=settings)
    assert report_of(continued, tmp_path).lost_before_map == 0


def test_without_ground_truth(tmp_path: Path) -> None:
    report = report_of(make_outcome(40, ground_truth=False, lost=slice(20, 21)), tmp_path)
    assert report.ate_rmse_m is report.evo_command is report.alignment is None
    assert not (tmp_path / "ground_truth_kitti.txt").exists()
    assert figures_of(tmp_path) == FIGURES - {"loop_closing", "error_along_path", "error_histogram"}
    assert "n/a" in (tmp_path / "report.md").read_text()


@pytest.mark.slow
def test_ground_truth_of_some_frames(tmp_path: Path) -> None:
    """Errors are computed for the frames with ground truth.

    Loops are not evaluated, because revisits cannot be determined.
    """
    whole = make_outcome(60, lost=slice(20, 21))
    known = whole.sequence.ground_truth.copy()
    known[:15] = np.nan
    partly = replace(whole, sequence=replace(whole.sequence, ground_truth=known))
    report = report_of(partly, tmp_path)
    assert report.ate_rmse_m is not None
    assert report.evaluation_remark == "45 of 60 frames have a ground truth"
    assert "45 of 60 frames have a ground truth" in (tmp_path / "report.md").read_text()
    assert report.loops_found is None
    assert "error_along_path" in figures_of(tmp_path)
    truth, estimate = (
        read_trajectory(tmp_path / name) for name in ("ground_truth.tum", "trajectory.tum")
    )
    assert evaluate_trajectory(estimate, truth).ate_rmse_m == pytest.approx(report.ate_rmse_m)


def test_the_frames_with_a_scale_of_their_own_are_named(tmp_path: Path) -> None:
    outcome = monocular(make_outcome(40, lost=slice(0, 0)))
    gap = Gap(GapKind.PREDICTED, 20, 39, 0.5, 0.1, 2.0, 1.35)
    report_of(replace(outcome, gaps=[gap]), tmp_path)
    assert "frames 20 to 39 have scales of their own" in (tmp_path / "report.md").read_text()


def test_frames_whose_poses_were_found_later_are_not_lost(tmp_path: Path) -> None:
    outcome = monocular(make_outcome(40, lost=slice(0, 5)))
    later = [replace(track, state=TrackingState.LATER) for track in outcome.tracks[1:5]]
    outcome = replace(outcome, tracks=[outcome.tracks[0], *later, *outcome.tracks[5:]])
    assert outcome.n_tracked == 39
    report = report_of(outcome, tmp_path)
    assert (report.lost_frames, report.later_frames, report.lost_before_map) == (1, 4, 1)
    assert "4 found after the map began" in (tmp_path / "report.md").read_text()


def test_of_one_frame(tmp_path: Path) -> None:
    report = report_of(make_outcome(1, lost=slice(0, 0)), tmp_path)
    assert (report.frames, report.keyframes, report.ate_rmse_m) == (1, 1, None)
    assert "top_view" in figures_of(tmp_path)


def test_of_all_frames_lost(tmp_path: Path) -> None:
    report = report_of(make_outcome(30, lost=slice(0, 30), ground_truth=False), tmp_path)
    assert (report.lost_frames, report.weak_frames) == (30, 0)
    assert "100.0 % of 30" in (tmp_path / "report.md").read_text()
    assert "top_view" not in figures_of(tmp_path)


def test_interrupted_before_the_first_frame(tmp_path: Path) -> None:
    outcome = make_outcome(3, lost=slice(0, 0), ground_truth=False)
    nothing = outcome.trajectory.select(np.arange(0))
    outcome = replace(outcome, trajectory=nothing, keyframes=nothing, tracks=[], wall_s=0.0)
    report = report_of(replace(outcome, interrupted="Ctrl-C"), tmp_path)
    assert (report.frames, report.fps, report.cpu_ms_per_frame) == (0, 0.0, 0.0)
    assert figures_of(tmp_path) == set()


@pytest.mark.slow
def test_interrupted_with_skipped_frames_and_no_keyframe(tmp_path: Path) -> None:
    outcome = make_outcome(60, lost=slice(0, 0))
    done = np.setdiff1d(np.arange(50), [7, 8])
    outcome = replace(
        outcome,
        trajectory=outcome.trajectory.select(done),
        keyframes=outcome.keyframes.select(np.arange(0)),
        tracks=[outcome.tracks[i] for i in done],
        skipped=["7.png: damaged", "8.png: damaged"],
        n_left_out=3,
        n_keyframes=0,
        interrupted="Ctrl-C",
    )
    report = report_of(outcome, tmp_path)
    assert (report.interrupted, report.frames, report.skipped_frames) == ("Ctrl-C", 48, 2)
    assert (tmp_path / "keyframes.tum").read_text() == ""
    for name in ("report.md", "report.html"):
        assert "Interrupted: Ctrl-C" in (tmp_path / name).read_text()
        assert "2 skipped, 3 left out" in (tmp_path / name).read_text()
    assert report.left_out_frames == 3
    truth = read_trajectory(tmp_path / "ground_truth_kitti.txt")
    assert outcome.sequence.ground_truth is not None
    np.testing.assert_allclose(truth.T_wc, outcome.sequence.ground_truth[done], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "expected"), [(4, False), (5, True)])
def test_many_lost_frames_send_the_reader_to_the_doctor(tmp_path, lost, expected):
    report_of(make_outcome(40, lost=slice(20, 20 + lost)), tmp_path)
    for name in ("report.md", "report.html"):
        assert ("vslam doctor checks" in (tmp_path / name).read_text()) is expected


@pytest.mark.slow
def test_calibration_files_are_among_the_options(tmp_path):
    outcome = make_outcome(40)
    files = (Path("left.yaml"), Path("right.yaml"))
    settings = outcome.settings.model_copy(update={"calib": files})
    report = report_of(replace(outcome, settings=settings), tmp_path)
    assert report.calib == settings.calib
    assert "right.yaml" in (tmp_path / "report.md").read_text()


def test_the_report_has_a_section_on_the_imu(tmp_path):
    report = report_of(carried(), tmp_path)
    found = report.imu
    assert found.refused == ""
    assert found.gravity_since_s == pytest.approx(1.0)
    assert report.gravity == tuple(DOWN)
    assert found.gyro_bias == (0.01, 0.02, 0.03)
    assert found.accel_bias_sigma == pytest.approx((0.01, 0.02, 0.03))
    assert report.inertial_frames == 6
    assert report.lost_frames == 0
    assert found.carried_s == pytest.approx(0.6)
    assert found.longest_s == pytest.approx(0.5)
    assert found.carried_error_m == pytest.approx(0.04 * np.sqrt(3.0))
    assert found.carried_error_deg == pytest.approx(0.0, abs=1e-6)
    # An error of 0.04 m along three axes, whose variances are those of both ends together.
    assert found.carried_nees == pytest.approx(3 * 0.04**2 / 2e-4 / 6.0, rel=0.05)
    text = (tmp_path / "report.md").read_text()
    assert "since 1.00 s" in text
    assert "6 frames, 0.60 s, the longest stretch 0.50 s" in text
    assert "0.0100 ± 0.0010" in text
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {"gyro_bias", "accel_bias"} <= drawn
    assert not {"gyro_bias", "accel_bias"} & FIGURES


def test_the_report_says_why_an_imu_was_not_used(tmp_path):
    before = make_outcome()
    assert summarize(before, None, None, None).imu is None
    sequence = replace(before.sequence, imu_refused="imu.csv: the IMU is not used, because.")
    report = report_of(replace(before, sequence=sequence), tmp_path)
    assert report.imu.refused == "imu.csv: the IMU is not used, because."
    text = (tmp_path / "report.md").read_text()
    assert "## IMU\n\nimu.csv: the IMU is not used, because.\n" in text
    assert "gravity known" not in text

    during = replace(carried(), warnings=[IMU_REFUSED])
    assert summarize(during, None, None, None).imu.refused == IMU_REFUSED
