"""The loop detectors by name: vslam's own, and those of other packages (docs/howto/plugins.md)."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from vslam import plugins
from vslam.config import Config
from vslam.errors import InputError
from vslam.loopclosure.detector import LoopDetector, NoDetector
from vslam.loopclosure.plugin_detector import PlugInDetector, open_plugin
from vslam.loopclosure.siamese.weights import NETWORKS, TO_THE_LETTER, find_weights

if TYPE_CHECKING:
    from vslam.loopclosure.siamese.local_descriptors import KeyframeImages

DETECTORS = ("none", "bow", "both", *NETWORKS)
DEFAULT_DETECTOR = "both"
_ABOUT = {
    "none": "no loop closing",
    "bow": "the bag of words",
    "both": "the Siamese capsule network beside the bag of words",
    "capsule": "the Siamese capsule network",
    "capsule-pruned": "the Siamese capsule network, pruned",
    "capsule-paper": "the Siamese capsule network as the paper describes it",
}
# Detectors whose candidates learned descriptors verify, too, unless the configuration says more.
LEARNED_VERIFICATION = ("both", *(name for name in NETWORKS if name != TO_THE_LETTER))


def about(name: str) -> str:
    """What a detector is, in a few words; its name for all others."""
    return _ABOUT.get(name, name)


def require_detector(name: str, weights: Path | None = None, option: str = "--detector") -> None:
    """Refuse what cannot be created, before anything heavy is imported or compiled.

    Raises:
        InputError: no such detector, or no weights for it.
    """
    if name not in DETECTORS:
        others = plugins.find_plugins(plugins.DETECTORS)
        if name not in others:
            known = ", ".join((*DETECTORS, *others))
            raise InputError(f"{option} {name}: unknown; choose one of {known}.")
        open_plugin(others[name], Config(), weights)
    elif name in (*NETWORKS, "both"):
        find_weights(_network_of(name), weights)
    elif weights is not None:
        raise InputError(f"--weights: the detector {name} has none; leave the option out.")


def problem_of(detector: LoopDetector) -> str | None:
    """What failed in a detector of another package, in one sentence; None if nothing did."""
    return detector.problem if isinstance(detector, PlugInDetector) else None


def detector_with_images(
    name: str,
    config: Config,
    weights: Path | None = None,
    *,
    local_weights: Path | None = None,
    late: bool = True,
) -> tuple[LoopDetector, KeyframeImages | None]:
    """A detector that remembers nothing yet, and where it keeps the images of keyframes for
    learned verification: both halves that :class:`vslam.slam.Slam` takes.

    Args:
        weights, late: as of :func:`create_detector`.
        local_weights: of the local descriptors; None for those that vslam ships.

    Returns:
        The detector, and None in place of images where ORB alone verifies its candidates.

    Raises:
        InputError, ValueError: as :func:`create_detector`.
    """
    images = create_images(name, config, local_weights)
    return create_detector(name, config, weights, images, late=late), images


def create_detector(
    name: str,
    config: Config,
    weights: Path | None = None,
    images: KeyframeImages | None = None,
    *,
    late: bool = False,
) -> LoopDetector:
    """A detector that remembers nothing yet. What it needs is imported here, not before.

    Args:
        weights: of a learned detector; None for those that vslam ships.
        images: of the keyframes, from :func:`create_images`; given to ``verifier_for``, too.
        late: load a network that vslam ships when the first image is shown to it.

    Raises:
        InputError: its vocabulary or weights cannot be read, or its package is broken.
        ValueError: no such detector.
    """
    if name == "none":
        return NoDetector()
    if name == "bow":
        from vslam.loopclosure.bow import BowDetector
        from vslam.loopclosure.vocabulary import load

        return BowDetector(load(), config.bow)
    if name == "both":
        from vslam.loopclosure.combined import CombinedDetector

        detectors = [
            create_detector("bow", config),
            create_detector(_network_of(name), config, weights, images, late=late),
        ]
        return CombinedDetector(name, detectors, config.siamese.min_shared)
    if name in NETWORKS:
        from vslam.loopclosure.siamese.detector import open_detector

        return open_detector(name, config.siamese, weights, config.learned, images, late=late)
    others = plugins.find_plugins(plugins.DETECTORS)
    if name in others:
        return open_plugin(others[name], config, weights)
    raise ValueError(f"no loop detector {name!r}")


def create_images(name: str, config: Config, weights: Path | None = None) -> KeyframeImages | None:
    """What keeps the images that learned descriptors rate and verify candidates with; None where
    ORB alone verifies them (``verification.descriptors``).

    Raises:
        InputError: the network cannot be read.
    """
    descriptors = config.verification.descriptors
    if descriptors == "usual":
        descriptors = "both" if name in LEARNED_VERIFICATION else "orb"
    if name == "none" or descriptors == "orb":
        return None
    from vslam.loopclosure.siamese.local_descriptors import (
        SHIPPED_LOCAL,
        KeyframeImages,
        LocalDescriptors,
    )

    return KeyframeImages(LocalDescriptors(weights or SHIPPED_LOCAL))


def _network_of(name: str) -> str:
    """The learned half of ``both``; a network itself."""
    return "capsule" if name == "both" else name


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
