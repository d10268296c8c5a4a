"""Recordings are valid and small, and a failing recorder does not end a run."""

from __future__ import annotations

import errno
import logging
import re
import socket
import subprocess
import sys
import textwrap
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from vslam.run import recorder as recorder_module
from vslam.run.moments import LoopPictureRecorder
from vslam.run.recorder import (
    Recorder,
    RerunRecorder,
    SeveralRecorders,
    open_viewer,
)
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.features import Features, TrackingState, TrackResult
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory

pytest.importorskip("rerun.chunk", reason="this rerun cannot read recordings in Python")

CAMERA = Camera(718.9, 718.9, 607.2, 185.2, 0.537, 1241, 376)
FRAMES, FRAMES_PER_KEYFRAME, LANDMARKS_PER_KEYFRAME = 100, 3, 150

REJECTED = LoopEdge(3, 0, 0.2, False, "too few inliers", 14, 7, proposed_by="bow")
LOST = LoopEdge(-1, 2, 0.3, False, "too few matches", 8)
CLOSED = LoopEdge(
    12, 1, 0.6, True, "closed", 90, 60, features=np.zeros(1, np.int32), matched_by="learned",
    proposed_by="bow+capsule",
)  # fmt: skip
LOOPS = {12: [REJECTED], 42: [REJECTED, CLOSED, LOST], 45: [CLOSED], 70: [LOST]}
SHIFTED_AT = 60
GRAVITY_SINCE, DOWN = 11, np.array([0.0, 9.81, 0.0])


def _pose(frame: int) -> NDArray[np.float64]:
    T_wc = np.eye(4)
    T_wc[:3, :3] = [[np.cos(0.01 * frame), 0, np.sin(0.01 * frame)], [0, 1, 0], [0, 0, 0]]
    T_wc[2, :3] = [-np.sin(0.01 * frame), 0, np.cos(0.01 * frame)]
    T_wc[:3, 3] = [0.1 * frame, 0.0, frame]
    return T_wc


def _result(frame: int) -> TrackResult:
    stage_ms = {"extract": 16.0, "track": 5.0}
    if is_keyframe := frame % FRAMES_PER_KEYFRAME == 0:
        stage_ms["bundle"] = 15.0
    state = TrackingState.LOST if 40 <= frame < 44 else TrackingState.OK
    return TrackResult(
        frame, 0.1 * frame, _pose(frame), state, 2000, 1100, 500, 400, is_keyframe,
        stage_ms=stage_ms, gravity=None if frame < GRAVITY_SINCE else DOWN,
    )  # fmt: skip


