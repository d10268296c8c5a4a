"""Injection of faults: each part of a run fails once, at a call that is drawn from a seed.

The simulated camera moves along a ring of points (tests/ring.py). Its images only encode the index
of the frame, from which the features are computed. Therefore, a lap with a closed loop, lost frames
and all results takes only two seconds.

Each injection runs the entry point of the command line in a fork of a process that has loaded
everything. ``inject`` judges the messages and files of the run.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import importlib
import json
import os
import random
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ring import CAMERA, LAP, Oracle, Ring

from vslam.config import Config
from vslam.datasets.frames import Images, Source, TimedFrame
from vslam.maps.storage import load_map
from vslam.run.autosave import MAP, PROGRESS
from vslam.run.progress import read_progress
from vslam.slam import Slam
from vslam.types.camera import ImageMap
from vslam.types.features import Extracted, Features
from vslam.types.geometry import inverse
from vslam.types.trajectory import read_trajectory, write_kitti

RING = Ring.create(focal_error=0.015)  # odometry drifts, so that the loop has an error to correct
FRAMES = LAP + 31
DARK = range(60, 63)  # frames without features; tracking is lost there and relocalises afterwards
PATIENCE_S = 60.0
FAULTS: dict[str, Callable[[], Exception]] = {
    "RuntimeError": lambda: RuntimeError("injected"),
    "MemoryError": lambda: MemoryError("injected"),
    "disk full": lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
}
# The expected outcomes of a run. ON: the run continues to the end without the part that failed.
# EARLY: it ends early with all results of the processed frames. MAPLESS: it ends early without a
# map. MISSING: one result is missing, but all others exist. REFUSED: it cannot start.
ON, EARLY, MAPLESS, MISSING, REFUSED = "goes on", "ends early", "no map", "one missing", "refused"
EXIT_CODES = {ON: 0, EARLY: 1, MAPLESS: 1, MISSING: 1, REFUSED: 1}


@dataclass(frozen=True)
class Point:
    """A point at which a run may fail.

    Attributes:
        name: name of the part that fails.
        function: dotted path of the function, as it is looked up when the function is called.
        last_call: number of calls from which the failing call is drawn.
        expected: one of the outcomes above.
        costs: results that may be missing.
        options: additional words of the command line.
    """

    name: str
    function: str
    last_call: int
    expected: str
    costs: tuple[str, ...] = ()
    options: tuple[str, ...] = ()


REALTIME = ("--realtime", "--max-frames", "12")
LATER = ("report.json", "report.md", "report.html", "figures")  # written after all other results
POINTS = (
    Point("a frame's track", "vslam.frontend.tracker.Tracker.track", 200, EARLY),
    Point("keyframe policy", "vslam.method.modes.Building.update_map", 200, EARLY),
    Point("publishing a keyframe", "vslam.method.published_map.PublishedMap.renew_view", 8, EARLY),
    Point("place detector, locate", "ring.Oracle.locate", 2, EARLY),
    Point("place detector, add", "ring.Oracle.add", 12, ON),
    Point("place detector, query", "ring.Oracle.query", 12, ON),
    Point("verification", "vslam.loopclosure.verification.verify", 1, ON),
    Point("learned verification", "vslam.loopclosure.verifier.with_similarities", 1, ON),
    Point("pose graph", "vslam.method.closing.solve", 1, ON),
    Point("inserting a keyframe", "vslam.method.mapping.map_stereo_points", 12, MAPLESS),
    Point("mapping job", "vslam.method.mapping.refine_and_calibrate", 12, MAPLESS),
    Point("start of a job", "vslam.method.shared_map.SharedMap.start", 12, MAPLESS),
    Point("closing job, correction", "vslam.method.closing.move_keyframes", 1, MAPLESS),
    Point("closing job, fusion", "vslam.method.closing.fuse_loop", 1, MAPLESS),
    Point("global adjustment, snapshot", "vslam.method.closing.take_snapshot", 1, ON),
    Point("global adjustment", "vslam.method.closing.adjust_globally", 1, ON),
    Point("global adjustment, merge", "vslam.method.closing.apply_solution", 1, MAPLESS),
    Point("image source", "faults.next_image", 200, EARLY),
    Point("image reader", "faults.read_image", 200, EARLY),
    Point("features thread", "vslam.frontend.extraction.find_corners", 200, EARLY),
    Point("camera thread", "vslam.run.preparation._Mailbox.put", 8, EARLY, options=REALTIME),
    Point("handing thread", "vslam.run.preparation._Mailbox.take", 8, EARLY, options=REALTIME),
    Point("progress of a frame", "faults.on_frame", 200, EARLY),
    Point("autosave, pose", "vslam.run.autosave.tum_line", 200, ON, ("trajectory_online.tum",)),
    Point("autosave, copy", "vslam.run.autosave._copy", 2, ON),
    Point("autosave, progress", "vslam.run.autosave.write_progress", 2, ON),
    Point("autosave, map", "vslam.run.autosave.save_map", 2, ON),
    Point("recorder, frames", "vslam.run.recorder.RerunRecorder._send_frames", 4, ON),
    Point("recorder, map", "vslam.run.recorder.RerunRecorder._log_map", 2, ON),
    Point("recorder, loop picture", "vslam.run.recorder.draw_picture", 1, ON),
    Point("moments", "vslam.run.moments._moment", 12, ON),
    Point("loop pictures", "vslam.run.moments.loop_matches", 1, ON),
    Point("closing the map", "vslam.method.closing.LoopClosing.conclude", 1, MAPLESS),
    Point("final trajectory", "vslam.method.published_map.PublishedMap.trajectory", 1, EARLY),
    Point("check of the rig", "vslam.run.slam_run.measure_offset", 1, ON),
    Point("result: KITTI poses", "vslam.report.folder.write_kitti", 1, MISSING,
          ("trajectory_kitti.txt",)),
    Point("result: TUM poses", "vslam.report.folder.write_tum", 1, MISSING, ("trajectory.tum",)),
    Point("result: ground truth", "vslam.run.outcome.ground_truth_of", 1, MISSING,
          ("ground_truth_kitti.txt",)),
    Point("result: evaluation", "vslam.report.folder.evaluate_run", 1, MISSING),
    Point("result: world", "vslam.report.folder.truth_alignment_of", 1, MISSING),
    Point("result: map", "vslam.report.folder.save_map", 1, MISSING, ("map.npz",)),
    Point("result: frames.csv", "vslam.report.folder.write_frames", 1, MISSING, ("frames.csv",)),
    Point("result: loops", "vslam.report.folder.evaluate_loops", 1, MISSING, LATER),
    Point("result: report.json", "vslam.report.folder.summarize", 1, MISSING, LATER),
    Point("result: figures", "vslam.report.figures.draw_figures", 1, MISSING, ("figures",)),
    Point("result: seen loops", "vslam.report.loop_tables.seen_loops", 1, MISSING, ("figures",)),
    Point("result: report.md", "vslam.report.render.markdown", 1, MISSING, ("report.md",)),
    Point("result: page", "vslam.report.render.html", 1, MISSING, ("report.html",)),
    Point("result: explorer", "vslam.report.explorer.explorer_data", 1, MISSING, ("report.html",)),
    Point("warm-up of the kernels", "vslam.run.warmup.Compilation.finish", 1, REFUSED),
    Point("run.json", "vslam.run.options.write_options", 1, REFUSED),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """The outcome of an injection.

    Attributes:
        call: number of the call that failed.
        exit_code: exit code of the process; -1 if the process hung and was killed.
        said: lines that the process wrote to stderr.
        found: results that were on the disk.
        wrong: differences from the expected outcome; empty if there are none.
    """

    point: str
    fault: str
    call: int
    exit_code: int
    said: str
    found: str
    wrong: str


def next_image() -> None:
    """Is called before the source yields a frame."""


def read_image() -> None:
    """Is called before a frame is read."""


def on_frame() -> None:
    """Is called when a frame has been processed."""


def failing(
    point: Point,
    call: int,
    fault: Callable[[], Exception],
    set_attribute: Callable[[Any, str, Any], None] = setattr,
) -> None:
    """Make exactly one of the next calls of a function raise an error."""
    owner, name = _owner(point.function)
    function = getattr(owner, name)
    calls, lock = [0], threading.Lock()

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        with lock:
            calls[0] += 1
            now = calls[0] == call
        if now:
            raise fault()
        return function(*args, **kwargs)

    set_attribute(owner, name, wrapped)


def _owner(path: str) -> tuple[Any, str]:
    """Return the owner of the attribute at the end of a dotted path, and the attribute's name."""
    parts = path.split(".")
    for n in range(len(parts) - 1, 0, -1):
        with contextlib.suppress(ModuleNotFoundError):
            owner = importlib.import_module(".".join(parts[:n]))
            for part in parts[n:-1]:
                owner = getattr(owner, part)
            return owner, parts[-1]
    raise ModuleNotFoundError(path)


