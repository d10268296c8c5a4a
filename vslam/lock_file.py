"""One process at a time: a file that names the one that writes to a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vslam.errors import InputError


@contextmanager
def locked(lock: Path, folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes from writing to a folder.

    Locks that a killed process left are passed over: a process that is younger than the lock did
    not make it.

    Args:
        lock: file to make and to remove.
        folder: what it stands for, in the message.
        doing: what its process does to that folder, "is rendering it".

    Raises:
        InputError: another living process has it.
        OSError: it cannot be made.
    """
    mine = lock.with_name(f"{lock.name}.{os.getpid()}")
    try:
        mine.write_text(str(os.getpid()))
        _take(mine, lock, folder, doing)
    finally:
        mine.unlink(missing_ok=True)
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)


def _take(mine: Path, lock: Path, folder: Path, doing: str) -> None:
    while True:
        try:
            os.link(mine, lock)  # with its contents from the first moment
            return
        except FileExistsError:
            pass
        try:
            owner, made = int(lock.read_text() or 0), lock.stat().st_mtime
        except FileNotFoundError:
            continue
        except ValueError:
            owner, made = 0, 0.0
        if owner and _started_before(owner, made):
            raise InputError(
                f"{folder}: process {owner} {doing}; wait until it is done, or delete "
                f"{lock} if that process is not vslam."
            )
        lock.unlink(missing_ok=True)


def _started_before(process: int, seconds: float) -> bool:
    """Whether a process lives that is older than a time; its start is known to a second or two."""
    import psutil

    try:
        return psutil.Process(process).create_time() < seconds + 2.0
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return True
