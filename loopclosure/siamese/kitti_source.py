"""Reads images of a KITTI sequence; its poses or a loop matrix define which show the same place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
from vslam.trajectory import read_kitti_poses, read_table

_FAR = 25.0  # images that are farther apart than this show different places, metres


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
    """Read left grey images of a KITTI sequence.

    Args:
        root: KITTI root.
        seq: name of the sequence.
        first, last: numbers of the first and the last image, both included.
        every: step between images; 2 takes every second one.
        frames: ranges of numbers, ``0-249+1500-1699``, instead of ``first`` and ``last``.
        truth: ``.mat`` file with a loop matrix of the whole sequence, which defines the same
            places. Other pairs show different places beyond 25 m and are unknown below.
        near: distance in metres, below 25, within which two images show the same place. Published
            loop matrices count images up to 20 m apart and more as the same place.

    Raises:
        InputError: there are no images in that range, no poses for them or no such matrix, or
            ``near`` is out of range, or the file of times does not fit.
    """
    base = root if (root / "sequences").is_dir() else root / "dataset"
    folder = base / "sequences" / seq / "image_0"
    spans = [span.split("-") for span in frames.split("+")] if frames else [[first, last]]
    wanted = [range(int(low), int(high) + 1, int(every)) for low, high in spans]
    files = [f for f in images_in(folder) if f.stem.isdecimal()]
    files = [f for f in files if any(int(f.stem) in span for span in wanted)]
    if len(files) < 2:
        numbers = frames or f"{first} to {last}"
        raise InputError(f"{folder}: no images numbered {numbers}; see docs/reference/datasets.md.")
    poses = read_kitti_poses(base / "poses" / f"{seq}.txt")
    number = np.array([int(f.stem) for f in files])
    if number[-1] >= len(poses):
        raise InputError(
            f"{base}/poses/{seq}.txt: has {len(poses)} poses and none for image {files[-1].stem}; "
            "use the file of this sequence."
        )
    T_wc = poses[number]
    steps = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    # Stretches of road of 100 m.
    stretch = (np.concatenate([[0.0], np.cumsum(steps)]) // 100.0).astype(np.int32)
    if not 0.0 < float(near) < _FAR:
        raise InputError(f"near={near}: must be above 0 and below {_FAR:g} m.")
    relation = relation_of_poses(T_wc, near=float(near))
    if truth:
        path = Path(truth).expanduser()
        loops = read_loop_matrix(path)
        if len(loops) <= number[-1]:
            raise InputError(
                f"{path}: has {len(loops)} rows and none for image {files[-1].stem}; use the "
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
    """Times in seconds of the images with these numbers; None if the sequence has no times."""
    if not path.exists():
        return None
    times = read_table(path, (1,), "a time")[:, 0]
    if len(times) <= number[-1] or (np.diff(times) < 0).any():
        raise InputError(
            f"{path}: times must ascend and reach image {number[-1]:06d}; use the file of this "
            "sequence."
        )
    return times[number]


def relation_of_poses(T_wc: NDArray[np.float64], near: float = 5.0) -> NDArray[np.int8]:
    """``(N, N)`` int8 relation of images by their ``(N, 4, 4)`` poses: the same place if less than
    ``near`` metres and 30 degrees apart, different places if more than 25 m apart, otherwise
    unknown."""
    centre, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    apart = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    cosine = forward @ forward.T
    relation = np.zeros(apart.shape, np.int8)
    relation[(apart < near) & (cosine > np.cos(np.radians(30.0)))] = SAME
    relation[apart > _FAR] = DIFFERENT
    np.fill_diagonal(relation, SAME)
    return relation
