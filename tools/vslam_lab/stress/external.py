"""Runs other SLAM systems on perturbed images.

The command of a system is a template with the placeholders ``{folder}`` and ``{out}``. The folder
at ``{folder}`` is in KITTI's format. It contains ``image_0``, ``calib.txt`` and ``times.txt`` of
the perturbed frames, without dropped frames and frames with an unreadable image. For a stereo
camera, it also contains the right images in ``image_1``. For an RGB-D camera, it contains depth
images in ``depth``. They have 16 bits and give the depth in millimetres, with 0 where it is unknown
or above 65.5 m. The command must write these files into the folder at ``{out}``:

- ``trajectory.txt`` contains the estimated poses. It has either one pose per frame in KITTI's
  format, or poses with times in TUM's format.
- ``causal.txt`` (optional) contains the poses as they were first estimated, in the same format.
- ``states.txt`` (optional) contains ``OK`` or ``LOST`` for each frame.
- ``costs.json`` (optional) contains the seconds that the frame loop took, for example
  ``{"wall_s": 12.5, "cpu_s": 20.1}``. Without it, the wall time is that of the whole command, and
  the CPU time is 0.
"""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.frames import Source
from vslam.datasets.perturbation import Perturbation, perturbed
from vslam.report.folder import write_results
from vslam.report.schema import ReportJson
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.support.errors import DroppedFrameError, InputError, ResultsError, UnreadableImageError
from vslam.types.camera import Camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.trajectory import Trajectory, bridge_gaps, read_trajectory
from vslam_lab.towns.store import calibration_text

_SAME_TIME_S = 1e-3


@dataclass(frozen=True)
class Poses:
    """The ``(N, 4, 4)`` poses ``T_wc`` of N frames, and an ``(N,)`` mask of the known poses."""

    T_wc: NDArray[np.float64]
    known: NDArray[np.bool_]

    def bridged(self, times: NDArray[np.float64]) -> Trajectory:
        """Return the trajectory of the N frames, in which unknown poses are interpolated."""
        return bridge_gaps(Trajectory(times, self.T_wc), self.known)


def check_template(name: str, template: str) -> None:
    """Check the command template of a SLAM system.

    Raises:
        InputError: a placeholder is missing or unknown, or the template cannot be split into words.
    """
    try:
        filled = template.format(folder="F", out="O")
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise InputError(
            f"--system {name}={template}: unknown placeholder {error}; use {{folder}} and {{out}}."
        ) from error
    try:
        shlex.split(filled)
    except ValueError as error:
        raise InputError(
            f"--system {name}={template}: cannot be split into words ({error}); quote it as in "
            "a shell."
        ) from error
    if "{folder}" not in template or "{out}" not in template:
        raise InputError(
            f"--system {name}={template}: must contain {{folder}} and {{out}} "
            "(docs/howto/stress.md)."
        )


def run_external(
    sequence: Source,
    perturbation: Perturbation,
    settings: RunOptions,
    template: str,
    folder: Path,
) -> ReportJson:
    """Run another SLAM system on a perturbed sequence, and evaluate its trajectory.

    ``report.json`` and the trajectories are written into ``folder``. Loops are not evaluated,
    because other systems do not report them.

    Args:
        template: command of the system, with ``{folder}`` and ``{out}``.

    Raises:
        InputError: the system exits with an error, writes no trajectory, or writes a malformed
            file.
    """
    with tempfile.TemporaryDirectory(prefix="kitti.", dir=folder) as name:
        work = Path(name)
        out = work / "out"
        out.mkdir()
        kept, unreadable = export_kitti(sequence, perturbation, work / "sequence")
        start = time.perf_counter()
        call(template, work / "sequence", out)
        wall = time.perf_counter() - start
        outcome = _outcome(sequence, settings, kept, unreadable, out, wall)
    report = write_results(folder, outcome, pages=False)
    report = report.model_copy(
        update={"loops_found": None, "loops_missed": None, "loops_wrong": None}
    )
    (folder / "report.json").write_text(report.to_json(), encoding="utf-8")
    return report


def export_kitti(
    sequence: Source, perturbation: Perturbation, folder: Path
) -> tuple[NDArray[np.int64], dict[int, str]]:
    """Write the perturbed frames of a sequence in KITTI's format, with the depth if there is any.

    Dropped frames and frames with an unreadable image are left out.

    Returns:
        The indices of the written frames, and the error message of each frame with an unreadable
        image by the index of the frame.
    """
    times: list[float] = []
    kept: list[int] = []
    unreadable: dict[int, str] = {}
    names = {"stereo": ["image_0", "image_1"], "rgbd": ["image_0", "depth"]}.get(
        sequence.camera.sensor, ["image_0"]
    )
    for name in names:
        (folder / name).mkdir(parents=True)
    frames = perturbed(sequence.frames(), perturbation.bound_to(sequence))
    with ThreadPoolExecutor(len(names)) as pool:
        for index, frame in enumerate(frames):
            try:
                images = frame.read(pool.map)
            except DroppedFrameError:
                continue
            except UnreadableImageError as error:
                unreadable[index] = str(error)
                continue
            paths = [folder / name / f"{len(kept):06d}.png" for name in names]
            tuple(pool.map(_write_image, paths, images))
            kept.append(index)
            times.append(frame.timestamp - float(sequence.timestamps[0]))
    (folder / "times.txt").write_text("".join(f"{t:.9e}\n" for t in times))
    (folder / "calib.txt").write_text(calibration_text(sequence.camera))
    return np.array(kept, np.int64), unreadable


def _write_image(path: Path, image: NDArray[Any] | None) -> None:
    import cv2

    assert image is not None
    pixels = image if image.dtype == np.uint8 else _millimetres(image)
    if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise ResultsError(f"{path}: cannot be written; is the disk full?")


