"""Writes output files and folders so that they are either complete or do not exist."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vslam.support.errors import InputError, ResultsError


@contextmanager
def new_output(path: Path, *, folder: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file or folder for the output. The temporary file or folder is
    renamed to ``path`` if the block succeeds, and removed if the block raises an exception.

    Raises:
        InputError: ``path`` exists already. If a folder is written, an existing empty folder is
            accepted.
        ResultsError: the output cannot be written, for example because the disk is full.
    """
    empty = path.is_dir() and not path.is_symlink() and not any(path.iterdir())
    if not (folder and empty):
        require_free(path)
    part = _beside(path)
    try:
        (part if folder else part.parent).mkdir(parents=True, exist_ok=not folder)
        yield part
        part.rename(path)
    except OSError as error:
        raise ResultsError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or give "
            "another path with --out."
        ) from error
    finally:
        if folder:
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)


@contextmanager
def replaced_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file, open for writing. At the end, the file is synced to the disk and
    replaces ``path`` atomically. After an error, ``path`` is unchanged.

    Raises:
        OSError: the file cannot be written, for example because the disk is full.
    """
    part = _beside(path)
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        if error.filename != str(part):
            raise
        missing = not part.parent.is_dir()
        why = f"there is no folder {path.parent}" if missing else error.strerror
        raise OSError(error.errno, why, str(path)) from None  # name the file that the user knows
    finally:
        part.unlink(missing_ok=True)
    if os.name == "posix":  # without this sync, a power cut may undo the renaming
        folder = os.open(path.absolute().parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def require_place(path: Path, option: str) -> None:
    """Check that a file can be written to a path. Call this before a long computation.

    Args:
        option: the option that gave the path, for error messages.

    Raises:
        InputError: ``path`` is a folder, or its parent folder does not exist.
    """
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; give a file.")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}; create it first.")


def require_free(path: Path) -> None:
    """Raise an `InputError` if a file or folder exists at ``path``, the value of ``--out``."""
    if os.path.lexists(path):
        raise InputError(f"{path}: exists already; remove it, or give another path with --out.")


def _beside(path: Path) -> Path:
    """Return a hidden path in the same folder as ``path``, so that renaming is atomic."""
    path = path.absolute()
    return path.with_name(f".{path.name}.{os.getpid()}.part")
