"""Records a run for the Rerun viewer.

A recording can be replayed later with ``rerun recording.rrd``, or shown live during the run.

Only this module imports rerun. The methods of a ``Recorder`` are called from one thread only.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import logging
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.run.loop_pictures import LoopPicture, draw_picture
from vslam.support.errors import InputError
from vslam.support.plugins import reason
from vslam.types.camera import Camera, Image
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import inverses
from vslam.types.imu import GRAVITY
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)
_P = ParamSpec("_P")

# The budget is 50 MB for 1,000 frames, of which about 350 are keyframes of 1241x376 pixels with
# 2,000 features. The images take about 11 MB, the keypoints 6 MB, and 14 maps 5 MB. Further maps,
# which are recorded after loops, take up to 13 MB, and the pictures of these loops up to 4 MB.
_IMAGE_SCALE = 0.5
_JPEG_QUALITY = 75
_MAX_POINTS_PER_MAP = 30_000  # except for the last map, which is complete

_TRAJECTORY_STEPS = 100  # they take 0.6 MB for 1,000 frames
_REJECTED_SHOWN_FRAMES = 20  # the lines of rejected loops are hidden after this many frames
_VIEWER_PORT, _WEB_PORT = 9876, 9090  # rerun's default ports
_VIEWER_STARTS_S = 20.0
_FLUSH_TIMEOUT_S = 5.0
_RESERVED_BYTES = 64 * 2**20  # kept free for the map, the trajectories and the report

_GREEN, _AMBER, _RED = (16, 185, 129), (245, 158, 11), (239, 68, 68)
_BLUE, _GREY = (59, 130, 246), (148, 163, 184)
_FAINT_RED = (239, 68, 68, 80)
_VIOLET, _PINK, _CYAN, _LIME = (139, 92, 246), (236, 72, 153), (6, 182, 212), (132, 204, 22)
_STAGE_COLORS = (_BLUE, _AMBER, _GREEN, _VIOLET, _PINK, _CYAN, _LIME, _RED, _GREY)
_STATE_COLORS = {
    TrackingState.OK: _GREEN, TrackingState.WEAK: _AMBER, TrackingState.INERTIAL: _BLUE,
    TrackingState.LOST: _RED,
}  # fmt: skip


@dataclass(frozen=True)
class _Pace:
    """Settings that determine how often data are sent to the recording.

    Attributes:
        frames: number of frames in a batch.
        keyframes: number of new keyframes after which the map is sent again.
        corrected_keyframes: number of new keyframes after which a map that a loop has corrected is
            sent again.
    """

    frames: int
    keyframes: int
    corrected_keyframes: int


_FILE_PACE = _Pace(50, 25, 10)
_VIEWER_PACE = _Pace(5, 5, 2)  # more often than for a file, whose size must be limited


class Recorder:
    """Interface for recording a run. This base class records nothing (``--no-record``).

    No method raises an error if a recording cannot be written.
    """

    def begin(self, camera: Camera, ground_truth: Trajectory | None) -> None:
        """Log the data that do not change during a run. Call this before the first frame.

        Args:
            camera: the camera of the images that are given to ``keyframe``.
            ground_truth: poses of the frames of this run, in any world frame. None if they are
                unknown.
        """

    def frame(self, result: TrackResult) -> None:
        """Log the result of tracking one frame."""

    def keyframe(self, result: TrackResult, image: Image, xy: NDArray, tracked: NDArray) -> None:
        """Log the image and keypoints of a keyframe. Call this after ``frame``.

        Args:
            result: the result of tracking the frame that became the keyframe.
            image: ``(H, W)`` uint8 left image.
            xy: ``(N, 2)`` float32 positions of the features of the image, in pixels.
            tracked: ``(N,)`` bool, whether each feature is an inlier match of a landmark.
        """

    def map(self, map_: Map) -> None:
        """Log the map if enough keyframes were added since it was last logged.

        Call this after ``frame``, while no mapping job is running.
        """

    def loops(self, edges: Collection[LoopEdge], map_: Map) -> None:
        """Log loop candidates that were accepted or rejected since the last call.

        Call this after ``frame``, while no mapping job is running.

        Args:
            map_: the map, which has already been corrected by the accepted loops.
        """

    def finish(self, trajectory: Trajectory, map_: Map | None) -> None:
        """Log the final trajectory and the map, if there is a map, and close the recording."""


class SeveralRecorders(Recorder):
    """Forwards every call to several recorders.

    If a recorder raises an error, a warning is logged, and this recorder is not called again.
    """

    def __init__(self, recorders: Sequence[Recorder]) -> None:
        self.recorders = list(recorders)

    def begin(self, camera: Camera, ground_truth: Trajectory | None) -> None:
        self._tell(lambda one: one.begin(camera, ground_truth))

    def frame(self, result: TrackResult) -> None:
        self._tell(lambda one: one.frame(result))

    def keyframe(self, result: TrackResult, image: Image, xy: NDArray, tracked: NDArray) -> None:
        self._tell(lambda one: one.keyframe(result, image, xy, tracked))

    def map(self, map_: Map) -> None:
        self._tell(lambda one: one.map(map_))

    def loops(self, edges: Collection[LoopEdge], map_: Map) -> None:
        self._tell(lambda one: one.loops(edges, map_))

    def finish(self, trajectory: Trajectory, map_: Map | None) -> None:
        self._tell(lambda one: one.finish(trajectory, map_))

    def _tell(self, call: Callable[[Recorder], None]) -> None:
        for recorder in self.recorders.copy():
            try:
                call(recorder)
            except Exception as error:
                self.recorders.remove(recorder)
                name = type(recorder).__name__
                _log.warning("%s failed (%s); the run continues without it.", name, reason(error))


@dataclass(frozen=True)
class Viewer:
    """A viewer that has been started.

    Attributes:
        address: URL of the page that shows the viewer. The address is empty if the viewer is a
            window.
        sink: the rerun object to which a recording is sent.
    """

    address: str
    sink: Any


def open_viewer(kind: str) -> Viewer:
    """Start the Rerun viewer.

    Args:
        kind: ``native`` opens a window. ``web`` serves a page that can only be opened on this
            machine.

    Raises:
        InputError: the viewer cannot be started on this machine.
    """
    import rerun as rr

    has_display, page_port, options = _has_display(), 0, []
    if kind == "native" and not has_display:
        raise InputError("--view native: there is no display here; use --view web.")
    try:
        port = _free_port(_VIEWER_PORT)
        if kind == "web":
            page_port = _free_port(_WEB_PORT)
            # Both options serve the page; --web-viewer also opens the browser.
            serve = "--web-viewer" if has_display else "--serve-web"
            options = [serve, f"--web-viewer-port={page_port}"]
        viewer = _start_viewer(port, options)
    except OSError as error:
        raise InputError(f"--view {kind}: no viewer can be started ({error}).") from error
    if kind == "web":
        atexit.register(viewer.kill)  # the user can close a window, but not this process
    deadline = time.monotonic() + _VIEWER_STARTS_S
    while not (_listens(port) and (not page_port or _listens(page_port))):
        if viewer.poll() is not None or time.monotonic() > deadline:
            viewer.kill()
            raise InputError(f"--view {kind}: the viewer does not start here; run without --view.")
        time.sleep(0.05)
    uri = f"rerun+http://127.0.0.1:{port}/proxy"
    address = f"http://localhost:{page_port}?url={uri}" if page_port else ""
    return Viewer(address, rr.GrpcSink(uri))


def _start_viewer(port: int, options: list[str]) -> subprocess.Popen[bytes]:
    """Start a viewer that listens only on this machine.

    The viewers that rerun's own functions start also listen on the network. The viewer is started
    in its own session, so that Ctrl-C ends the run but not the viewer.
    """
    command = [_executable(), "--bind=127.0.0.1", f"--port={port}", "--hide-welcome-screen"]
    command += options
    nothing = subprocess.DEVNULL
    return subprocess.Popen(
        command, stdin=nothing, stdout=nothing, stderr=nothing, start_new_session=True
    )


def _has_display() -> bool:
    return sys.platform != "linux" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def _executable() -> str:
    """Return the path of the viewer in the installed rerun package.

    The search path may contain another version of the viewer.
    """
    spec = find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec and spec.origin else Path()
    found = [path for name in ("rerun", "rerun.exe") if (path := folder / name).is_file()]
    return str(found[0]) if found else "rerun"


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _free_port(wanted: int) -> int:
    """Return the port ``wanted`` if it is free, otherwise any free port."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise OSError("no port is free")


