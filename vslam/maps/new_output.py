"""Files and folders that are there as a whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vslam.errors import InputError, ResultsError


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder that becomes ``path`` at the end, or is removed after an error.

    Raises:
        InputError: there is something at ``path`` already, other than an empty folder.
        ResultsError: it cannot be written, on a full disk for example.
    """
    free = path.is_dir() and not path.is_symlink() and not any(path.iterdir())
    if not free:
        _refuse_existing(path)
    part = _beside(path)
    with _as_results_error(path):
        try:
            part.mkdir(parents=True)
            yield part
            part.rename(path)
        finally:
            shutil.rmtree(part, ignore_errors=True)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the name of a file to write; it becomes ``path`` at the end, or is removed after an
    error.

    Raises:
        InputError: there is something at ``path`` already.
        ResultsError: it cannot be written, on a full disk for example.
    """
    _refuse_existing(path)
    part = _beside(path)
    with _as_results_error(path):
        try:
            part.parent.mkdir(parents=True, exist_ok=True)
            yield part
            part.rename(path)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def replaced_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file to write; at the end it is on the disk and takes the place of ``path``, in one
    step. After an error ``path`` is what it was.

    Raises:
        OSError: it cannot be written, on a full disk for example.
    """
    part = _beside(path)
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    if os.name == "posix":  # else after a power cut the name may be the old one's
        folder = os.open(path.absolute().parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def require_place(path: Path, option: str) -> None:
    """Refuse what cannot be written, before hours of work for it.

    Raises:
        InputError: ``path``, the value of an option, is a folder or lies in none.
    """
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; name a file.")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}; make it first.")


def _refuse_existing(path: Path) -> None:
    if os.path.lexists(path):
        raise InputError(f"{path}: exists already; remove it, or name another place with --out.")


def _beside(path: Path) -> Path:
    """A hidden name on the same file system, so that renaming is one step."""
    path = path.absolute()
    return path.with_name(f".{path.name}.{os.getpid()}.part")


@contextmanager
def _as_results_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ResultsError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or name "
            "another place with --out."
        ) from error
