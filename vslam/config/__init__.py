"""All thresholds of the pipeline, with one module for each stage.

docs/reference/thresholds.md is generated from these modules.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import model_validator

from vslam.config.closing import LoopConfig, PoseGraphConfig
from vslam.config.depth import DepthConfig, StereoConfig
from vslam.config.detection import BowConfig, SiameseConfig
from vslam.config.extraction import OrbConfig, WeakImageConfig
from vslam.config.initialization import InitializationConfig
from vslam.config.keyframes import KeyframeConfig
from vslam.config.mapping import MappingConfig
from vslam.config.relocalization import RelocalizationConfig
from vslam.config.section import Section, checked, read_json
from vslam.config.tracking import AlignmentConfig, TrackingConfig
from vslam.config.verification import (
    ConsistencyConfig,
    LearnedMatchingConfig,
    VerificationConfig,
)

__all__ = [
    "AlignmentConfig",
    "BowConfig",
    "Config",
    "ConsistencyConfig",
    "DepthConfig",
    "InitializationConfig",
    "KeyframeConfig",
    "LearnedMatchingConfig",
    "LoopConfig",
    "MappingConfig",
    "OrbConfig",
    "PoseGraphConfig",
    "RelocalizationConfig",
    "SiameseConfig",
    "StereoConfig",
    "TrackingConfig",
    "VerificationConfig",
    "WeakImageConfig",
    "as_config",
    "changed_thresholds",
    "load_config",
    "thresholds_in_words",
]


class Config(Section):
    """The whole configuration: each run writes it to ``config.json``, and --config reads it.

    A threshold has a dotted name, too: ``{"orb.n_features": 1000}`` is read like
    ``{"orb": {"n_features": 1000}}``.
    """

    orb: OrbConfig = OrbConfig()
    weak_images: WeakImageConfig = WeakImageConfig()
    stereo: StereoConfig = StereoConfig()
    depth: DepthConfig = DepthConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    tracking: TrackingConfig = TrackingConfig()
    initialization: InitializationConfig = InitializationConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    verification: VerificationConfig = VerificationConfig()
    learned: LearnedMatchingConfig = LearnedMatchingConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    loops: LoopConfig = LoopConfig()
    bow: BowConfig = BowConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    siamese: SiameseConfig = SiameseConfig()

    @model_validator(mode="before")
    @classmethod
    def _nest(cls, given: Any) -> Any:
        """Move thresholds given by their dotted names into their sections."""
        if not isinstance(given, dict):
            return given
        nested = {name: value for name, value in given.items() if "." not in str(name)}
        for name in [name for name in given if name not in nested]:
            section, _, key = name.partition(".")
            values = nested.get(section, {})
            if isinstance(values, dict):
                nested[section] = {**values, key: given[name]}
            else:
                nested[name] = given[name]  # refused as an unknown key
        return nested


def load_config(path: Path | str) -> Config:
    """Read a configuration from a JSON file; keys that it omits keep their defaults.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    return read_json(Config, Path(path), "configuration")


def as_config(given: Config | Mapping[str, Any], where: str = "config") -> Config:
    """Thresholds from a dictionary like the content of ``config.json``.

    Args:
        given: those that it omits keep their defaults; a ``Config`` is returned as it is.
        where: where they come from, for the messages.

    Raises:
        InputError: a key is unknown, or a value is out of range.
    """
    return checked(Config, given, where, "configuration")


def changed_thresholds(config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The thresholds of a ``config.json`` that differ from the defaults, by dotted name.

    Args:
        config: thresholds by section; the file may be that of another version.
    """
    default = Config().model_dump()
    return {
        f"{section}.{name}": value
        for section, values in config.items()
        for name, value in values.items()
        if name not in default.get(section, {}) or value != default[section][name]
    }


def thresholds_in_words(changed: Mapping[str, Any], most: int = 3) -> str:
    """``orb.n_features=1000, 2 more in config.json``: at most so many by name."""
    words = [f"{name}={value}" for name, value in changed.items()]
    more = [f"{len(words) - most} more in config.json"] if len(words) > most else []
    return ", ".join(words[:most] + more)
