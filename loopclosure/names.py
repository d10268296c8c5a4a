"""The names of the loop detectors, which the command line shows without importing a detector."""

from __future__ import annotations

from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.support import plugins

DETECTORS = ("none", "bow", "both", *NETWORKS)
DEFAULT_DETECTOR = "both"


def detector_names() -> tuple[str, ...]:
    """Return the names of all detectors, also of those that plug-ins provide."""
    return (
        *DETECTORS,
        *(one for one in plugins.find_plugins(plugins.DETECTORS) if one not in DETECTORS),
    )
