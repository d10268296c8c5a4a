"""A lock file that ensures that only one process at a time writes to a folder."""

from __future__ import annotations

import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vslam.support.errors import InputError

_log = logging.getLogger(__name__)


@contextmanager
def locked(lock: Path, folder: Path, doing: str, *, wait: bool = False) -> Iterator[None]:
    """Keep other processes from writing to a folder.

    If the process is killed, the system releases the lock.

    Args:
        lock: the lock file, which is created and removed.
        folder: the folder that the lock protects, for the error message.
        doing: what the process that holds the lock does, for the error message, such as "is
            rendering it".
        wait: whether to wait for another process that holds the lock, after a warning is logged.

    Raises:
        InputError: another process holds the lock, and ``wait`` is not set.
        OSError: the lock cannot be created, for example because the file system does not support
            locks.
    """
    while True:
        with lock.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not wait:
                    raise InputError(
                        f"{folder}: another process {doing}; wait until it is done."
                    ) from None
                _log.warning("%s: another process %s; waiting until it is done.", folder, doing)
                fcntl.flock(file, fcntl.LOCK_EX)
            if not _is_at(file, lock):
                continue  # the previous owner removed this file after it was opened here
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return


def _is_at(file: BinaryIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
