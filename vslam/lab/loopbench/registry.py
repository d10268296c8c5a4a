"""What the benchmark compares, by name: the loop detectors of runs, and baselines of its own.

The baselines were trained on nothing and show what training is worth. They are no detectors of
runs: runs ask for several candidates of which none is covisible, and the islands of ``ibow`` give
one; a thumbnail has nothing to verify.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from vslam.errors import InputError, did_you_mean
from vslam.lab.loopbench.detectors import DescribedImage, Scorer, open_scorer
from vslam.lab.loopbench.incremental_bow import IncrementalBow
from vslam.lab.loopbench.lsgd import LsgdScorer
from vslam.lab.loopbench.online import OnlineDetector, ScoredDetector
from vslam.lab.loopbench.thumbnail import ThumbnailScorer
from vslam.loopclosure.registry import DETECTORS, require_detector
from vslam.loopclosure.vocabulary import Vocabulary

ProtocolName = Literal["retrieval", "online"]
Start = Callable[[list[DescribedImage]], OnlineDetector]
"""An online detector that remembers nothing yet, for the drive of these images."""

_UNTRAINED: dict[str, Callable[[], Scorer]] = {
    ThumbnailScorer.name: ThumbnailScorer,
    LsgdScorer.name: LsgdScorer,
}
_BASELINES = (*_UNTRAINED, IncrementalBow.name)


def require_comparable(name: str, weights: Path | None, protocol: ProtocolName) -> None:
    """Refuse what cannot be compared, before anything heavy is imported.

    Raises:
        InputError: no such detector, no weights for it, or none that the protocol can take.
    """
    if name == "none":
        raise InputError("--detectors none: finds nothing; leave it out.")
    if name == "both":
        raise InputError("--detectors both: has no score of its own; name bow,capsule.")
    if name == IncrementalBow.name and protocol != "online":
        raise InputError(f"--detectors {name}: its words grow with a drive; add --protocol online.")
    if name not in (*DETECTORS, *_BASELINES):
        known = (*DETECTORS[1:], *_BASELINES)
        raise InputError(
            f"--detectors {name}: unknown{did_you_mean(name, known)}; choose from "
            f"{', '.join(known)}."
        )
    if name not in _BASELINES:
        require_detector(name, weights, "--detectors")
    elif weights is not None:
        raise InputError(f"--weights: the detector {name} has none; leave the option out.")


def comparable_scorer(name: str, weights: Path | None, vocabulary: Vocabulary) -> Scorer:
    """A detector of the protocol retrieval.

    Raises:
        InputError: no weights for it, or those of another network.
    """
    if name in _UNTRAINED:
        return _UNTRAINED[name]()
    return open_scorer(name, weights, vocabulary)


def online_detector(name: str, weights: Path | None, vocabulary: Vocabulary) -> Start:
    """What starts a detector of the protocol online.

    Raises:
        InputError: no weights for it, or those of another network.
    """
    if name == IncrementalBow.name:
        return lambda images: IncrementalBow()
    scorer = comparable_scorer(name, weights, vocabulary)
    return lambda images: ScoredDetector(scorer, images)