def _image(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Make a texture at several scales. As a JPEG, it is slightly larger than a KITTI image."""
    import cv2

    image = np.zeros((CAMERA.height, CAMERA.width))
    for scale in (4, 8, 16, 64):
        shape = (CAMERA.height // scale + 1, CAMERA.width // scale + 1)
        image += cv2.resize(rng.normal(0.0, 22.0, shape), (CAMERA.width, CAMERA.height))
    return np.clip(image + 120.0, 0, 255).astype(np.uint8)


def _features(rng: np.random.Generator, n: int = 2000) -> Features:
    return Features(
        xy=(rng.random((n, 2)) * [CAMERA.width, CAMERA.height]).astype(np.float32),
        octave=np.zeros(n, np.uint8),
        angle=np.zeros(n, np.float32),
        descriptors=np.zeros((n, 32), np.uint8),
        u_right=np.full(n, np.nan, np.float32),
    )


def record(recorder: Recorder, frames: int = FRAMES, camera: Camera = CAMERA) -> None:
    """Send a run to a recorder in the same way as the pipeline."""
    rng = np.random.default_rng(0)
    image = _image(rng)
    poses = np.array([_pose(frame) for frame in range(frames)])
    offset = np.eye(4)
    offset[:3, 3] = [100.0, 0.0, 50.0]
    recorder.begin(camera, Trajectory(0.1 * np.arange(frames), offset @ poses))
    map_ = Map(np.ones(8))
    for frame in range(frames):
        result = _result(frame)
        recorder.frame(result)
        if result.is_keyframe:
            features = _features(rng)
            # Equal images would be compressed too well.
            image = np.roll(image, rng.integers(1, 100), axis=1)
            recorder.keyframe(result, image, features.xy, rng.random(2000) < 0.25)
            new = rng.normal(0.0, 20.0, (LANDMARKS_PER_KEYFRAME, 3)) + result.T_wc[:3, 3]
            descriptors = np.zeros((LANDMARKS_PER_KEYFRAME, 4), np.uint64)
            T_cw = np.linalg.inv(result.T_wc)
            keyframe = map_.add_keyframe(_features(rng, 1), T_cw, result.timestamp, frame)
            map_.add_landmarks(new, descriptors, keyframe)
        recorder.map(map_)
        if frame in LOOPS:
            recorder.loops(LOOPS[frame], map_)
        if frame == SHIFTED_AT:  # like a loop correction
            map_.arrays.T_cw[: map_.n_keyframes, 1, 3] -= 5.0
    recorder.finish(Trajectory(0.1 * np.arange(frames), poses), map_)


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """Return all rows of an entity in the order of their frames. Static rows are included."""
    from rerun.chunk import RrdReader

    found: list[dict[str, Any]] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == f"/{entity}":
            found += chunk.to_record_batch().to_pylist()
    return sorted(found, key=lambda row: row.get("frame", -1))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "recording.rrd"
    pictures = LoopPictureRecorder()
    record(SeveralRecorders((pictures, RerunRecorder(path, pictures.pictures))))
    return path


def test_entities_and_their_frames(recording: Path) -> None:
    keyframes = len(range(0, FRAMES, FRAMES_PER_KEYFRAME))
    expected = {
        "world": 1,
        "world/camera": FRAMES,
        "world/camera/gravity": 1 + FRAMES - GRAVITY_SINCE,
        "world/camera/image": 1 + keyframes,
        "world/camera/image/tracked": 1 + keyframes,
        "world/camera/image/untracked": 1 + keyframes,
        "world/landmarks": 1 + 2 + 1,  # the first keyframe, a loop, the end
        "world/keyframes": 2 + 1,
        "world/loops/accepted": 2 + 1,  # two decisions, and the end
        "world/loops/rejected": 6,  # shown and hidden
        "state/loops": 6,
        "loops/images": 2,  # of accepted loops
        "world/ground_truth": 1,
        "world/trajectory": 1 + FRAMES,
        "points/inliers": 1 + FRAMES,
        "stage_ms/extract": 1 + FRAMES,
        "stage_ms/bundle": 1 + keyframes,
        "state": 3,
    }
    assert {entity: len(rows(recording, entity)) for entity in expected} == expected


def test_a_monocular_recording_counts_features_in_place_of_stereo_matches(tmp_path: Path) -> None:
    record(RerunRecorder(tmp_path / "mono.rrd"), 4, CAMERA.left_camera())
    assert len(rows(tmp_path / "mono.rrd", "points/features")) == 5
    assert not rows(tmp_path / "mono.rrd", "points/stereo")


def test_size_budget(recording: Path) -> None:
    # The map grows with the run, but adds at most 5 MB (30,000 points in one of 75 frames).
    assert 1000 / FRAMES * recording.stat().st_size + 5e6 < 50e6


def test_gravity_is_recorded_in_the_frame_of_the_camera(recording: Path) -> None:
    row = rows(recording, "world/camera/gravity")[-1]
    assert row["frame"] == FRAMES - 1
    arrow = np.array(row["Arrows3D:vectors"][0])
    expected = _pose(FRAMES - 1)[:3, :3].T @ DOWN
    cosine = arrow @ expected / np.linalg.norm(arrow) / np.linalg.norm(expected)
    assert cosine == pytest.approx(1.0)


def test_poses_keep_their_orientation(recording: Path) -> None:
    row = rows(recording, "world/camera")[60]
    assert row["frame"] == 60
    columns = np.array(row["Transform3D:mat3x3"]).reshape(3, 3)
    np.testing.assert_allclose(columns.T, _pose(60)[:3, :3], atol=1e-6)
    np.testing.assert_allclose(row["Transform3D:translation"][0], _pose(60)[:3, 3], atol=1e-5)


def test_ground_truth_starts_where_the_estimate_does(recording: Path) -> None:
    (strip,) = rows(recording, "world/ground_truth")[0]["LineStrips3D:strips"]
    np.testing.assert_allclose(strip[0], [0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(strip[-1], _pose(FRAMES - 1)[:3, 3], atol=1e-4)


def test_a_later_ground_truth_starts_at_the_estimate_of_its_first_frame(tmp_path: Path) -> None:
    recorder = RerunRecorder(tmp_path / "late.rrd")
    times, poses = 0.1 * np.arange(FRAMES), np.array([_pose(frame) for frame in range(FRAMES)])
    offset = np.eye(4)
    offset[:3, 3] = [100.0, 0.0, 50.0]
    recorder.begin(CAMERA, Trajectory(times[38:], offset @ poses[38:]))  # frames 40 to 43 are lost
    for frame in range(FRAMES):
        result = _result(frame)
        recorder.frame(replace(result, state=TrackingState.LOST) if frame < 44 else result)
    recorder.finish(Trajectory(times, poses), None)
    (strip,) = rows(tmp_path / "late.rrd", "world/ground_truth")[0]["LineStrips3D:strips"]
    np.testing.assert_allclose(strip[0], _pose(38)[:3, 3], atol=1e-4)
    np.testing.assert_allclose(strip[-1], _pose(FRAMES - 1)[:3, 3], atol=1e-4)


def test_the_final_trajectory_grows_with_the_frames(recording: Path) -> None:
    found = [row for row in rows(recording, "world/trajectory") if row.get("LineStrips3D:strips")]
    for row in (found[0], found[60], found[-1]):
        (strip,) = row["LineStrips3D:strips"]
        assert len(strip) == row["frame"] + 1
        np.testing.assert_allclose(strip[-1], _pose(row["frame"])[:3, 3], atol=1e-4)


def test_each_stage_has_a_colour_of_its_own(recording: Path) -> None:
    stages = ("extract", "track", "bundle")
    colors = {rows(recording, f"stage_ms/{name}")[0]["SeriesLines:colors"][0] for name in stages}
    assert len(colors) == len(stages)


def _strips(row: dict[str, Any]) -> NDArray[np.float32]:
    return np.array(row["LineStrips3D:strips"], np.float32).reshape(-1, 2, 3)


def test_rejected_loops_are_shown_for_a_while(recording: Path) -> None:
    shown = rows(recording, "world/loops/rejected")
    assert [row["frame"] for row in shown] == [12, 32, 42, 62, 70, 90]
    # A frame that is not in the map has no position, so that there is only one line.
    assert [len(_strips(row)) for row in shown] == [1, 0, 1, 0, 0, 0]
    ends = [_pose(0)[:3, 3], _pose(3 * FRAMES_PER_KEYFRAME)[:3, 3]]
    np.testing.assert_allclose(_strips(shown[0])[0], ends, atol=1e-5)


def test_accepted_loops_stay_and_move_with_the_map(recording: Path) -> None:
    shown = rows(recording, "world/loops/accepted")
    assert [row["frame"] for row in shown] == [42, 45, 99]
    assert [len(_strips(row)) for row in shown] == [1, 2, 2]
    before, after = _strips(shown[1]), _strips(shown[2])
    np.testing.assert_allclose(after - before, np.full((2, 2, 3), [0, 5, 0]), atol=1e-5)
    # After a loop closure, the corrected map is shown, unless the map was shown just before.
    assert [row["frame"] for row in rows(recording, "world/keyframes")] == [0, 42, 99]


def test_loops_are_told_with_their_reasons(recording: Path) -> None:
    told = [row["TextLog:text"][0] for row in rows(recording, "state/loops")]
    assert told[0] == (
        "frame 9 to frame 0: too few inliers, 7 inliers of 14 matches, "
        "proposed by bow, matched by orb descriptors"
    )
    assert any(text.startswith("a lost frame to frame 6: too few matches") for text in told)
    assert told[-2] == (
        "frame 36 to frame 3: closed, 60 inliers of 90 matches, "
        "proposed by bow+capsule, matched by learned descriptors"
    )


def test_a_closed_loop_shows_its_images_until_the_next_one(recording: Path) -> None:
    import cv2

    shown = rows(recording, "loops/images")
    assert [row["frame"] for row in shown] == [42, 45]
    picture = cv2.imdecode(np.array(shown[0]["EncodedImage:blob"][0], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (194, 640 + 8 + 640, 3)
    # The images of the two keyframes, frames 3 and 36 of the run.
    keyframes = {
        row["frame"]: row for row in rows(recording, "world/camera/image") if "frame" in row
    }
    for frame, half in ((3, picture[:, :640]), (36, picture[:, 648:])):
        blob = np.array(keyframes[frame]["EncodedImage:blob"][0], np.uint8)
        image = cv2.resize(cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE), (640, 194)).astype(float)
        difference = np.abs(image - half[..., 0])[30:]  # below the number of the frame
        assert difference.mean() < 6


def test_image_is_half_size_jpeg(recording: Path) -> None:
    import cv2

    row = rows(recording, "world/camera/image")[-1]
    jpeg = np.array(row["EncodedImage:blob"][0], np.uint8)
    assert cv2.imdecode(jpeg, cv2.IMREAD_UNCHANGED).shape == (188, 620)
    assert len(jpeg) < 35_000


def test_a_run_without_frames(tmp_path: Path) -> None:
    recorder = RerunRecorder(tmp_path / "recording.rrd")
    recorder.begin(CAMERA, None)
    recorder.finish(Trajectory(np.zeros(0), np.zeros((0, 4, 4))), Map(np.ones(8)))
    assert rows(tmp_path / "recording.rrd", "world")


def test_unwritable_path_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "vslam.run.recorder"):
        record(RerunRecorder(tmp_path / "missing" / "recording.rrd"), frames=4)
    assert "recording ends here" in caplog.text


def test_almost_full_disk_ends_the_recording_cleanly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    usage = namedtuple("usage", "total used free")
    free = iter([2**40, 2**40, 2**20])
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(0, 0, next(free)))
    with caplog.at_level(logging.WARNING, "vslam.run.recorder"):
        record(RerunRecorder(tmp_path / "recording.rrd"), frames=20)
    assert "almost full" in caplog.text
    assert len(rows(tmp_path / "recording.rrd", "world/camera/image")) == 1 + 2
    assert len(rows(tmp_path / "recording.rrd", "world/camera")) == 7


@pytest.mark.slow
def test_failing_disk_neither_ends_nor_hangs_the_run(tmp_path: Path) -> None:
    # Rerun's writer thread dies at the limit. A separate process shows that the program ends.
    script = """
        import resource, sys
        from pathlib import Path
        import vslam.run.recorder
        from test_recorder import RerunRecorder, record

        vslam.run.recorder._FLUSH_TIMEOUT_S = 1.0
        recorder = RerunRecorder(Path(sys.argv[1]))
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
        record(recorder)
        print("finished")
    """
    done = subprocess.run(
        # -B: Python would write half a bytecode file, and read it later.
        [sys.executable, "-B", "-c", textwrap.dedent(script), str(tmp_path / "recording.rrd")],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0
    assert done.stdout == "finished\n"
    assert "recording ends here" in done.stderr


SERVER = """
import sys, time, rerun as rr
stream = rr.RecordingStream("viewer")
stream.serve_grpc(grpc_port=int(sys.argv[1]))
time.sleep(60)
"""


@pytest.fixture
def window(monkeypatch):
    """A process in place of the viewer's window, which receives the data that are sent to it."""
    started = []

    def start(port, words):
        started.append(subprocess.Popen([sys.executable, "-c", SERVER, str(port)]))
        return started[-1]

    monkeypatch.setattr(recorder_module, "_start_viewer", start)
    monkeypatch.setenv("DISPLAY", ":0")
    yield started
    for process in started:
        process.kill()
        process.wait()


def both(path: Path, kind: str) -> SeveralRecorders:
    return SeveralRecorders((RerunRecorder(path), RerunRecorder(open_viewer(kind))))


def test_a_window_shows_the_run_and_the_recording_is_the_same(tmp_path, window, recording, caplog):
    record(both(tmp_path / "recording.rrd", "native"))
    assert not caplog.records
    for entity in ("world/camera", "world/landmarks", "state"):
        assert len(rows(tmp_path / "recording.rrd", entity)) == len(rows(recording, entity))


@pytest.mark.slow
def test_a_window_that_is_closed_does_not_end_the_recording(tmp_path, window, recording, caplog):
    class Closing(Recorder):
        def map(self, map_: Map) -> None:
            if map_.n_keyframes == 10:
                window[0].kill()
                window[0].wait()

    recorder = both(tmp_path / "recording.rrd", "native")
    record(SeveralRecorders((*recorder.recorders, Closing())))
    assert "the viewer: recording ends here" in caplog.text
    entity = "world/camera"
    assert len(rows(tmp_path / "recording.rrd", entity)) == len(rows(recording, entity))


def test_a_page_shows_the_run(monkeypatch, caplog):
    from urllib.request import urlopen

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    viewer = open_viewer("web")
    assert b"<html" in urlopen(viewer.address).read().lower()
    # A server on all interfaces listens on every address of this machine.
    for port in map(int, re.findall(r"(?:localhost|127\.0\.0\.1):(\d+)", viewer.address)):
        with socket.socket() as elsewhere:
            assert elsewhere.connect_ex(("127.0.0.2", port)) == errno.ECONNREFUSED
    record(RerunRecorder(viewer), frames=20)
    assert not caplog.records


def test_a_window_without_a_display_is_refused(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(InputError, match="--view native: there is no display here"):
        open_viewer("native")


def test_a_viewer_that_does_not_answer_is_ended(monkeypatch):
    viewer = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(recorder_module, "_start_viewer", lambda port, words: viewer)
    monkeypatch.setattr(recorder_module, "_VIEWER_STARTS_S", 0.1)
    with pytest.raises(InputError, match="the viewer does not start here"):
        open_viewer("native")
    assert viewer.wait(5.0) != 0


def test_a_viewer_that_cannot_be_started_is_refused(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(recorder_module, "_executable", lambda: "/no/such/program")
    with pytest.raises(InputError, match=r"no viewer can be started .*No such file"):
        open_viewer("native")
    monkeypatch.setattr(recorder_module, "_executable", lambda: "/bin/false")
    with pytest.raises(InputError, match="the viewer does not start here; run without --view"):
        open_viewer("native")
