"""Turns the world of an export until its z axis points up. The map itself is never turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vslam.maps.reconstruction import Reconstruction
from vslam.types.geometry import Matrix, inverse, transform

# The axes of an upright world frame point right, forward and up, as seen from a level camera.
T_UPRIGHT_CAMERA = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def level_world(gravity: Matrix, T_upright_camera: Matrix = T_UPRIGHT_CAMERA) -> Matrix:
    """Return ``(4, 4)`` ``T_level_world``, a rotation into a frame whose z axis points up.

    Its other two axes are those of an upright world frame, after the smallest turn that makes z
    point up.

    Args:
        gravity: ``(3,)`` acceleration of free fall in the world frame of the map.
        T_upright_camera: the upright world frame, whose z axis points up for a level camera.
    """
    x, y, z = -(T_upright_camera[:3, :3] @ gravity) / np.linalg.norm(gravity)
    T = np.eye(4)
    if z < -1.0 + 1e-9:  # upside down: no turn is the smallest, so the camera is rolled
        T[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    else:  # Rodrigues' formula about the axis (y, -x, 0), whose length is the sine of the angle
        T[:3, :3] = [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y],
            [x, y, z],
        ]
    level: Matrix = T @ T_upright_camera
    return level


def turned(reconstruction: Reconstruction, T_new_world: Matrix) -> Reconstruction:
    """Return a map in another world frame.

    Args:
        T_new_world: ``(4, 4)``, maps points of the present world frame to the new one.
    """
    T_cw = reconstruction.T_cw @ inverse(T_new_world)
    return replace(reconstruction, T_cw=T_cw, xyz=transform(T_new_world, reconstruction.xyz))
