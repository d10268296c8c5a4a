"""The detectors of the benchmark by name: the loop detectors of runs, and untrained baselines.

The baselines show the benefit of training. They cannot be used in runs, which need several
candidates that are not covisible: the islands of ``ibow`` give only one, and thumbnails give no
features to verify.
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
"""A function that makes a new online detector for the drive of these images."""

_UNTRAINED: dict[str, Callable[[], Scorer]] = {
    ThumbnailScorer.name: ThumbnailScorer,
    LsgdScorer.name: LsgdScorer,
}
_BASELINES = (*_UNTRAINED, IncrementalBow.name)


def require_comparable(name: str, weights: Path | None, protocol: ProtocolName) -> None:
    """Refuse a detector that cannot be compared, before large packages are imported.

    Raises:
        InputError: the detector is unknown, has no weights or does not suit the protocol.
    """
    if name == "none":
        raise InputError("--detectors none: finds no loops; leave it out.")
    if name == "both":
        raise InputError("--detectors both: has no score of its own; name bow,capsule.")
    if name == IncrementalBow.name and protocol != "online":
        raise InputError(f"--detectors {name}: learns during a drive; add --protocol online.")
    if name not in (*DETECTORS, *_BASELINES):
        known = (*DETECTORS[1:], *_BASELINES)
        raise InputError(
            f"--detectors {name}: unknown{did_you_mean(name, known)}; choose from "
            f"{', '.join(known)}."
        )
    if name not in _BASELINES:
        require_detector(name, weights, "--detectors")
    elif weights is not None:
        raise InputError(f"--weights: the detector {name} has no weights; leave the option out.")


def comparable_scorer(name: str, weights: Path | None, vocabulary: Vocabulary) -> Scorer:
    """Open a detector for the protocol ``retrieval``.

    Raises:
        InputError: no weights for it, or those of another network.
    """
    if name in _UNTRAINED:
        return _UNTRAINED[name]()
    return open_scorer(name, weights, vocabulary)


def online_detector(name: str, weights: Path | None, vocabulary: Vocabulary) -> Start:
    """The function that starts a detector for the protocol ``online``.

    Raises:
        InputError: no weights for it, or those of another network.
    """
    if name == IncrementalBow.name:
        return lambda images: IncrementalBow()
    scorer = comparable_scorer(name, weights, vocabulary)
    return lambda images: ScoredDetector(scorer, images)
