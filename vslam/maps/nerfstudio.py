"""A data set for nerfstudio (https://docs.nerf.studio/quickstart/data_conventions.html).

Cameras look along -z with y up (OpenGL), ``transform_matrix`` is camera to world, and the world's z
axis points up. Pixel coordinates begin at the corner of the image, as in COLMAP: nerfstudio's rays
go through ``column + 0.5`` (``Cameras.get_image_coords``), although its documentation suggests
(0, 0).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.ply import save_ply
from vslam.maps.reconstruction import PIXEL_CENTRE, Reconstruction

POINTS = "sparse_pc.ply"
# The axes of nerfstudio's world point right, forward and up as seen from the first camera.
T_SAVED_WORLD = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
T_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def save_nerfstudio(
    folder: Path | str,
    reconstruction: Reconstruction,
    names: list[str],
    colours: NDArray[np.uint8],
) -> None:
    """Write ``transforms.json`` and the landmarks as ``sparse_pc.ply``.

    ``applied_transform`` maps vslam's world to the world of both files.

    Args:
        folder: an existing folder.
        names: path of each keyframe's image, relative to the folder.
        colours: ``(L, 3)`` RGB of each landmark.

    Raises:
        OSError: a file cannot be written.
    """
    camera = reconstruction.camera
    poses = T_SAVED_WORLD @ reconstruction.T_wc @ T_CAMERA_OPENGL
    content = {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        "w": camera.width,
        "h": camera.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "applied_transform": T_SAVED_WORLD[:3].tolist(),
        "ply_file_path": POINTS,
        "frames": [
            {"file_path": name, "transform_matrix": pose.tolist()}
            for name, pose in zip(names, poses, strict=True)
        ],
    }
    folder = Path(folder)
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n")
    save_ply(folder / POINTS, reconstruction.xyz @ T_SAVED_WORLD[:3, :3].T, colours)
