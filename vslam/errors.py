"""Failures that a user can cause or repair."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


class InputError(Exception):
    """Bad input: one sentence that names the file or option and the fix. The CLI exits with 2."""


class UnreadableImageError(InputError):
    """One image of a sequence cannot be decoded or has the wrong size.

    During a run such a frame is reported, skipped and counted; before a run it is an error.
    """

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = path


class DroppedFrameError(UnreadableImageError):
    """A frame that a perturbation keeps back; during a run it counts as dropped, not as lost."""

    def __init__(self, frame: int) -> None:
        super().__init__(Path(f"frame {frame}"), "dropped by --perturb")


class BrokenSourceError(InputError):
    """A video, bag or camera ended before its time: a file cut off, a device unplugged.

    During a run all frames before it count; before the first one it is an error.
    """


class ResultsError(Exception):
    """Results cannot be written, on a full disk for example. The CLI exits with 1."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`` (did you mean NAME?)`` with the known name that a misspelt word is most like; empty if it
    is like none."""
    from difflib import get_close_matches  # only a mistake needs it

    near = get_close_matches(word.lower(), list(known), n=1)
    return f" (did you mean {near[0]}?)" if near else ""
