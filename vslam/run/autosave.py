"""Saves the state of a run at intervals, so that a killed run loses at most a minute of work.

The pose of each frame is appended to ``trajectory_online.tum`` as a line. At intervals, the map is
copied between two frames, if possible while no keyframe is being mapped. A thread then writes two
files. ``autosave_progress.npz`` contains the data that the report needs about the frames processed
so far. ``autosave.npz`` contains the map and is an ordinary map file. If a run is killed between
these two writes, the saved progress contains a few frames more than the saved map. When the run is
resumed, these frames are tracked again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

from vslam.maps.new_output import replaced_file
from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap
from vslam.run.progress import Progress, read_progress, write_progress
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.support.lock_file import locked
from vslam.types.features import TrackResult
from vslam.types.trajectory import tum_line

MAP, PROGRESS, ONLINE = "autosave.npz", "autosave_progress.npz", "trajectory_online.tum"
LOCK = ".lock"
_DUE = 0.75  # share of the period after which saving is due; the rest is for writing
_DUE_WHILE_ADJUSTING = 0.95  # the same while a global bundle adjustment is running
_MOST_MISSED = 5  # frames for which saving is postponed because a keyframe is being mapped

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Unfinished:
    """The saved state of an interrupted run: a map file, and the progress up to the same frame."""

    map: Path
    progress: Progress


@contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Lock the folder of a run, so that no other process resumes the run while it is in progress.

    If the lock cannot be created, for example on a full disk, the run continues without a lock.

    Raises:
        InputError: another process is performing a run in the folder.
    """
    with ExitStack() as lock:
        with suppress(OSError):
            lock.enter_context(locked(folder / LOCK, folder, "is still running here"))
        yield


def find_unfinished(folder: Path) -> Unfinished:
    """Read the saved state of an interrupted run, from which the run can be resumed.

    The resumed run tracks the frames after the saved state again. Therefore, this function removes
    the poses of these frames from ``trajectory_online.tum``.

    Raises:
        InputError: nothing was saved, or a file is damaged.
    """
    file = folder / MAP
    if not file.is_file():
        raise InputError(f"{folder}: has no {MAP}; nothing was saved yet, or the run is finished.")
    frames = load_map(file).frames
    progress = read_progress(folder / PROGRESS)
    if frames is None or len(frames.timestamp) > len(progress.tracks):
        raise InputError(f"{folder}: {PROGRESS} is older than {MAP}; there is nothing to resume.")
    _keep_poses(folder / ONLINE, len(frames.timestamp))
    return Unfinished(file, progress.until(len(frames.timestamp)))


def _keep_poses(path: Path, frames: int) -> None:
    with suppress(OSError):
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)[:frames]
        with replaced_file(path) as file:
            file.write("".join(lines).encode())


class Autosave:
    """Interface for saving a run at intervals. This base class saves nothing."""

    def frame(self, result: TrackResult) -> None:
        """Append the pose of a frame to the trajectory file. Call this for every frame in order."""

    def offer(self, slam: Slam, progress: Callable[[], Progress]) -> None:
        """Save the run if the next save is due. Call this after ``frame``."""

    def close(self, slam: Slam, progress: Callable[[], Progress], *, resumable: bool) -> None:
        """End the saving of a run.

        Args:
            resumable: whether the run ended early with a complete map, so that it can be resumed.
        """


NO_AUTOSAVE = Autosave()


class FolderAutosave(Autosave):
    """Saves the state of a run into the folder of the run.

    If writing fails, for example on a full disk, one warning is logged and the run continues. The
    next save is attempted as usual.
    """

    def __init__(self, folder: Path, seconds: float, drive: str) -> None:
        """Prepare to save the state of a run.

        Args:
            seconds: seconds between two saved maps. If the value is 0, no map is saved.
            drive: name of the drive in the map file.
        """
        self._folder, self._seconds, self._drive = folder, seconds, drive
        self._last = time.monotonic()
        self._writer = ThreadPoolExecutor(1, "autosave")
        self._writing: Future[None] | None = None
        self._missed = 0  # frames that ended during mapping since saving was due
        self._warned: set[str] = set()
        self._online: TextIO | None = None
        try:
            self._online = (folder / ONLINE).open("a", encoding="utf-8")
        except OSError as error:
            self._warn(ONLINE, error)

    def frame(self, result: TrackResult) -> None:
        if self._online is None:
            return
        try:
            self._online.write(tum_line(result.timestamp, result.T_wc))
            self._online.flush()
        except Exception as error:  # a failure to save must not end the run
            self._warn(ONLINE, error)
            self._online = None

    def offer(self, slam: Slam, progress: Callable[[], Progress]) -> None:
        waited = time.monotonic() - self._last
        if not self._seconds or waited < _DUE * self._seconds:
            return
        if slam.is_mapping and self._missed < _MOST_MISSED:
            self._missed += 1
            return
        if slam.is_adjusting and waited < _DUE_WHILE_ADJUSTING * self._seconds:
            return
        if self._writing is None or self._writing.done():
            self._save(slam, progress)

    def close(self, slam: Slam, progress: Callable[[], Progress], *, resumable: bool) -> None:
        if self._seconds and resumable:
            self._save(slam, progress)
        self._writer.shutdown()
        if self._online is not None:
            with suppress(OSError):
                self._online.close()

    def _save(self, slam: Slam, progress: Callable[[], Progress]) -> None:
        self._last, self._missed = time.monotonic(), 0
        stored, done = slam.stored_map(self._drive), progress()
        frames, n_done = stored.frames, len(done.tracks)
        if frames is not None and len(frames.timestamp) > n_done:
            # A step that failed has already added its frame. This frame must be tracked again.
            stored = replace(stored, frames=frames.until(n_done), checkpoint=None)
        try:
            self._writing = self._writer.submit(self._write, _copy(stored), done)
        except Exception as error:  # there is no memory for a copy, or no thread
            self._warn(MAP, error)

    def _write(self, stored: StoredMap, progress: Progress) -> None:
        try:
            write_progress(self._folder / PROGRESS, progress)
            save_map(self._folder / MAP, stored, resumable=True)
        except Exception as error:
            self._warn(MAP, error)

    def _warn(self, name: str, error: Exception) -> None:
        if name not in self._warned:
            self._warned.add(name)
            _log.warning(
                "%s: cannot be written (%s); the run continues without it.",
                self._folder / name,
                getattr(error, "strerror", None) or str(error) or type(error).__name__,
            )


def remove_autosave(folder: Path) -> None:
    """Remove the files that are needed only to resume a run, and partly written ones."""
    for name in (MAP, PROGRESS):
        (folder / name).unlink(missing_ok=True)
        for part in folder.glob(f".{name}.*.part"):
            part.unlink(missing_ok=True)


def _copy(stored: StoredMap) -> StoredMap:
    """Copy the map of a run without compacting it. The writing thread compacts it later."""
    tables = {
        name: replace(table, first=table.first.copy(), values=table.values.copy())
        for name, table in stored.detector.tables.items()
    }
    return replace(stored, map=stored.map.copy(), detector=replace(stored.detector, tables=tables))
