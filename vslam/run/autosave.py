"""What a run leaves on the disk while it goes on, so that a killed one costs a minute at most.

``trajectory_online.tum`` has the pose of each frame as it was tracked, a line when it comes. Every
so often the map is copied between two frames, if possible while no keyframe is being mapped, and a
thread writes it with all that the report tells of the frames so far: ``autosave_progress.npz``,
then ``autosave.npz``, a map file as any other. Each takes the place of the one before in one step.
A run killed between the two finds the progress of a few frames more than the map has, and passes
over them.
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

from vslam.errors import InputError
from vslam.features import TrackResult
from vslam.lock_file import locked
from vslam.maps.new_output import replaced_file
from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap
from vslam.run.progress import Progress, read_progress, write_progress
from vslam.slam import Slam
from vslam.trajectory import tum_line

MAP, PROGRESS, ONLINE = "autosave.npz", "autosave_progress.npz", "trajectory_online.tum"
LOCK = ".lock"
_BEGIN = 0.75  # of the period: writing, and waiting for a merge, take the rest
_PATIENCE = 0.95  # of the period: until then no global bundle adjustment is cut off
_MISSED = 5  # frames that end while a keyframe is mapped, until its mapping is waited for

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Unfinished:
    """What a run left that was cut off: a map file, and the report's part of the same frames."""

    map: Path
    progress: Progress


@contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Keep a run from being resumed while it goes on. Where no lock can be made, on a full disk
    for example, it goes on without.

    Raises:
        InputError: another living process runs in the folder.
    """
    with ExitStack() as lock:
        with suppress(OSError):
            lock.enter_context(locked(folder / LOCK, folder, "runs here still"))
        yield


def find_unfinished(folder: Path) -> Unfinished:
    """What to go on from in the folder of a run. Poses of frames that are to be tracked once more
    are taken out of ``trajectory_online.tum``.

    Raises:
        InputError: nothing was saved, or it is damaged.
    """
    file = folder / MAP
    if not file.is_file():
        raise InputError(f"{folder}: no {MAP} here: nothing was saved, or the run is finished.")
    frames = load_map(file).frames
    progress = read_progress(folder / PROGRESS)
    if frames is None or len(frames.timestamp) > len(progress.tracks):
        raise InputError(f"{folder}: {PROGRESS} is older than {MAP}; there is nothing to resume.")
    _forget_poses(folder / ONLINE, len(frames.timestamp))
    return Unfinished(file, progress.until(len(frames.timestamp)))


def _forget_poses(path: Path, frames: int) -> None:
    with suppress(OSError):
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)[:frames]
        with replaced_file(path) as file:
            file.write("".join(lines).encode())


class Autosave:
    """Told of every frame of a run, in order; this one keeps nothing."""

    def frame(self, result: TrackResult) -> None:
        """A frame was tracked."""

    def offer(self, slam: Slam, progress: Callable[[], Progress]) -> None:
        """The frame is done with: this is the moment to save, if it is time."""

    def close(self, slam: Slam, progress: Callable[[], Progress], *, resumable: bool) -> None:
        """The run is over, and finished; if ``resumable``, it ended early with a complete map."""


NO_AUTOSAVE = Autosave()


class FolderAutosave(Autosave):
    """Saves into the folder of a run.

    What cannot be written, on a full disk for example, is told once; the run goes on, and the next
    time is another try.
    """

    def __init__(self, folder: Path, seconds: float, drive: str) -> None:
        """
        Args:
            seconds: what a killed run loses at most; 0: no map is saved.
            drive: what the images are, for the map file.
        """
        self._folder, self._seconds, self._drive = folder, seconds, drive
        self._last = time.monotonic()
        self._writer = ThreadPoolExecutor(1, "autosave")
        self._writing: Future[None] | None = None
        self._missed = 0  # frames since it is time at whose end a keyframe was being mapped
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
        except Exception as error:  # nothing that is only saved may end a run
            self._warn(ONLINE, error)
            self._online = None

    def offer(self, slam: Slam, progress: Callable[[], Progress]) -> None:
        waited = time.monotonic() - self._last
        if not self._seconds or waited < _BEGIN * self._seconds:
            return
        if slam.is_mapping and self._missed < _MISSED:
            self._missed += 1
            return
        if slam.is_adjusting and waited < _PATIENCE * self._seconds:
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
            # A step that failed had placed its frame already: it is to be tracked once more.
            stored = replace(stored, frames=frames.until(n_done), checkpoint=None)
        try:
            self._writing = self._writer.submit(self._write, _copy(stored), done)
        except Exception as error:  # no memory for a copy, or no thread
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
                "%s: cannot be written (%s); the run goes on without.",
                self._folder / name,
                getattr(error, "strerror", None) or str(error) or type(error).__name__,
            )


def remove_autosave(folder: Path) -> None:
    """Remove what only a run that was cut off needs, half-written files of killed runs included;
    its results are written."""
    for name in (MAP, PROGRESS):
        (folder / name).unlink(missing_ok=True)
        for part in folder.glob(f".{name}.*.part"):
            part.unlink(missing_ok=True)


def _copy(stored: StoredMap) -> StoredMap:
    """A copy of the map as it is, for another thread to make compact."""
    tables = {
        name: replace(table, first=table.first.copy(), values=table.values.copy())
        for name, table in stored.detector.tables.items()
    }
    return replace(stored, map=stored.map.copy(), detector=replace(stored.detector, tables=tables))
