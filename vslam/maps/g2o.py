"""Pose graphs in g2o's text format (https://github.com/RainerKuemmerle/g2o/wiki/File-Format)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def save_g2o(
    path: Path | str,
    ids: NDArray[np.int64],
    T_wc: NDArray[np.float64],
    edges: NDArray[np.int64],
    T_i_j: NDArray[np.float64],
    sigmas: NDArray[np.float64],
) -> None:
    """Write ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT`` lines, each with x y z qx qy qz qw. An edge
    also has the upper triangle of its information matrix, row by row, translation first.

    The information of rotations is per square radian, as GTSAM, Ceres' examples and SE-Sync read
    it. g2o itself measures rotations by qx qy qz, which are half as large for small angles, and so
    gives them a quarter of the weight.

    Args:
        ids: ``(N,)`` ids of the vertices.
        T_wc: ``(N, 4, 4)`` their poses.
        edges: ``(E, 2)`` ends i and j of each edge, as positions in ``ids``.
        T_i_j: ``(E, 4, 4)`` measured pose of j in the frame of i.
        sigmas: ``(E, 2)`` standard deviations, translation (m) and rotation (rad), of each axis.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [
        f"VERTEX_SE3:QUAT {vertex} {_words(values)}\n"
        for vertex, values in zip(ids.tolist(), _poses(T_wc).tolist(), strict=True)
    ]
    information = 1.0 / np.repeat(sigmas, 3, axis=1) ** 2
    upper = np.triu_indices(6)
    for ends, values, diagonal in zip(
        ids[edges].tolist(), _poses(T_i_j).tolist(), information, strict=True
    ):
        triangle = np.diag(diagonal)[upper].tolist()
        lines.append(f"EDGE_SE3:QUAT {ends[0]} {ends[1]} {_words(values)} {_words(triangle)}\n")
    Path(path).write_text("".join(lines))


def _poses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(N, 7)`` x y z qx qy qz qw with qw >= 0."""
    from scipy.spatial.transform import Rotation

    if not len(T):  # SciPy refuses an empty array
        return np.empty((0, 7))
    return np.column_stack(
        [T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True)]
    )


def _words(values: list[float]) -> str:
    return " ".join(f"{value:.15g}" for value in values)
