"""Failures that a user can cause or repair."""

from __future__ import annotations

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
