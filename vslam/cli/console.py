"""Display of the progress of a command on stderr. Results are printed on stdout."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vslam.types.features import TrackResult


class Console:
    """Draws progress bars and prints messages. If ``shown`` is False, it does nothing.

    The package rich is imported only when something is shown, because its import takes as long as
    tracking forty frames.
    """

    def __init__(self, *, shown: bool) -> None:
        self._shown = shown

    def announce(self, message: str) -> None:
        if self._shown:
            from rich.console import Console as RichConsole

            RichConsole(stderr=True).print(message)

    @contextmanager
    def progress_bar(self, total: int | None) -> Iterator[Callable[[TrackResult], None]]:
        """Show a bar with the progress, speed, tracking state and remaining time of a run. Yields a
        function that must be called with the result of each frame.

        Args:
            total: approximate number of frames. None if it is unknown.
        """
        with self._bar(after=("{task.fields[state]}",), fps=True) as update:
            update(total=total, state="starting")
            yield lambda result: update(completed=result.index + 1, state=str(result.state))

    @contextmanager
    def render_bar(self) -> Iterator[Callable[[int, int], None]]:
        """Show a bar for rendering. Yields a function that must be called with the number of
        rendered frames and the number of all frames."""
        with self._bar("rendering", fps=True) as update:
            yield lambda done, total: update(total=total, completed=done)

    @contextmanager
    def training_bar(self) -> Iterator[Callable[[int, int, int, float], None]]:
        """Show a bar for training. Yields a function that must be called with the epoch, the step,
        the steps per epoch and the loss."""
        with self._bar("epoch {task.fields[epoch]}", ("loss {task.fields[loss]:.3f}",)) as update:
            yield lambda epoch, step, steps, loss: update(
                anew=step == 1, total=steps, completed=step, epoch=epoch, loss=loss
            )

    @contextmanager
    def count_bar(self, what: str, total: int) -> Iterator[Callable[[], None]]:
        """Show a bar that counts items. Yields a function that must be called whenever one of the
        ``total`` items is done."""
        with self._bar(what) as update:
            update(total=total)
            yield lambda: update(advance=1)

    @contextmanager
    def _bar(
        self, before: str = "", after: tuple[str, ...] = (), *, fps: bool = False
    ) -> Iterator[Callable[..., None]]:
        """Show a bar when its first step is done. Yields a function with the arguments of rich's
        ``Progress.update``. Its additional argument ``anew`` restarts the bar."""
        if not self._shown:
            yield lambda **changes: None
            return
        from rich.console import Console as RichConsole
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TaskID,
            TextColumn,
            TimeRemainingColumn,
        )

        class Speed(TextColumn):
            def render(self, task: Any) -> Any:
                task.fields["fps"] = f"{task.speed:.1f}" if task.speed else "-"
                return super().render(task)

        first = [before] if before else []
        last = [Speed("{task.fields[fps]} fps")] if fps else []
        progress = Progress(
            *first, MofNCompleteColumn(), BarColumn(), *last, *after, TimeRemainingColumn(),
            console=RichConsole(stderr=True),
        )  # fmt: skip
        tasks: list[TaskID] = []

        def update(*, anew: bool = False, **changes: Any) -> None:
            if not tasks:
                tasks.append(progress.add_task("", **{"total": None, **changes}))
                progress.start()
                return
            if anew:
                progress.reset(tasks[0])
            progress.update(tasks[0], **changes)

        try:
            yield update
        finally:
            if tasks:
                progress.stop()
