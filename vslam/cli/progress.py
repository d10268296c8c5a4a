"""Progress bars of commands, drawn on stderr so that stdout stays for results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

if TYPE_CHECKING:
    from vslam.features import TrackResult


class _FramesPerSecond(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} fps" if task.speed else "- fps")


@contextmanager
def progress_bar(total: int | None) -> Iterator[Callable[[TrackResult], None]]:
    """Show frames, fps, tracking state and time left; yield the callable that takes each frame.

    Args:
        total: approximate number of frames, None if unknown.
    """
    columns = (
        MofNCompleteColumn(),
        BarColumn(),
        _FramesPerSecond(),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=total, state="starting")

        def on_frame(result: TrackResult) -> None:
            progress.update(task, completed=result.index + 1, state=str(result.state))

        yield on_frame


@contextmanager
def render_bar() -> Iterator[Callable[[int, int], None]]:
    """Yield the callable that takes the frames rendered and their total; it draws the bar."""
    columns = (
        TextColumn("rendering"),
        MofNCompleteColumn(),
        BarColumn(),
        _FramesPerSecond(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns, console=Console(stderr=True))
    tasks: list[TaskID] = []

    def on_frame(done: int, total: int) -> None:
        if not tasks:
            progress.start()
            tasks.append(progress.add_task("", total=total, completed=done))
        progress.update(tasks[0], completed=done)

    try:
        yield on_frame
    finally:
        if tasks:
            progress.stop()


@contextmanager
def training_bar() -> Iterator[Callable[[int, int, int, float], None]]:
    """Yield the callable that takes epoch, step, steps per epoch and loss of a training."""
    columns = (
        TextColumn("epoch {task.fields[epoch]}"),
        MofNCompleteColumn(),
        BarColumn(),
        TextColumn("loss {task.fields[loss]:.3f}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=None, epoch=0, loss=float("nan"))

        def on_step(epoch: int, step: int, steps: int, loss: float) -> None:
            if step == 1:
                progress.reset(task)
            progress.update(task, total=steps, completed=step, epoch=epoch, loss=loss)

        yield on_step


@contextmanager
def count_bar(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Yield the callable that counts one of ``total`` items as done."""
    columns = (TextColumn(what), MofNCompleteColumn(), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=total)
        yield lambda: progress.advance(task)


def announce(message: str) -> None:
    """Print a message on stderr."""
    Console(stderr=True).print(message)
