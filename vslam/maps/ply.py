"""Landmarks as a PLY file, for viewers of point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def save_ply(
    path: Path | str, xyz: NDArray[np.float64], colours: NDArray[np.uint8] | None = None
) -> None:
    """Write ``(N, 3)`` points (world, metres) as binary PLY, with ``(N, 3)`` uint8 RGB colours."""
    fields = [("xyz", "<f4", 3)]
    properties = [f"property float {axis}\n" for axis in "xyz"]
    if colours is not None:
        fields.append(("rgb", "u1", 3))
        properties += [f"property uchar {channel}\n" for channel in ("red", "green", "blue")]
    vertices = np.empty(len(xyz), fields)
    vertices["xyz"] = xyz
    if colours is not None:
        vertices["rgb"] = colours
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(xyz)}\n{''.join(properties)}end_header\n"
    )
    with Path(path).open("wb") as file:
        file.write(header.encode())
        file.write(vertices.tobytes())
