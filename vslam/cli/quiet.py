"""The functions of ``progress.py`` for a command that shows nothing.

Importing rich takes as long as tracking forty frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.features import TrackResult


@contextmanager
def progress_bar(total: int | None) -> Iterator[Callable[[TrackResult], None]]:
    """Yield a callable that does nothing."""
    yield lambda result: None


@contextmanager
def render_bar() -> Iterator[Callable[[int, int], None]]:
    """Yield a callable that does nothing."""
    yield lambda done, total: None


@contextmanager
def training_bar() -> Iterator[Callable[[int, int, int, float], None]]:
    """Yield a callable that does nothing."""
    yield lambda epoch, step, steps, loss: None


@contextmanager
def count_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Yield a callable that does nothing."""
    yield lambda: None


def announce(message: str) -> None:
    """Print nothing."""
