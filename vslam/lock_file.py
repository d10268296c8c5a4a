"""One process at a time: the operating system's lock on a file."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vslam.errors import InputError


@contextmanager
def locked(lock: Path, folder: Path, doing: str) -> Iterator[None]:
    """Keep other processes from writing to a folder. The lock of a killed process ends with it.

    Args:
        lock: file to make and to remove.
        folder: what it stands for, in the message.
        doing: what its process does to that folder, "is rendering it".

    Raises:
        InputError: another process has the lock.
        OSError: it cannot be made, on a file system without locks for example.
    """
    while True:
        with lock.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{folder}: another process {doing}; wait until it is done."
                ) from None
            if not _is_at(file, lock):
                continue  # its owner has removed it since it was opened
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