def write_ring(root: Path) -> None:
    """Write a KITTI sequence whose images encode the index of the frame."""
    folder = root / "sequences" / "00"
    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True)
    image = np.full((CAMERA.height, CAMERA.width), 128, np.uint8)
    for k in range(FRAMES):
        image[0, :2] = k & 255, k >> 8
        for side in ("image_0", "image_1"):
            assert cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    c = CAMERA
    lines = []
    for side in range(4):
        numbers = [c.fx, 0, c.cx, -c.bf * (side % 2), 0, c.fy, c.cy, 0, 0, 0, 1, 0]
        lines.append(f"P{side}: " + " ".join(f"{x:.12e}" for x in numbers) + "\n")
    (folder / "calib.txt").write_text("".join(lines))
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(FRAMES)))
    (root / "poses").mkdir()
    T_0 = inverse(RING.pose(0))
    write_kitti(root / "poses" / "00.txt", np.array([T_0 @ RING.pose(k) for k in range(FRAMES)]))


def stage(*, learned: bool) -> None:
    """Replace the features and the detector of this process with those of the ring.

    The contents of the images do not matter. If ``learned`` is set, learned descriptors may verify
    the loops.
    """
    from vslam.cli.console import Console
    from vslam.frontend import extraction
    from vslam.loopclosure.registry import create_images
    from vslam.run import pipeline

    def find(left: np.ndarray, *_: object) -> extraction.Corners:
        return extraction.Corners(left)

    def see(corners: extraction.Corners, *_: object) -> Extracted:
        left = corners.found
        return Extracted(view(int(left[0, 0]) | int(left[0, 1]) << 8))

    def detector(*_: object, **__: object) -> tuple[Oracle, object]:
        images = create_images("both", Config()) if learned else None
        return Oracle(RING, [float(k) for k in range(FRAMES)]), images

    def frames(source: Source) -> Iterator[TimedFrame]:
        for frame in source.stored:
            next_image()
            yield replace(frame, read=partial(read, frame))

    def read(frame: TimedFrame, image_map: ImageMap) -> Images:
        read_image()
        return frame.read(image_map)

    @contextlib.contextmanager
    def progress_bar(console: Console, total: object) -> Iterator[Callable[[object], None]]:
        yield lambda result: on_frame()

    extraction.find_corners, extraction.matched = find, see
    pipeline.detector_with_images = detector
    Source.frames = frames
    Console.progress_bar = progress_bar


