"""Parts of a drive that only a prediction connects, on a ring of points (tests/ring.py)."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import test_monocular
from evo.tools import file_interface
from ring import Oracle
from test_closing import EXACT, ROUND, run
from test_report import make_outcome
from typer.testing import CliRunner

from vslam.backend.similarity_graph import GAP_SCALE
from vslam.cli.main import every_command
from vslam.method.gaps import Gap, GapKind, sentences
from vslam.report.folder import write_results
from vslam.slam import Slam
from vslam.types.features import Extracted, Features, TrackingState
from vslam.types.geometry import inverse, orthonormalised, se3_log
from vslam.types.odometry import relative_covariance
from vslam.types.trajectory import read_trajectory

DARK = range(30, 50)


def rms(covariance):
    """Return the deviations of a ``(6, 6)`` covariance in metres and degrees."""
    variances = np.diag(covariance)
    return np.sqrt(variances[:3].sum()), np.degrees(np.sqrt(variances[3:].sum()))


def test_a_prediction_that_nothing_confirms_is_a_gap():
    """The car brakes in the dark, and the turn becomes sharper, to where it has not been."""
    frames = [*range(30), *np.linspace(30, 42, 20), *range(43, 80)]
    slam, results = run(EXACT, frames, dark=DARK)
    (gap,) = slam.gaps()
    lost = [result.index for result in results if result.state is TrackingState.LOST]
    assert (gap.kind, gap.first, gap.last) == (GapKind.PREDICTED, lost[-1], len(frames) - 1)
    assert gap.seconds == pytest.approx(0.1 * len(lost))
    assert [result.part for result in results] == [0] * gap.first + [1] * (80 + 7 - gap.first)
    assert [r.index for r in results if r.measured] == [*range(30)]

    T_wc, truth = slam.trajectory().T_wc, [EXACT.pose(k) for k in frames]
    moved, true = (inverse(T[gap.first]) @ T[29] for T in (T_wc, truth))
    xi = se3_log(orthonormalised(true @ inverse(moved)))
    metres, degrees = np.linalg.norm(xi[:3]), np.degrees(np.linalg.norm(xi[3:]))
    assert 0.5 < metres / gap.sigma_m < 2.0
    assert 0.1 < degrees / gap.sigma_deg < 1.0

    before, after = results[29], results[-1]
    T = inverse(after.T_odom_camera) @ before.T_odom_camera
    far = rms(relative_covariance(before.uncertainty, after.uncertainty, T))
    assert far[1] == pytest.approx(gap.sigma_deg, rel=0.05)
    assert far[0] > gap.sigma_m  # the turn moves what comes after it
    (said,) = sentences([gap], len(frames))
    assert said.startswith(f"All frames from frame {gap.first} on hang together with the earlier")
    assert f"off by {gap.sigma_m:.0f} m and {gap.sigma_deg:.0f} degrees" in said


def test_where_the_pose_was_confirmed_there_is_no_gap():
    slam, results = run(EXACT, [*range(60)], dark=(30, 31))
    assert [r.index for r in results if not r.measured] == [30, 31]
    assert not slam.gaps()
    assert all(result.part == 0 for result in results)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_a_part_that_a_loop_has_joined_is_no_gap(threads):
    frames = [*ROUND[:80], *ROUND[140:]]
    part_of_frame = []
    slam, results = run(
        EXACT, frames, Oracle(EXACT, frames), threads=threads,
        look=lambda slam: part_of_frame.append(slam._session.published.view.part),
    )  # fmt: skip
    assert slam.map.restarts
    assert not slam.gaps()
    parts = [result.part for result in results]
    assert parts == part_of_frame
    assert {0, 1} == set(parts)
    joined = len(parts) - parts[::-1].index(1)
    assert joined < len(parts) - 10
    assert all(result.measured for result in results[joined:])
    assert not any(result.measured for result in results[90:joined])


def test_lost_frames_at_the_start_and_at_the_end_are_gaps():
    slam, _ = run(EXACT, [*range(50)], dark=(0, 1, 2, 48, 49))
    start, end = slam.gaps()
    assert (start.kind, start.first, start.last, start.sigma_m) == (GapKind.START, 0, 2, None)
    assert (end.kind, end.first, end.last) == (GapKind.END, 48, 49)
    assert 0.01 < end.sigma_m < 0.1
    T_wc = slam.trajectory().T_wc
    assert (T_wc[:3] == T_wc[3]).all()  # as the sentence says
    said = sentences([start, end], 50)
    assert "copied from frame 3" in said[0]
    assert "after 0.2 s may be off by 0.0" in said[1]


def test_a_drive_without_a_tracked_frame_has_no_gaps():
    slam, _ = run(EXACT, [*range(5)], dark=range(5))
    assert slam.gaps() == []


def test_the_scale_after_a_gap_is_predicted_too():
    slam, _ = test_monocular.run(ROUND[:70], dark=range(35, 45))
    (gap,) = slam.gaps()
    assert gap.kind is GapKind.PREDICTED
    assert gap.scale == pytest.approx(np.exp(GAP_SCALE))
    (said,) = sentences([gap], 70, "map units")
    assert "map units" in said
    assert "the scale by a factor of 1.35" in said


def see(slam, frames):
    for i, k in enumerate(frames):
        image = np.array([[i & 255, i >> 8]], np.uint8)
        features = Features.none() if k is None else EXACT.see(k, 2)
        slam.step_features(Extracted(features), 0.1 * i, image)
    slam.finish()
    return slam.gaps()


def test_a_drive_in_a_map_that_it_does_not_recognise_is_a_gap(tmp_path):
    slam, _ = run(EXACT, [*range(30)])
    slam.save(tmp_path / "map.npz")
    again = Slam.load(tmp_path / "map.npz", threads=1)
    *_, gap = see(again, [*range(100, 130)])
    assert (gap.kind, gap.last, gap.seconds, gap.sigma_m) == (GapKind.UNKNOWN, 29, 0.0, None)
    (said,) = sentences([gap], 30)
    assert "hang together with the rest by nothing that was measured" in said


def test_a_map_that_is_continued_keeps_its_gap(tmp_path):
    """A later drive is found in the part after the gap, whose place in the world is not known."""
    slam, _ = run(EXACT, ROUND[:80], Oracle(EXACT, ROUND[:80]), dark=DARK)
    slam.save(tmp_path / "map.npz")
    info = CliRunner().invoke(
        every_command(), ["map", "info", str(tmp_path / "map.npz")], color=False
    )
    assert "2, in 2 parts that no loop has joined" in info.output
    frames = [*ROUND[60:75]]
    oracle = Oracle(EXACT, ROUND[:80])
    again = Slam.load(tmp_path / "map.npz", None, oracle, threads=1, localize=True)
    for i, k in enumerate(frames):
        image = np.array([[int(k) & 255, int(k) >> 8]], np.uint8)
        result = again.step_features(Extracted(EXACT.see(k, 2)), 0.1 * i, image)
        assert (result.state, result.part, result.measured) == (TrackingState.OK, 1, False)
    again.finish()
    (gap,) = again.gaps()
    assert (gap.kind, gap.first, gap.last) == (GapKind.UNKNOWN, 0, len(frames) - 1)


def test_without_a_velocity_nothing_is_known_about_the_motion():
    """The second frame is already dark, and then the camera is elsewhere."""
    slam, _ = run(EXACT, [*range(4), *range(40, 56)], dark=range(1, 4))
    (gap,) = slam.gaps()
    assert (gap.kind, gap.first, gap.sigma_m, gap.sigma_deg) == (GapKind.UNKNOWN, 4, None, None)
    assert gap.seconds == pytest.approx(0.4)
    (said,) = sentences([gap], 20)
    assert "its velocity before was unknown" in said


GAP = Gap(GapKind.PREDICTED, 90, 159, 2.1, 6.58, 62.5)


def test_many_gaps_are_one_sentence():
    many = [replace(GAP, first=10 * k, last=10 * k + 4, sigma_m=k) for k in range(1, 6)]
    (said,) = sentences(many, 100)
    assert said.startswith("25 frames in 5 stretches, the first from frame 10 on, hang together")
    assert "up to 5.0 m" in said
    assert len(sentences(many[:3], 100)) == 3
    assert sentences([replace(GAP, last=90)], 160)[0].startswith("Frame 90 hangs together")


def test_the_results_of_a_run_name_its_gaps(tmp_path):
    outcome = make_outcome(160)
    tracks = [replace(track, part=int(track.index >= 90)) for track in outcome.tracks]
    report = write_results(tmp_path, replace(outcome, tracks=tracks, gaps=[GAP]))
    (said,) = report.warnings
    assert said.startswith("All frames from frame 90 on hang together")
    assert said in (tmp_path / "report.md").read_text(encoding="utf-8")
    assert said in (tmp_path / "report.html").read_text(encoding="utf-8")
    (entry,) = json.loads((tmp_path / "report.json").read_text())["gaps"]
    assert entry == {
        "kind": "predicted", "first": 90, "last": 159, "seconds": 2.1, "sigma_m": 6.58,
        "sigma_deg": 62.5, "scale": 1.0,
    }  # fmt: skip
    assert (tmp_path / "gaps.csv").read_text() == (
        "kind,first,last,seconds,sigma_m,sigma_deg,scale\npredicted,90,159,2.1,6.58,62.5,1.0\n"
    )
    rows = (tmp_path / "frames.csv").read_text().splitlines()
    column = rows[0].split(",").index("part")
    assert [int(row.split(",")[column]) for row in rows[1:]] == [0] * 90 + [1] * 70

    tum = tmp_path / "trajectory.tum"
    assert tum.read_text(encoding="ascii").startswith(f"# {said}\n")
    np.testing.assert_allclose(read_trajectory(tum).T_wc, outcome.trajectory.T_wc, atol=1e-8)
    assert file_interface.read_tum_trajectory_file(tum).num_poses == 160
    assert file_interface.read_kitti_poses_file(tmp_path / "trajectory_kitti.txt").num_poses == 160

    report = write_results(tmp_path, outcome)  # for example after a run was resumed
    assert not report.warnings
    assert not (tmp_path / "gaps.csv").exists()
    assert not tum.read_text().startswith("#")
