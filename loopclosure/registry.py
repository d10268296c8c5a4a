"""The loop detectors by name."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from vslam.config import Config
from vslam.errors import InputError
from vslam.loopclosure.detector import LoopDetector, NoDetector
from vslam.loopclosure.siamese.weights import NETWORKS, find_weights

DETECTORS = ("none", "bow", *NETWORKS)


def require_detector(name: str, weights: Path | None = None, option: str = "--detector") -> None:
    """Refuse what cannot be created, before anything heavy is imported or compiled.

    Raises:
        InputError: no such detector, or no weights for it.
    """
    if name not in DETECTORS:
        raise InputError(f"{option} {name}: unknown; choose one of {', '.join(DETECTORS)}.")
    if name in NETWORKS:
        find_weights(name, weights)
    elif weights is not None:
        raise InputError(f"--weights: the detector {name} has none; leave the option out.")


def create_detector(name: str, config: Config, weights: Path | None = None) -> LoopDetector:
    """A detector that remembers nothing yet. What it needs is imported here, not before.

    Args:
        weights: of a learned detector; None for those that vslam ships.

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
    if name in NETWORKS:
        from vslam.loopclosure.siamese.detector import open_detector

        return open_detector(name, config.siamese, weights)
    raise ValueError(f"no loop detector {name!r}")


def parse_weights(given: Collection[str], detectors: Collection[str]) -> dict[str, Path]:
    """``NAME=FILE`` each: the weights of some of these detectors.

    Raises:
        InputError: an item of another form, or of no detector asked for.
    """
    files = {}
    for item in given:
        name, equals, file = item.partition("=")
        if not equals or name not in detectors:
            raise InputError(
                f"--weights {item}: must be NAME=FILE with a name of --detectors "
                f"({', '.join(detectors)})."
            )
        files[name] = Path(file).expanduser().absolute()
    return files
