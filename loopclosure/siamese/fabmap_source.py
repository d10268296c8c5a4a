"""Images of the FAB-MAP collections; their ground-truth matrices tell which show one place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vslam.errors import InputError
from vslam.loopclosure.siamese.image_source import (
    DIFFERENT,
    SAME,
    UNKNOWN,
    ImageSource,
    images_in,
    names_of,
    read_loop_matrix,
)
from vslam.trajectory import read_table

_UNDISTORT_COLUMNS = (8, 9)


def read_fabmap(folder: Path, truth: str = "", side: str = "left") -> list[ImageSource]:
    """Images of one of the FAB-MAP collections with its ground-truth matrix.

    The matrix has a row for each image, or one for each pair of left and right images (odd and
    even numbers): then the images of one camera are taken. A ``calibration.txt`` in the folder (fx
    fy cx cy k1 k2 p1 p2 [k3] on one line) has the images undistorted.

    Raises:
        InputError: no images, no matrix, or sizes that do not belong together.
    """
    files = images_in(folder)
    if not files:
        raise InputError(f"{folder}: no images; see datasets.md.")
    named = Path(truth).expanduser() if truth else None
    path = named or next(iter(sorted(folder.glob("*.mat"))), None)
    if path is None:
        raise InputError(f"{folder}: no ground-truth matrix; name it: fabmap:DIR[truth=FILE.mat].")
    loops = read_loop_matrix(path)
    n = len(loops)
    if 2 * n == len(files):
        files = files[0 if side == "left" else 1 :: 2]
    if n != len(files):
        raise InputError(
            f"{path}: a matrix of {n} rows does not belong to {len(files)} images in {folder}; "
            "take the matrix of this collection."
        )
    relation = np.where(loops | loops.T, SAME, DIFFERENT).astype(np.int8)
    index = np.arange(n)
    # The matrices leave out the images just before and after, which overlap all the same.
    beside = np.abs(index[:, None] - index[None]) <= 20
    relation[beside & (relation == DIFFERENT)] = UNKNOWN
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