def _millimetres(depth: NDArray[np.generic]) -> NDArray[np.uint16]:
    rounded = np.rint(1000.0 * np.nan_to_num(depth, posinf=0.0))
    return np.where((rounded > 0) & (rounded < 2**16), rounded, 0).astype(np.uint16)


def call(template: str, sequence: Path, out: Path) -> None:
    """Run the command of another SLAM system on a folder in KITTI's format.

    Args:
        template: the command, with ``{folder}`` and ``{out}``.

    Raises:
        InputError: the command cannot be started, crashes or exits with an error.
    """
    words = shlex.split(
        template.format(folder=shlex.quote(str(sequence)), out=shlex.quote(str(out)))
    )
    try:
        # When this process ends, the standard input of the system is closed. The system can then
        # end, too.
        with subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        ) as child:
            assert child.stdout is not None
            log = child.stdout.read()
            code = child.wait()
    except OSError as error:
        raise InputError(f"{words[0]}: cannot be started ({error.strerror}).") from error
    program = Path(words[0]).name
    if code < 0:
        raise InputError(f"{program}: crashed ({signal.Signals(-code).name})")
    if code:
        lines = [line for line in log.splitlines() if line.strip()]
        raise InputError(f"{program}: exit code {code}: {lines[-1] if lines else 'no output'}")


def _outcome(
    sequence: Source,
    settings: RunOptions,
    kept: NDArray[np.int64],
    unreadable: dict[int, str],
    out: Path,
    wall: float,
) -> RunOutcome:
    if not (out / "trajectory.txt").is_file():
        raise InputError(f"{settings.detector}: wrote no trajectory.txt into {{out}}.")
    times = np.asarray(sequence.timestamps, np.float64)
    final = _as_mounted(read_poses(out / "trajectory.txt", times, kept), sequence.camera)
    causal = final
    if (out / "causal.txt").is_file():
        causal = _as_mounted(read_poses(out / "causal.txt", times, kept), sequence.camera)
    lost = ~final.known
    if (out / "states.txt").is_file():
        states = (out / "states.txt").read_text().split()
        if len(states) != len(kept):
            raise InputError(
                f"{settings.detector}: states.txt has {len(states)} states for {len(kept)} frames."
            )
        lost[kept] |= np.array(states) != "OK"
    dropped = np.ones(len(times), bool)
    dropped[[*kept, *unreadable]] = False
    trajectory = final.bridged(times)
    given = np.where(causal.known[:, None, None], causal.T_wc, _last_known(causal))
    wall, cpu = _costs(out / "costs.json", settings.detector) or (wall, 0.0)
    tracks = [
        TrackResult(
            k, float(times[k]), given[k],
            TrackingState.DROPPED if dropped[k] else
            TrackingState.LOST if lost[k] else TrackingState.OK,
            0, 0, 0, 0, False,
        )
        for k in range(len(times))
    ]  # fmt: skip
    return RunOutcome(
        settings=settings,
        sequence=sequence,
        trajectory=trajectory,
        keyframes=Trajectory(times[:0], trajectory.T_wc[:0]),
        tracks=tracks,
        skipped=[f"frame {index}: {message}" for index, message in unreadable.items()],
        wall_s=wall,
        cpu_s=cpu,
        startup_s=0.0,
        peak_memory_mb=0.0,
        n_keyframes=0,
        n_landmarks=0,
        n_submaps=0,
    )


def _costs(path: Path, system: str) -> tuple[float, float] | None:
    """Read the wall and CPU seconds of the frame loop. Return None if there is no such file."""
    try:
        costs = json.loads(path.read_bytes())
        return float(costs["wall_s"]), float(costs["cpu_s"])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f'{system}: {path.name} is malformed; write {{"wall_s": 12.5, "cpu_s": 20.1}}.'
        ) from error


def read_poses(path: Path, times: NDArray[np.float64], kept: NDArray[np.int64]) -> Poses:
    """Read the poses that another SLAM system wrote.

    An unknown pose is replaced with the last known pose before it. If there is none, the first
    known pose is used.

    Args:
        path: file in KITTI's or TUM's format.
        times: ``(N,)`` times of the frames in seconds.
        kept: indices of the frames that the system received.

    Raises:
        InputError: the file is malformed.
    """
    T_wc, known = np.tile(np.eye(4), (len(times), 1, 1)), np.zeros(len(times), bool)
    try:
        found = read_trajectory(path, times[kept] - times[0])
    except InputError as error:
        if path.read_text().strip():
            raise InputError(str(error).replace(str(path), path.name)) from error
        return Poses(T_wc, known)
    for t, pose in zip(found.timestamps, found.T_wc, strict=True):
        k = int(np.abs(times - times[0] - t).argmin())
        if abs(times[k] - times[0] - t) < _SAME_TIME_S:
            T_wc[k], known[k] = pose, True
    if known.any():
        T_wc = _last_known(Poses(T_wc, known))
    return Poses(T_wc, known)


def _as_mounted(poses: Poses, camera: Camera) -> Poses:
    """Convert the poses of a system that was given turned images (``Camera.quarter_turns``)."""
    return Poses(camera.as_mounted(poses.T_wc), poses.known)


def _last_known(poses: Poses) -> NDArray[np.float64]:
    """Replace each unknown pose with the last known pose before it, or else the first known one."""
    if not poses.known.any():
        return poses.T_wc
    at = np.where(poses.known, np.arange(len(poses.known)), -1)
    at = np.maximum.accumulate(at)
    return poses.T_wc[np.where(at < 0, int(np.flatnonzero(poses.known)[0]), at)]
