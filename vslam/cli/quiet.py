"""What ``progress.py`` draws, for a run that shows nothing: rich takes as long to import as forty
frames to track."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.features import TrackResult


@contextmanager
def progress_bar(total: int | None, *, shown: bool) -> Iterator[Callable[[TrackResult], None]]:
    """Yield a callable that does nothing."""
    yield lambda result: None


@contextmanager
def render_bar(*, shown: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a callable that does nothing."""
    yield lambda done, total: None


def announce(message: str, *, shown: bool) -> None:
    """Say nothing."""