@cache
def view(k: int) -> Features:
    return Features.none() if k in DARK else RING.see(float(k), 1)


def load_everything() -> None:
    """Load the modules, kernels and features that forks need.

    No threads are started, because a fork would not have them.
    """
    from vslam.cli import main  # noqa: F401
    from vslam.report import explorer, figures, loop_tables, render  # noqa: F401

    cv2.setNumThreads(1)
    detector = Oracle(RING, [float(k) for k in range(FRAMES)])
    slam = Slam(CAMERA, None, detector, threads=1)
    for k in range(FRAMES):
        image = np.array([[k & 255, k >> 8]], np.uint8)
        slam.step_features(Extracted(view(k)), 0.1 * k, image)
    slam.finish()
    assert slam.corrections, "no loop was closed: nothing would be tested"


def run_in_fork(
    words: list[str], log: Path, fault: Callable[[], None], *, learned: bool = False
) -> int:
    """Run ``vslam`` in a fork of this process, after ``fault`` was called there.

    Args:
        log: file to which stderr is written.

    Returns:
        The exit code; -1 if the process had to be killed.
    """
    child = os.fork()
    if child == 0:
        code = 99
        with contextlib.suppress(BaseException):
            code = _run(words, log, fault, learned=learned)
        os._exit(code)
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1


def _run(words: list[str], log: Path, fault: Callable[[], None], *, learned: bool) -> int:
    from vslam.cli.main import main

    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    stage(learned=learned)
    fault()
    sys.argv = ["vslam", *words]
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    except BaseException:
        traceback.print_exc()
        code = 1
    threading._shutdown()  # Python does the same when it exits, and may then wait forever
    atexit._run_exitfuncs()
    sys.stderr.flush()
    return code


