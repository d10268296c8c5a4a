"""Errors that a user can cause or repair."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


class InputError(Exception):
    """An input is wrong.

    The message is one sentence that names the file or option and says how to correct the input. The
    command line exits with status 2.
    """


class UnreadableImageError(InputError):
    """One image of a sequence cannot be decoded or has the wrong size.

    A run reports this frame, skips it and counts it as lost. If the first image of a sequence is
    unreadable, the sequence cannot be opened.
    """

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = path


class DroppedFrameError(UnreadableImageError):
    """A perturbation dropped this frame. The frame counts as dropped, not as lost."""

    def __init__(self, frame: int) -> None:
        super().__init__(Path(f"frame {frame}"), "dropped by --perturb")


class BrokenSourceError(InputError):
    """A video, bag or camera ended early: the file was cut off, or the device was unplugged.

    A run keeps the results of the frames before this point, and fails only if there are no such
    frames.
    """


class ResultsError(Exception):
    """Results cannot be written, for example because the disk is full. The command line exits with
    status 1."""


def write_file(path: Path, content: str | bytes, fix: str = "free some space") -> None:
    """Write a file atomically, so that it appears only when it is complete.

    The folder of the file is created if needed.

    Raises:
        ResultsError: the file cannot be written. The message ends with the advice ``fix``.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise ResultsError(f"{path}: cannot be written ({error.strerror}); {fix}.") from error


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a suggestion for a misspelt word, such as `` (did you mean NAME?)``.

    NAME is the known name that is most similar to the word. The suggestion is empty if no known
    name is similar.
    """
    from difflib import get_close_matches  # slow to import, and only an error message needs it

    near = get_close_matches(word.lower(), list(known), n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def counted(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural: ``1 run`` or ``1,200 runs``."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def plain_reason(message: str) -> str:
    """Rephrase an error message of pydantic in plain words."""
    message = message.removeprefix("Value error, ").partition(", unable to parse")[0]
    for theirs, ours in (
        ("Input should be", "must be"),
        ("greater than or equal to", "at least"),
        ("less than or equal to", "at most"),
        ("greater than", "more than"),
        ("a valid ", "a "),
        ("an integer", "a whole number"),
        ("a integer", "a whole number"),
        ("a boolean", "true or false"),
    ):
        message = message.replace(theirs, ours)
    return message
