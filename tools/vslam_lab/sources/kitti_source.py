"""Reads the images of a KITTI sequence as an image source.

The poses of the sequence, or a loop matrix, determine which images show the same place.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam.types.trajectory import read_kitti_poses, read_table
from vslam_lab.sources.image_source import (
    DIFFERENT,
    SAME,
    UNKNOWN,
    ImageSource,
    images_in,
    names_of,
    read_loop_matrix,
)

_FAR = 25.0  # distance beyond which two images show different places, metres


def read_kitti(
    root: Path,
    seq: str = "00",
    first: str = "0",
    last: str = "1000000",
    every: str = "1",
    frames: str = "",
    truth: str = "",
    near: str = "5",
) -> list[ImageSource]:
    """Read the left grey images of a KITTI sequence.

    Args:
        root: root folder of the KITTI dataset.
        seq: name of the sequence.
        first, last: numbers of the first and the last image, both included.
        every: step between images. With 2, every second image is used.
        frames: ranges of image numbers, such as ``0-249+1500-1699``. They replace ``first`` and
            ``last``.
        truth: ``.mat`` file with a loop matrix of the whole sequence. The matrix marks the pairs of
            images that show the same place. The images of an unmarked pair show different places if
            they are more than 25 m apart. Otherwise, their relation is unknown.
        near: distance in metres, below 25, within which two images show the same place. Published
            loop matrices also mark pairs of images that are 20 m or more apart.

    Raises:
        InputError: the range contains no images, images have no poses, ``every``, ``frames`` or
            ``near`` is out of range or malformed, or the matrix or the times do not belong to the
            sequence.
    """
    if int(every) < 1:
        raise InputError(f"every={every}: must be at least 1.")
    if frames and not re.fullmatch(r"\d+-\d+(\+\d+-\d+)*", frames):
        raise InputError(f"frames={frames}: must be ranges, such as 0-249+1500-1699.")
    base = root if (root / "sequences").is_dir() else root / "dataset"
    folder = base / "sequences" / seq / "image_0"
    spans = [span.split("-") for span in frames.split("+")] if frames else [[first, last]]
    ranges = [range(int(low), int(high) + 1, int(every)) for low, high in spans]
    files = [f for f in images_in(folder) if f.stem.isdecimal()]
    files = [f for f in files if any(int(f.stem) in span for span in ranges)]
    if len(files) < 2:
        numbers = frames or f"{first} to {last}"
        raise InputError(f"{folder}: no images numbered {numbers}; see docs/reference/datasets.md.")
    poses = read_kitti_poses(base / "poses" / f"{seq}.txt")
    number = np.array([int(f.stem) for f in files])
    if number[-1] >= len(poses):
        raise InputError(
            f"{base}/poses/{seq}.txt: has only {len(poses)} poses, none for image "
            f"{files[-1].stem}; use the file of this sequence."
        )
    T_wc = poses[number]
    steps = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    # Images of one 100 m stretch of road are not split between training and validation.
    stretch = (np.concatenate([[0.0], np.cumsum(steps)]) // 100.0).astype(np.int32)
    if not 0.0 < float(near) < _FAR:
        raise InputError(f"near={near}: must be above 0 and below {_FAR:g} m.")
    relation = relation_of_poses(T_wc, near=float(near))
    if truth:
        path = Path(truth).expanduser()
        loops = read_loop_matrix(path)
        if len(loops) <= number[-1]:
            raise InputError(
                f"{path}: has only {len(loops)} rows, none for image {files[-1].stem}; use the "
                "matrix of this sequence."
            )
        marked = loops[np.ix_(number, number)]
        relation[relation == SAME] = UNKNOWN
        relation[marked | marked.T] = SAME
        np.fill_diagonal(relation, SAME)
    name = f"kitti{seq}"
    source = ImageSource(name, name, names_of(files), tuple(files), relation, stretch)
    return [replace(source, times=_times(folder.parent / "times.txt", number))]


def _times(path: Path, number: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Read the capture times in seconds. Returns None if there is no file of times."""
    if not path.exists():
        return None
    times = read_table(path, (1,), "a time")[:, 0]
    if len(times) <= number[-1] or (np.diff(times) < 0).any():
        raise InputError(
            f"{path}: the times must ascend and include image {number[-1]:06d}; use the file of "
            "this sequence."
        )
    return times[number]


def relation_of_poses(T_wc: NDArray[np.float64], near: float = 5.0) -> NDArray[np.int8]:
    """Determine from ``(N, 4, 4)`` poses which images show the same place. Returns the ``(N, N)``
    int8 relation (see ``ImageSource``).

    Two images show the same place if they are less than ``near`` metres apart and their viewing
    directions differ by less than 30 degrees. Two images show different places if they are more
    than 25 m apart. Otherwise, the relation is unknown.
    """
    centre, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    cosine = forward @ forward.T
    relation = np.zeros(distance.shape, np.int8)
    relation[(distance < near) & (cosine > np.cos(np.radians(30.0)))] = SAME
    relation[distance > _FAR] = DIFFERENT
    np.fill_diagonal(relation, SAME)
    return relation
