"""Creates loop detectors by name: the detectors of vslam, and those of other packages
(docs/howto/plugins.md)."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

from vslam.config import Config
from vslam.loopclosure.detector import LoopDetector, NoDetector
from vslam.loopclosure.names import DETECTORS
from vslam.loopclosure.plugin_detector import PlugInDetector, open_plugin
from vslam.loopclosure.siamese.weights import NETWORKS, TO_THE_LETTER, find_weights
from vslam.support import plugins
from vslam.support.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from vslam.loopclosure.siamese.local_descriptors import KeyframeImages

_ABOUT = {
    "none": "no loop closing",
    "bow": "the bag of words",
    "both": "the Siamese capsule network together with the bag of words",
    "capsule": "the Siamese capsule network",
    "capsule-pruned": "the Siamese capsule network, pruned",
    "capsule-paper": "the Siamese capsule network as the paper describes it",
}
# Detectors whose candidates are also verified using learned descriptors. The configuration can
# override this.
LEARNED_VERIFICATION = ("both", *(name for name in NETWORKS if name != TO_THE_LETTER))


def about(name: str) -> str:
    """Return a short description of a loop detector."""
    return _ABOUT.get(name, "a plug-in")


def require_detector(name: str, weights: Path | None = None, option: str = "--detector") -> None:
    """Check that a loop detector can be created, before anything expensive is imported or compiled.

    Args:
        weights: weights or vocabulary of the detector; None uses the files that vslam ships.
        option: the command-line option that error messages refer to.

    Raises:
        InputError: the detector is unknown, its weights are missing, or weights are given for a
            detector that has none.
    """
    if name not in DETECTORS:
        others = plugins.find_plugins(plugins.DETECTORS)
        if name not in others:
            known = (*DETECTORS, *others)
            raise InputError(
                f"{option} {name}: unknown{did_you_mean(name, known)}; choose one of "
                f"{', '.join(known)}."
            )
        open_plugin(others[name], Config(), weights)
    elif name in (*NETWORKS, "both"):
        find_weights(_network_of(name), weights)
    elif weights is not None and name == "none":
        raise InputError("--weights: the detector 'none' has no weights; leave the option out.")
    elif weights is not None and not weights.is_file():
        raise InputError(
            f"--weights {weights}: no such file; give a vocabulary file (.npz or .txt)."
        )


def problem_of(detector: LoopDetector) -> str | None:
    """Return one sentence about the failure of a plug-in detector, or None if there was no
    failure."""
    return detector.problem if isinstance(detector, PlugInDetector) else None


def detector_with_images(
    name: str,
    config: Config,
    weights: Path | None = None,
    *,
    local_weights: Path | None = None,
    on_demand: bool = True,
) -> tuple[LoopDetector, KeyframeImages | None]:
    """Create a loop detector, and the store of keyframe images for verification with learned
    descriptors. Both are empty. :class:`vslam.slam.Slam` takes both.

    Args:
        weights: weights of a learned detector, or the vocabulary of ``bow``; None uses the file
            that vslam ships.
        local_weights: weights of the local-descriptor network; None uses the weights that vslam
            ships.
        on_demand: whether networks are loaded and applied to keyframes only when their descriptors
            are needed. This saves time, but a frame may have to wait for it.

    Returns:
        The detector, and the store of images. The store is None if candidates are verified using
        only ORB descriptors.

    Raises:
        InputError: the vocabulary or weights cannot be read, or the package of a plug-in is broken.
        ValueError: there is no such detector.
    """
    images = create_images(name, config, local_weights)
    detector = create_detector(name, config, weights, images, on_demand=on_demand)
    if images is not None and not on_demand:
        images.network.load()
    return detector, images


def create_detector(
    name: str,
    config: Config,
    weights: Path | None = None,
    images: KeyframeImages | None = None,
    *,
    on_demand: bool = False,
) -> LoopDetector:
    """Create an empty loop detector. Its dependencies are imported only when this function is
    called.

    Args:
        weights: weights of a learned detector, or the vocabulary of ``bow``; None uses the file
            that vslam ships.
        images: the store of keyframe images from :func:`create_images`. Pass the same store to
            ``Verifier``.
        on_demand: whether networks are loaded and applied to keyframes only when their descriptors
            are needed. This saves time, but a frame may have to wait for it.

    Raises:
        InputError: the vocabulary or weights cannot be read, or the package of a plug-in is broken.
        ValueError: there is no such detector.
    """
    if name == "none":
        return NoDetector()
    if name == "bow":
        from vslam.loopclosure.bow import BowDetector
        from vslam.loopclosure.vocabulary import SHIPPED
        from vslam.loopclosure.vocabulary_text import read_vocabulary

        return BowDetector(read_vocabulary(weights or SHIPPED), config.bow)
    if name == "both":
        from vslam.loopclosure.combined import CombinedDetector

        detectors = [
            create_detector("bow", config),
            create_detector(_network_of(name), config, weights, images, on_demand=on_demand),
        ]
        return CombinedDetector(name, detectors)
    if name in NETWORKS:
        from vslam.loopclosure.siamese.detector import open_detector

        return open_detector(
            name, config.siamese, weights, config.learned, images, on_demand=on_demand
        )
    others = plugins.find_plugins(plugins.DETECTORS)
    if name in others:
        return open_plugin(others[name], config, weights)
    known = (*DETECTORS, *others)
    raise ValueError(
        f"no loop detector {name!r}{did_you_mean(name, known)}; choose one of {', '.join(known)}"
    )


def create_images(name: str, config: Config, weights: Path | None = None) -> KeyframeImages | None:
    """Create the store of keyframe images, which is needed to rate and verify loop candidates using
    learned descriptors. Returns None if only ORB descriptors are used.

    Raises:
        InputError: the local-descriptor network cannot be read.
    """
    descriptors = config.verification.descriptors
    if descriptors == "auto":
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
    return "capsule" if name == "both" else name


def parse_weights(given: Collection[str], detectors: Collection[str]) -> dict[str, Path]:
    """Parse items of the form ``NAME=FILE``. Returns the file of weights for each detector name.

    Raises:
        InputError: an item has a different form or names an unknown detector.
    """
    files = {}
    for item in given:
        name, equals, file = item.partition("=")
        if not equals or name not in detectors:
            raise InputError(
                f"--weights {item}: must be NAME=FILE, where NAME is one of --detectors"
                f"{did_you_mean(name, detectors)}: {', '.join(detectors)}."
            )
        files[name] = Path(file).expanduser().absolute()
    return files
