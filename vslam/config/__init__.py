"""All thresholds of the pipeline, with one module for each stage.

docs/reference/thresholds.md is generated from these modules.
"""

from __future__ import annotations

from pathlib import Path

from vslam.config.closing import LoopConfig, PoseGraphConfig
from vslam.config.depth import DepthConfig, StereoConfig
from vslam.config.detection import BowConfig, SiameseConfig
from vslam.config.extraction import OrbConfig, WeakImageConfig
from vslam.config.initialization import InitializationConfig
from vslam.config.keyframes import KeyframeConfig
from vslam.config.mapping import MappingConfig
from vslam.config.relocalization import RelocalizationConfig
from vslam.config.section import Section, read_json
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
    "load_config",
]


class Config(Section):
    """The whole configuration: each run writes it to ``config.json``, and --config reads it."""

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


def load_config(path: Path | str) -> Config:
    """Read a configuration from a JSON file; keys that it omits keep their defaults.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    return read_json(Config, Path(path), "configuration")
