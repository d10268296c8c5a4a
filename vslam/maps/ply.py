"""Landmarks as a PLY file, for viewers of point clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def save_ply(path: Path, xyz: NDArray[np.float64]) -> None:
    """Write ``(N, 3)`` points (world, metres) as binary PLY."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(xyz)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        file.write(np.ascontiguousarray(xyz, "<f4").tobytes())
