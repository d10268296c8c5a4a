"""Progress of a command: ``progress.py`` draws bars on stderr, ``quiet.py`` shows nothing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from vslam.features import TrackResult


class Console(Protocol):
    """The functions that both modules have."""

    def progress_bar(
        self, total: int | None
    ) -> AbstractContextManager[Callable[[TrackResult], None]]: ...
    def render_bar(self) -> AbstractContextManager[Callable[[int, int], None]]: ...
    def training_bar(self) -> AbstractContextManager[Callable[[int, int, int, float], None]]: ...
    def count_bar(self, what: str, total: int) -> AbstractContextManager[Callable[[], None]]: ...
    def announce(self, message: str) -> None: ...


def console(*, shown: bool) -> Console:
    """The module that shows progress, or the one that shows nothing and imports nothing slow."""
    if shown:
        from vslam.cli import progress

        return cast("Console", progress)
    from vslam.cli import quiet

    return cast("Console", quiet)
