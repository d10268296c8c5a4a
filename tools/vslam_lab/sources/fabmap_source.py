"""Reads the FAB-MAP image collections and their ground-truth matrices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vslam.support.errors import InputError
from vslam.types.trajectory import read_table
from vslam_lab.sources.image_source import (
    DIFFERENT,
    SAME,
    UNKNOWN,
    ImageSource,
    images_in,
    names_of,
    read_loop_matrix,
)

_UNDISTORT_COLUMNS = (8, 9)


def read_fabmap(folder: Path, truth: str = "", side: str = "left") -> list[ImageSource]:
    """Read a FAB-MAP collection, which is a folder of images and a ground-truth matrix.

    The matrix has one row for each image, or one row for each pair of images. In a pair, the left
    image has an odd number and the right image has an even number. If the folder has a file
    ``calibration.txt`` (fx fy cx cy k1 k2 p1 p2 [k3] on one line), the images are undistorted.

    Args:
        folder: folder of the images.
        truth: ``.mat`` file of the matrix. The default is the first ``.mat`` file in the folder.
        side: "left" or "right": the camera whose images are used if the matrix has one row for each
            pair.

    Raises:
        InputError: there are no images or no matrix, the number of rows does not match the number
            of images, or ``side`` is neither "left" nor "right".
    """
    if side not in ("left", "right"):
        raise InputError(f"side={side}: must be left or right.")
    files = images_in(folder)
    if not files:
        raise InputError(f"{folder}: no images; see docs/reference/datasets.md.")
    named = Path(truth).expanduser() if truth else None
    path = named or next(iter(sorted(folder.glob("*.mat"))), None)
    if path is None:
        raise InputError(
            f"{folder}: no ground-truth matrix; give one with fabmap:DIR[truth=FILE.mat]."
        )
    loops = read_loop_matrix(path)
    n = len(loops)
    if 2 * n == len(files):
        files = files[0 if side == "left" else 1 :: 2]
    if n != len(files):
        raise InputError(
            f"{path}: the matrix has {n} rows, but {folder} has {len(files)} images; give the "
            "matrix of this collection."
        )
    relation = np.where(loops | loops.T, SAME, DIFFERENT).astype(np.int8)
    index = np.arange(n)
    # The matrices do not mark the images just before and after an image, although the views
    # overlap.
    near_in_time = np.abs(index[:, None] - index[None]) <= 20
    relation[near_in_time & (relation == DIFFERENT)] = UNKNOWN
    np.fill_diagonal(relation, SAME)
    calibration = folder / "calibration.txt"
    model = (
        read_table(calibration, _UNDISTORT_COLUMNS, "a camera model")[0]
        if calibration.exists()
        else None
    )
    unit = (index // 60).astype(np.int32)
    name = folder.name
    return [ImageSource(name, name, names_of(files), tuple(files), relation, unit, model)]
