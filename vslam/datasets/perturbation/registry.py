"""All laws by name."""

from __future__ import annotations

from vslam.datasets.perturbation import glass, light, motion, sensor, stereo, weather
from vslam.datasets.perturbation.kinds import LawKind
from vslam.datasets.plugin_laws import plugin_laws

LAWS: dict[str, LawKind] = {
    **{name: light.KINDS[name] for name in ("brightness", "gamma", "flicker")},
    **{name: sensor.KINDS[name] for name in ("noise",)},
    **{name: glass.KINDS[name] for name in ("blur", "occlusion")},
    **weather.KINDS,
    **{name: light.KINDS[name] for name in ("night", "exposure")},
    **motion.KINDS,
    **{name: glass.KINDS[name] for name in ("flare", "vignetting", "dirt")},
    **{name: sensor.KINDS[name] for name in ("jpeg", "resolution", "drop", "outage")},
    **{name: light.KINDS[name] for name in ("bias", "contrast")},
    **{name: sensor.KINDS[name] for name in ("shot", "impulse", "bits")},
    **stereo.KINDS,
}
"""vslam's own laws, in the order of the documentation."""


def all_laws() -> dict[str, LawKind]:
    """vslam's laws, then those of other packages (docs/howto/plugins.md), of strengths 0 to 10."""
    others = {
        name: LawKind(make, "x", 1.0, 0.1, 10.0, "of another package", logarithmic=True)
        for name, make in plugin_laws().items()
        if name not in LAWS
    }
    return {**LAWS, **others}


def law_kind(name: str) -> LawKind:
    """The law with this name.

    Raises:
        KeyError: there is none.
    """
    return LAWS[name] if name in LAWS else all_laws()[name]