def _guarded(
    method: Callable[Concatenate[RerunRecorder, _P], None],
) -> Callable[Concatenate[RerunRecorder, _P], None]:
    """Decorate a method so that an error in it ends the recording, but not the run.

    After the recording has ended, the method does nothing.
    """

    @functools.wraps(method)
    def call(self: RerunRecorder, *args: _P.args, **kwargs: _P.kwargs) -> None:
        if not self._open:
            return
        try:
            method(self, *args, **kwargs)
        except Exception as error:  # such as a full disk or a viewer that was closed
            self._abandon(error)

    return call


class RerunRecorder(Recorder):
    """Writes a ``.rrd`` file, or shows the same data in a viewer during the run.

    The timelines are ``frame`` (number of the frame) and ``time`` (seconds).

    These entities are recorded:

    - ``world/camera``: the pose of every frame;
    - ``world/camera/image``: images of keyframes at half size. Its children ``tracked`` and
      ``untracked`` are the keypoints;
    - ``world/camera/gravity``: an arrow along gravity, in the frame of the camera, for every frame
      at which it is known;
    - ``world/landmarks``, ``world/keyframes``: the map. It is recorded every 25 keyframes, after
      loops and at the end;
    - ``world/loops/accepted``: a green line for each closed loop;
    - ``world/loops/rejected``: a faint red line for each rejected loop. It is shown for 20 frames;
    - ``loops/images``: the two images of a closed loop with their matches, shown until the next
      loop;
    - ``world/ground_truth``: the whole ground truth, shown in every frame;
    - ``world/trajectory``: the final trajectory up to the frame that is shown;
    - ``points/*``: numbers of keypoints in every frame;
    - ``stage_ms/*``: milliseconds of each stage for every frame;
    - ``state``: changes of the tracking state;
    - ``state/loops``: each loop, with the reason why it was accepted or rejected.

    The world frame is that of the map, with x right, y down and z forward.

    A recording that cannot be written never ends a run. Rerun reports write errors only at a later
    flush, which may never return. Therefore, the recording ends with a warning in the log when the
    disk has less than 64 MB left. It also ends with a warning if a flush fails, if a flush takes
    longer than 5 s, or if the viewer was closed. In these cases, the last message in the file may
    be incomplete.
    """

    def __init__(self, target: Path | Viewer, pictures: Sequence[LoopPicture] = ()) -> None:
        """Open a file or connect to a viewer.

        An old recording is replaced. If the file cannot be opened or the viewer does not answer, a
        warning is logged and nothing is recorded.

        Args:
            pictures: pictures of closed loops. Another recorder, which is called before this one,
                appends them to this list during the run.
        """
        import rerun as rr

        self._path = target if isinstance(target, Path) else None
        self._name = str(self._path or "the viewer")
        self._pace = _VIEWER_PACE if self._path is None else _FILE_PACE
        self._recording = rr.RecordingStream("vslam")
        self._open = True
        self._state: TrackingState | None = None
        self._points: dict[str, tuple[int, int, int]] = {}  # colour of each curve of points/*
        self._index = 0  # index of the last frame
        self._frames: list[TrackResult] = []
        self._stages: list[str] = []  # stages that have a colour
        self._keyframes = 0
        self._mapped_keyframes = -self._pace.keyframes
        self._accepted: list[LoopEdge] = []
        self._pictures = pictures
        self._n_pictures = 0  # number of pictures recorded so far
        self._hide_rejected_at: int | None = None  # index of a frame
        self._ground_truth: Trajectory | None = None  # None after it was recorded
        self._T_mounted_camera = np.eye(4)
        self._arrow = 1.0  # length of the viewing pyramid and of the arrow along gravity
        try:
            # Otherwise, the time of logging would be the viewer's default timeline.
            self._recording.set_log_time_enabled(False)
            # This must precede the first log call, which would otherwise be lost.
            if isinstance(target, Path):
                self._recording.save(target)
            else:
                self._recording.set_sinks(target.sink)
        except (OSError, RuntimeError) as error:
            self._abandon(error)

    @_guarded
    def begin(self, camera: Camera, ground_truth: Trajectory | None) -> None:
        import rerun as rr

        log = functools.partial(self._recording.log, static=True)
        self._recording.send_blueprint(_blueprint())
        log("world", rr.ViewCoordinates.RDF)
        s, self._arrow = _IMAGE_SCALE, 4.0 * (camera.baseline or 0.5)
        pinhole = rr.Pinhole(
            focal_length=[s * camera.fx, s * camera.fy],
            principal_point=list(_half(np.array([camera.cx, camera.cy]))),
            resolution=[round(s * camera.width), round(s * camera.height)],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=self._arrow,
        )
        log("world/camera/image", pinhole)
        for name, color, radius in (("tracked", _GREEN, -2.0), ("untracked", _GREY, -1.0)):
            style = rr.Points2D.from_fields(colors=[color], radii=[radius])  # < 0: screen units
            log(f"world/camera/image/{name}", style)
        log("world/landmarks", rr.Points3D.from_fields(colors=[_GREY], radii=[-1.2]))
        usable = "features" if camera.monocular else "stereo"
        self._points = {usable: _GREY, "matches": _AMBER, "inliers": _BLUE}
        for name, color in self._points.items():
            log(f"points/{name}", rr.SeriesLines(colors=[color], names=[name]))
        log("world/camera/gravity", rr.Arrows3D.from_fields(colors=[_VIOLET], labels=["gravity"]))
        log("world/trajectory", rr.LineStrips3D.from_fields(colors=[_BLUE], radii=[-1.0]))
        self._ground_truth, self._T_mounted_camera = ground_truth, camera.T_mounted_camera

    @_guarded
    def frame(self, result: TrackResult) -> None:
        import rerun as rr

        # Frames are sent in columns. This is four times faster than a log call for each value.
        self._frames.append(result)
        self._index = result.index
        if len(self._frames) >= self._pace.frames:
            self._send_frames()
        self._set_time(result)
        self._record_ground_truth(result)
        if result.state != self._state:
            self._state = result.state
            text = f"{result.state} with {result.n_inliers} inliers"
            self._recording.log("state", rr.TextLog(text, color=_STATE_COLORS[result.state]))
        if self._hide_rejected_at is not None and result.index >= self._hide_rejected_at:
            self._recording.log("world/loops/rejected", rr.LineStrips3D([]))
            self._hide_rejected_at = None

    @_guarded
    def keyframe(self, result: TrackResult, image: Image, xy: NDArray, tracked: NDArray) -> None:
        import rerun as rr

        if self._path and shutil.disk_usage(self._path.parent).free < _RESERVED_BYTES:
            _log.warning("%s: recording ends here, because the disk is almost full.", self._name)
            self._close()
            return
        self._keyframes += 1
        self._set_time(result)
        half = cv2.resize(
            image, None, fx=_IMAGE_SCALE, fy=_IMAGE_SCALE, interpolation=cv2.INTER_AREA
        )
        jpeg = cv2.imencode(".jpg", half, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        path = "world/camera/image"
        self._recording.log(path, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        for name, chosen in (("tracked", tracked), ("untracked", ~tracked)):
            positions = _half(xy[chosen])
            self._recording.log(f"{path}/{name}", rr.Points2D.from_fields(positions=positions))

    @_guarded
    def map(self, map_: Map) -> None:
        if self._keyframes < self._mapped_keyframes + self._pace.keyframes:
            return
        self._log_map(map_, _MAX_POINTS_PER_MAP)
        self._flush()

    @_guarded
    def loops(self, edges: Collection[LoopEdge], map_: Map) -> None:
        import rerun as rr

        accepted = [edge for edge in edges if edge.accepted]
        rejected = [edge for edge in edges if not edge.accepted]
        if rejected:
            self._log_lines("rejected", rejected, map_, _FAINT_RED)
            self._hide_rejected_at = self._index + _REJECTED_SHOWN_FRAMES
        if accepted:
            self._accepted += accepted
            if self._keyframes >= self._mapped_keyframes + self._pace.corrected_keyframes:
                self._log_map(map_, _MAX_POINTS_PER_MAP)
            else:
                self._log_lines("accepted", self._accepted, map_, _GREEN)
        for edge in edges:
            color = _GREEN if edge.accepted else _GREY
            self._recording.log("state/loops", rr.TextLog(_description(edge, map_), color=color))
        self._log_pictures()

    @_guarded
    def finish(self, trajectory: Trajectory, map_: Map | None) -> None:
        if map_ is not None:
            self._log_map(map_, map_.n_landmarks)
        self._log_trajectory(trajectory)
        self._close()

    def _record_ground_truth(self, result: TrackResult) -> None:
        """Record the ground truth in the world frame of the run, at the first frame for which both
        a true and an estimated pose are known."""
        truth = self._ground_truth
        if truth is None or result.state in (TrackingState.LOST, TrackingState.DROPPED):
            return
        for T_true in truth.T_wc[truth.timestamps == result.timestamp]:
            T_wc = result.T_wc @ np.linalg.inv(T_true) @ truth.T_wc
            self._recording.log("world/ground_truth", _path(T_wc, _GREY), static=True)
            self._ground_truth = None

    def _log_trajectory(self, trajectory: Trajectory) -> None:
        """At each of a hundred frames, log the trajectory up to this frame, so that it grows."""
        import rerun as rr

        n = len(trajectory)
        if not n:
            return
        ends = np.unique(np.linspace(0, n - 1, min(n, _TRAJECTORY_STEPS)).round().astype(int))
        points = trajectory.T_wc[:, :3, 3].astype(np.float32)
        strips = rr.LineStrips3D.columns(strips=[points[: end + 1] for end in ends])
        times = [
            rr.TimeColumn("frame", sequence=ends),
            rr.TimeColumn("time", duration=trajectory.timestamps[ends]),
        ]
        self._recording.send_columns("world/trajectory", times, strips)

    def _set_time(self, result: TrackResult) -> None:
        self._recording.set_time("frame", sequence=result.index)
        self._recording.set_time("time", duration=result.timestamp)

    def _log_map(self, map_: Map, limit: int) -> None:
        import rerun as rr

        self._mapped_keyframes = self._keyframes
        landmarks = map_.living_landmarks()
        landmarks = landmarks[:: max(1, -(-len(landmarks) // max(1, limit)))]
        xyz = map_.arrays.xyz[landmarks].astype(np.float32)
        T_wc_keyframes = inverses(map_.arrays.T_cw[map_.living_keyframes()])
        self._recording.log("world/landmarks", rr.Points3D.from_fields(positions=xyz))
        self._recording.log("world/keyframes", _path(T_wc_keyframes, _AMBER))
        if self._accepted:
            self._log_lines("accepted", self._accepted, map_, _GREEN)

    def _log_lines(
        self, name: str, edges: list[LoopEdge], map_: Map, color: tuple[int, ...]
    ) -> None:
        """Log a line between the keyframes of each loop, unless the query is a lost frame."""
        import rerun as rr

        ends = [(edge.match, edge.query) for edge in edges if edge.query >= 0]
        poses = np.array([[map_.keyframe_pose(k) for k in pair] for pair in ends])
        centres = inverses(poses.reshape(-1, 4, 4))[:, :3, 3].reshape(-1, 2, 3).astype(np.float32)
        lines = rr.LineStrips3D(list(centres), colors=[color], radii=[-1.5])
        self._recording.log(f"world/loops/{name}", lines)

    def _log_pictures(self) -> None:
        import rerun as rr

        new = self._pictures[self._n_pictures :]
        self._n_pictures += len(new)
        for picture in new:
            image = rr.EncodedImage(contents=draw_picture(picture), media_type="image/jpeg")
            self._recording.log("loops/images", image)

    def _send_frames(self) -> None:
        import rerun as rr

        if not self._frames:
            return
        results, self._frames = self._frames, []
        # The images that are shown below the camera may be turned.
        T_wc = np.array([result.T_wc for result in results]) @ self._T_mounted_camera
        poses = rr.Transform3D.columns(translation=T_wc[:, :3, 3], mat3x3=T_wc[:, :3, :3])
        self._recording.send_columns("world/camera", _times(results), poses)
        fallen = [k for k, result in enumerate(results) if result.gravity is not None]
        if fallen:
            gravity = np.array([results[k].gravity for k in fallen]) / GRAVITY
            arrows = self._arrow * np.einsum("nji,nj->ni", T_wc[fallen, :3, :3], gravity)
            columns = rr.Arrows3D.columns(vectors=arrows)
            times = _times([results[k] for k in fallen])
            self._recording.send_columns("world/camera/gravity", times, columns)
        extracted = [result for result in results if result.n_features]
        for name in self._points:
            counted = results if name in ("matches", "inliers") else extracted
            counts = np.array([getattr(result, f"n_{name}") for result in counted], np.float64)
            scalars = rr.Scalars.columns(scalars=counts)
            self._recording.send_columns(f"points/{name}", _times(counted), scalars)
        for stage in dict.fromkeys(name for result in results for name in result.stage_ms):
            if stage not in self._stages:
                color = _STAGE_COLORS[len(self._stages) % len(_STAGE_COLORS)]
                self._stages.append(stage)
                line = rr.SeriesLines(colors=[color], names=[stage])
                self._recording.log(f"stage_ms/{stage}", line, static=True)
            timed = [result for result in results if stage in result.stage_ms]
            scalars = rr.Scalars.columns(scalars=[result.stage_ms[stage] for result in timed])
            self._recording.send_columns(f"stage_ms/{stage}", _times(timed), scalars)

    def _flush(self) -> None:
        self._send_frames()
        self._recording.flush(timeout_sec=_FLUSH_TIMEOUT_S)

    def _close(self) -> None:
        # Disconnect only after a successful flush, because disconnecting from a dead writer may
        # never return.
        self._flush()
        self._recording.disconnect()
        self._open = False

    def _abandon(self, error: Exception) -> None:
        import rerun as rr

        _log.warning("%s: recording ends here (%s).", self._name, reason(error))
        # When a stream is deleted, and when the process ends, rerun 0.41 waits forever for its dead
        # writer. Therefore, the stream is never deleted, and rerun's exit hook is removed.
        rr.unregister_shutdown()
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._recording))
        self._open = False


def _times(results: list[TrackResult]) -> list[Any]:
    import rerun as rr

    return [
        rr.TimeColumn("frame", sequence=[result.index for result in results]),
        rr.TimeColumn("time", duration=[result.timestamp for result in results]),
    ]


def _path(T_wc: NDArray[np.float64], color: tuple[int, int, int]) -> Any:
    import rerun as rr

    points = T_wc[:, :3, 3].astype(np.float32)
    return rr.LineStrips3D([points], colors=[color], radii=[-1.0])


def _description(edge: LoopEdge, map_: Map) -> str:
    query = f"frame {map_.frames[edge.query]}" if edge.query >= 0 else "a lost frame"
    evidence = f"{edge.n_inliers} inliers of {edge.n_matches} matches"
    by = f"proposed by {edge.proposed_by}, matched by {edge.matched_by} descriptors"
    return f"{query} to frame {map_.frames[edge.match]}: {edge.reason}, {evidence}, {by}"


def _half(xy: NDArray[np.floating]) -> NDArray[np.floating]:
    # The centre of the first pixel has the coordinate 0 in vslam and 0.5 in rerun.
    return (xy + 0.5) * _IMAGE_SCALE


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    scene = rrb.Spatial3DView(
        origin="world",
        contents=[
            "+ $origin/**",
            "- /world/camera/image/tracked",
            "- /world/camera/image/untracked",
        ],
        name="Map",
    )
    column = rrb.Vertical(
        rrb.Tabs(
            rrb.Spatial2DView(origin="world/camera/image", name="Keyframe"),
            rrb.Spatial2DView(origin="loops/images", name="Loop"),
        ),
        rrb.TimeSeriesView(origin="points", name="Tracked points"),
        rrb.TimeSeriesView(origin="stage_ms", name="Time per stage (ms)"),
        rrb.TextLogView(origin="state", name="State"),
        row_shares=[4, 3, 3, 2],
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene, column, column_shares=[3, 2]),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        collapse_panels=True,
    )
