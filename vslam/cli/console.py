"""Who tells how far a command is: ``progress.py`` by bars on stderr, ``quiet.py`` not at all."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from vslam.features import TrackResult


class Console(Protocol):
    """The functions of both modules."""

    def progress_bar(
        self, total: int | None
    ) -> AbstractContextManager[Callable[[TrackResult], None]]: ...
    def render_bar(self) -> AbstractContextManager[Callable[[int, int], None]]: ...
    def training_bar(self) -> AbstractContextManager[Callable[[int, int, int, float], None]]: ...
    def count_bar(self, what: str, total: int) -> AbstractContextManager[Callable[[], None]]: ...
    def announce(self, message: str) -> None: ...


def console(*, shown: bool) -> Console:
    """What tells; where nothing is shown, without what takes time to import."""
    if shown:
        from vslam.cli import progress

        return cast("Console", progress)
    from vslam.cli import quiet

    return cast("Console", quiet)
