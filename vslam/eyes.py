"""What is done to each eye of a frame: one eye after the other, or both at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

Given = TypeVar("Given")
Made = TypeVar("Made")


class EachEye(Protocol):
    """``map``, or the ``map`` of a pool of threads: the same results in the same order, sooner."""

    def __call__(
        self, function: Callable[[Given], Made], eyes: Iterable[Given], /
    ) -> Iterator[Made]: ...