def inject(root: Path, work: Path, point: Point, fault: str, seed: int, whole: bytes) -> Row:
    """Make a point fail in a run, and resume the run if that is possible.

    Args:
        root: folder that ``write_ring`` wrote.
        work: a new folder to which the run writes.
        whole: ``trajectory.tum`` of the undisturbed run.
    """
    call = random.Random(f"{seed} {point.function} {fault}").randint(1, point.last_call)
    out, log = work / "runs", work / "log"
    words = ["run", "--data", str(root), "--quiet", "--autosave", "0.3", "--out", str(out)]
    if not point.function.startswith("vslam.run.recorder"):
        words.append("--no-record")
    pages = fault == "RuntimeError" or point.function.startswith(("vslam.report", "vslam.run"))
    if not pages:  # drawing the figures would take longer than the run
        words.append("--no-report")
    learned = point.function.startswith("vslam.loopclosure.verifier")
    make = FAULTS[fault]
    code = run_in_fork(
        [*words, *point.options], log, lambda: failing(point, call, make), learned=learned
    )
    said = [line for line in log.read_text().splitlines() if line.strip()]
    folder = out / "latest"
    wrong = [*_wrong_words(point, code, said, make())]
    found = "nothing"
    if point.expected != REFUSED:
        try:
            found, missing = _look(point, folder, whole, RESULTS if pages else RESULTS[:-3])
            wrong += missing
        except Exception as error:
            wrong.append(f"cannot be loaded: {error!r}")
    if (folder / MAP).exists() and point.expected != MISSING:
        again = ["run", "--resume", str(folder), "--quiet", "--no-record", "--no-report"]
        code_again = run_in_fork(again, log, lambda: None)
        if code_again != 0:
            wrong.append(f"--resume ends with {code_again}: {log.read_text()}")
        else:
            same = (folder / "trajectory.tum").read_bytes() == whole
            found += ", resumed to the same bytes" if same else ", resumed"
    elif point.expected == EARLY and not found.startswith((f"{FRAMES} ", "0 ")):
        wrong.append("nothing to resume from")
    short = " | ".join(said).replace(str(folder.resolve()), "RUN").replace(str(folder), "RUN")
    return Row(point.name, fault, call, code, short, found, "; ".join(wrong))


def _wrong_words(point: Point, code: int, said: list[str], fault: Exception) -> Iterator[str]:
    if code != EXIT_CODES[point.expected]:
        yield "hangs" if code == -1 else f"exit code {code}"
    if any("Traceback" in line for line in said):
        yield "a traceback"
    if len(said) != 1:
        yield f"{len(said)} lines on stderr"
    if not any((getattr(fault, "strerror", None) or str(fault)) in line for line in said):
        yield "does not say what failed"


RESULTS = (
    "trajectory_online.tum", "trajectory_kitti.txt", "trajectory.tum", "ground_truth_kitti.txt",
    "keyframes.tum", "trajectory_causal.tum", "trajectory_odom.tum", "covariance.csv", "map.npz",
    "frames.csv", "config.json", "report.json", "report.md", "report.html", "figures",
)  # fmt: skip


def _look(
    point: Point, folder: Path, whole: bytes, results: tuple[str, ...]
) -> tuple[str, list[str]]:
    """Load all results of a run. Return the results that exist, and what is wrong with them."""
    costs = (*point.costs, *(["map.npz"] if point.expected == MAPLESS else []))
    wrong = [f"no {name}" for name in results if name not in costs and not (folder / name).exists()]
    wrong += [f"a useless {path.name}" for path in folder.glob(".*.part")]
    lengths = {
        name: len(read_trajectory(path).T_wc) if path.stat().st_size else 0
        for name in ("trajectory.tum", "trajectory_causal.tum", "trajectory_online.tum")
        if (path := folder / name).exists()
    }
    frames = (
        len((folder / "frames.csv").read_text().splitlines()) - 1
        if "frames.csv" not in costs
        else lengths["trajectory.tum"]
    )
    complete = point.expected in (ON, MISSING)
    if complete and frames != FRAMES:
        wrong.append(f"{frames} of {FRAMES} frames")
    wrong += [
        f"{name} has {n} of {frames} poses"
        for name, n in lengths.items()
        if n != frames and name not in costs
    ]
    spared = complete and point.function.startswith("vslam.run.")
    if spared and (folder / "trajectory.tum").read_bytes() != whole:
        wrong.append("another trajectory")
    if (folder / "report.json").exists():
        interrupted = json.loads((folder / "report.json").read_text())["interrupted"]
        if (interrupted is None) != complete:
            wrong.append(f"the report says: interrupted {interrupted}")
    found = [f"{frames} frames"]
    if (folder / "map.npz").exists():
        found.append(f"map of {len(load_map(folder / 'map.npz').map.living_keyframes())} keyframes")
    if (folder / MAP).exists():
        saved, progress = load_map(folder / MAP).frames, read_progress(folder / PROGRESS)
        assert saved is not None
        assert len(progress.tracks) >= len(saved.timestamp)
        found.append(f"autosave of {len(saved.timestamp)} frames")
    found.append(f"{sum((folder / name).exists() for name in results)} of {len(results)} results")
    return ", ".join(found), wrong
