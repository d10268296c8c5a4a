"""All laws by name."""

from __future__ import annotations

from vslam.datasets.perturbation import glass, light, motion, sensor, stereo, weather
from vslam.datasets.perturbation.kinds import LawKind

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
"""In the order of the documents."""
