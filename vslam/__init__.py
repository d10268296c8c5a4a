"""vslam: visual SLAM in pure Python.

>>> from vslam import Slam
>>> slam = Slam(camera)
>>> result = slam.step(left, right, timestamp)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from vslam.method.version import METHOD_VERSION
from vslam.support.untrusted import limit_images

__version__ = "0.1.0"
__all__ = ["METHOD_VERSION", "Camera", "Slam", "TrackResult", "TrackingState", "__version__"]

_MODULES = {
    "Slam": "vslam.slam",
    "Camera": "vslam.types.camera",
    "TrackResult": "vslam.types.features",
    "TrackingState": "vslam.types.features",
}

limit_images()

if TYPE_CHECKING:
    from vslam.slam import Slam
    from vslam.types.camera import Camera
    from vslam.types.features import TrackingState, TrackResult


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``vslam --help`` starts quickly."""
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'vslam' has no attribute {name!r}")
