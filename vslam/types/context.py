"""The camera and the thresholds, which nearly every part of SLAM needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config, OrbConfig
from vslam.types.camera import Camera

# Replaces `motion_window` for an RGB-D camera, in pixels at octave 0. [OS1 V-B, customary]
_DEPTH_MOTION_WINDOW = 15.0
# Replaces `local_window` for an RGB-D camera, in pixels at octave 0. ORB-SLAM2 uses 7.5. [OS1
# V-D, own]
_DEPTH_LOCAL_WINDOW = 5.0
# Replaces `alignment.certainty` for an RGB-D camera. Its rolling shutter moves points by about half
# a pixel, which alignment does not correct. [own]
_DEPTH_CERTAINTY = 1


def scale_factors(config: OrbConfig) -> NDArray[np.float64]:
    """Return the ``(levels,)`` sizes of a pixel of each level, in pixels of the image."""
    return config.scale_factor ** np.arange(config.n_levels, dtype=np.float64)


@dataclass(frozen=True)
class Context:
    """The camera, the thresholds, and quantities that are derived from them.

    Attributes:
        scales: ``(levels,)`` pyramid scale factors.
        has_imu: whether an IMU is on the camera.
    """

    camera: Camera
    config: Config
    scales: NDArray[np.float64]
    has_imu: bool = False

    @classmethod
    def create(cls, camera: Camera, config: Config, *, has_imu: bool = False) -> Context:
        return cls(camera, config, scale_factors(config.orb), has_imu)

    @property
    def tracks_patches(self) -> bool:
        """Whether frames are tracked using image patches when possible.

        Patches make fewer keyframes. If nothing else tells the scale of one camera, it then drifts
        more (docs/research/performance.md).
        """
        method = self.config.tracking.method
        if method == "auto":
            return self.has_imu or not self.camera.monocular
        return method == "patches"

    def awaits_scale(self, *, metric: bool) -> bool:
        """Whether frames are tracked using features until the scale of one camera is known, because
        it is found sooner and better if it drifts less (``tracks_patches``).

        Args:
            metric: whether the unit of the map is the metre.
        """
        return self.config.tracking.method == "auto" and self.camera.monocular and not metric

    @property
    def aligned_certainty(self) -> int:
        """Variance of a keypoint's position, divided by that of an aligned match or patch."""
        return _DEPTH_CERTAINTY if self.camera.depth else self.config.alignment.certainty

    @property
    def close_depth(self) -> float:
        """Depth below which a stereo point is close, in metres (ORB-SLAM2 paper, section III-A)."""
        return self.config.stereo.close_depth_baselines * self.camera.baseline

    @property
    def motion_window(self) -> float:
        """Search radius at octave 0 around points that the previous frame observed, in pixels."""
        config = self.config.tracking
        return _DEPTH_MOTION_WINDOW if self.camera.depth else config.motion_window

    @property
    def local_window(self) -> float:
        """Search radius at octave 0 around landmarks of the local map, in pixels."""
        config = self.config.tracking
        return _DEPTH_LOCAL_WINDOW if self.camera.depth else config.local_window
