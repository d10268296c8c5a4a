"""All laws (kinds of perturbation) by name.

Plug-ins in other Python packages may add laws (docs/howto/plugins.md). vslam checks every image
that a law of a plug-in returns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from vslam.datasets.perturbation import glass, inertial, light, motion, sensor, stereo, weather
from vslam.datasets.perturbation.kinds import Law, LawKind
from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.plugins import PERTURBATIONS, PlugIn, find_plugins
from vslam.types.camera import Image

_PROBE = (48, 64)  # rows and columns of the image on which a new law is tried


def plugin_laws() -> dict[str, Callable[[float, tuple[int, int]], Law]]:
    """Return the laws (kinds of perturbation) of plug-ins in other Python packages, by name.

    Each law is a function that takes a strength, and a tuple of the user's seed and a number for
    the law. The function returns the perturbation.
    """
    return {name: partial(_make, plugin) for name, plugin in find_plugins(PERTURBATIONS).items()}


def _make(plugin: PlugIn, strength: float, stream: tuple[int, int]) -> Law:
    """Make a perturbation of a plug-in, and try it on a grey image."""
    law = plugin.call(strength, stream)
    if not callable(law):
        raise InputError(
            f"{plugin}: returned a {type(law).__name__}, which is not a function; repair or "
            "uninstall the package."
        )
    checked = partial(_apply, plugin, law)
    checked(0, 0.0, 0, np.full(_PROBE, 128, np.uint8))
    return checked


def _apply(plugin: PlugIn, law: Law, frame: int, t: float, side: int, image: Image) -> Image:
    """Apply a perturbation of a plug-in to an image. If it fails, the run skips the frame."""
    view = image.view()
    view.flags.writeable = False
    where = Path(f"frame {frame}")
    try:
        result = plugin.guarded(law, frame, t, side, view)
    except InputError as error:
        raise UnreadableImageError(where, str(error)) from error
    if getattr(result, "dtype", None) != np.uint8 or result.shape != image.shape:
        kind = f"{getattr(result, 'dtype', type(result).__name__)} {getattr(result, 'shape', '')}"
        raise UnreadableImageError(
            where, f"{plugin} returned {kind.strip()}, not uint8 {image.shape}; repair the package."
        )
    return np.asarray(result, np.uint8)


LAWS: dict[str, LawKind] = {
    **{name: light.KINDS[name] for name in ("brightness", "gamma", "flicker")},
    **{name: sensor.KINDS[name] for name in ("noise",)},
    **{name: glass.KINDS[name] for name in ("blur", "occlusion")},
    **weather.KINDS,
    **{name: light.KINDS[name] for name in ("night", "exposure", "dark", "blackout")},
    **motion.KINDS,
    **{name: glass.KINDS[name] for name in ("flare", "vignetting", "dirt")},
    **{name: sensor.KINDS[name] for name in ("jpeg", "resolution", "drop", "outage")},
    **{name: light.KINDS[name] for name in ("bias", "contrast")},
    **{name: sensor.KINDS[name] for name in ("shot", "impulse", "bits")},
    **stereo.KINDS,
    **inertial.KINDS,
}
"""vslam's own laws, in the order of the documentation."""


def all_laws() -> dict[str, LawKind]:
    """Return all laws (kinds of perturbation): those of vslam, followed by those of plug-ins.

    The strength of a plug-in's law is between 0 and 10.
    """
    others = {
        name: LawKind(make, "x", 1.0, 0.1, 10.0, "of another package", logarithmic=True)
        for name, make in plugin_laws().items()
        if name not in LAWS
    }
    return {**LAWS, **others}


def law_kind(name: str) -> LawKind:
    """Return the law (kind of perturbation) with a given name.

    Raises:
        KeyError: there is no such law.
    """
    return LAWS[name] if name in LAWS else all_laws()[name]
