"""Reads pairs of images that ``vslam synth --pairs`` rendered.

The camera poses determine whether images of different pairs show the same place.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError
from vslam_lab.sources.image_source import DIFFERENT, SAME, ImageSource, names_of

_VIEW = ("x_a", "z_a", "yaw_a", "x_b", "z_b", "yaw_b")
# Side of the square cells that a rendered town is divided into, metres. The images of one cell are
# not split between training and validation.
_CELL = 80.0


def read_pairs(folder: Path) -> list[ImageSource]:
    """Read rendered pairs of images from a folder that contains a file ``pairs.csv``.

    The file must have the columns a and b (image files) and same (1 or 0). It may also have the
    columns x_a, z_a, yaw_a, x_b, z_b, yaw_b (metres, degrees). From these columns,
    ``relation_of_views`` determines whether images of different pairs show the same place. Without
    these columns, the relation of such images is unknown.

    Raises:
        InputError: the file is missing, malformed or empty.
    """
    path = folder / "pairs.csv"
    try:
        with path.open(newline="") as file:
            rows = [(row["a"], row["b"], int(row["same"]), row) for row in csv.DictReader(file)]
        has_poses = bool(rows) and set(_VIEW) <= set(rows[0][3])
        poses = [[float(row[key]) for key in _VIEW] for *_, row in rows] if has_poses else []
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: missing or not a list of pairs with the columns a, b and same; write it with "
            "'vslam synth --pairs'."
        ) from error
    if not rows:
        raise InputError(f"{path}: contains no pair; write it again with 'vslam synth --pairs'.")
    number: dict[str, int] = {}
    for a, b, *_ in rows:
        number.setdefault(a, len(number))
        number.setdefault(b, len(number))
    relation = np.zeros((len(number), len(number)), np.int8)
    unit = np.zeros(len(number), np.int32)
    if has_poses:
        views = np.zeros((len(number), 3))
        for (a, b, *_), pose in zip(rows, poses, strict=True):
            views[[number[a], number[b]]] = np.array(pose).reshape(2, 3)
        relation = relation_of_views(views)
        cell = np.floor(views[:, :2] / _CELL).astype(np.int64)
        unit = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
    for k, (a, b, same, _) in enumerate(rows):
        i, j = number[a], number[b]
        relation[i, j] = relation[j, i] = SAME if same else DIFFERENT
        if not has_poses:
            unit[i] = unit[j] = k
    np.fill_diagonal(relation, SAME)
    files = tuple(folder / name for name in number)
    is_query = np.isin([*number], [b for _, b, *_ in rows])
    return [
        ImageSource(
            folder.name, folder.name, names_of(files), files, relation, unit, is_query=is_query
        )
    ]


def relation_of_views(views: NDArray[np.float64]) -> NDArray[np.int8]:
    """Determine from camera poses which images show the same place. Returns the ``(N, N)`` int8
    relation (see ``ImageSource``).

    Two images show the same place if they are less than 5 m apart and their viewing directions
    differ by less than 35 degrees. Two images show different places if they are more than 40 m
    apart and do not look along the same street. Otherwise, the relation is unknown.

    Two cameras look along the same street if three conditions are met. Their viewing directions are
    similar or opposite. The cameras are less than 160 m apart. One camera is less than 25 m to the
    side of the line of sight of the other camera.

    Args:
        views: ``(N, 3)`` x and z in metres, and yaw in degrees from z towards x.
    """
    xz, yaw = views[:, :2], np.radians(views[:, 2])
    direction = np.stack([np.sin(yaw), np.cos(yaw)], 1)
    offset = xz[None] - xz[:, None]
    distance = np.linalg.norm(offset, axis=2)
    x, z = direction[:, None, 0], direction[:, None, 1]
    lateral = np.abs(offset[..., 0] * z - offset[..., 1] * x)
    cosine = direction @ direction.T
    same_street = (np.abs(cosine) > 0.7) & (lateral < 25.0) & (distance < 160.0)
    relation = np.zeros(distance.shape, np.int8)
    relation[(distance < 5.0) & (cosine > np.cos(np.radians(35.0)))] = SAME
    relation[(distance > 40.0) & ~(same_street | same_street.T)] = DIFFERENT
    return relation
