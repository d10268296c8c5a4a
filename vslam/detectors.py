"""The loop detectors by name."""

from __future__ import annotations

from vslam.config import Config
from vslam.loopclosure.detector import LoopDetector, NoDetector


def create_detector(name: str, config: Config) -> LoopDetector:
    """A detector that remembers nothing yet. What it needs is imported here, not before.

    Raises:
        InputError: its vocabulary or weights cannot be read.
        ValueError: no such detector.
    """
    if name == "none":
        return NoDetector()
    if name == "bow":
        from vslam.loopclosure.bow import BowDetector
        from vslam.loopclosure.vocabulary import load

        return BowDetector(load(), config.bow)
    raise ValueError(f"no loop detector {name!r}")
