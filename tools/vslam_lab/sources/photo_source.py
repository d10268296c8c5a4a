"""Reads sets of photographs. The folders and a file NOTES.txt determine which photographs show the
same place."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vslam.support.errors import InputError
from vslam_lab.sources.image_source import (
    DIFFERENT,
    SAME,
    UNKNOWN,
    ImageSource,
    images_in,
    names_of,
)

_STRETCH = 25  # consecutive video frames that are not split between training and validation
_UNLIMITED = 1_000_000


@dataclass(frozen=True)
class _SpecialSet:
    """Properties of a set of photographs, copied from the notes of the set.

    Attributes:
        reach: photographs of a folder show the same place if their positions in the sorted folder
            differ by at most this number. None if all photographs of a folder show the same place.
        region: maps the name of a folder to a region. Relations between folders of the same region
            are unknown.
        family: family that the set belongs to, see ``ImageSource``.
        singles: folders whose photographs are unrelated to each other.
    """

    reach: int | None = None
    region: Callable[[str], str] | None = None
    family: str | None = None
    singles: tuple[str, ...] = ()


_SPECIAL_SETS = {
    # The camera rotates on the spot. Photographs far apart in the sorted folder do not overlap.
    "pano_rotation": _SpecialSet(reach=1, family="landmarks"),
    # Photographs of one folder show opposite walls of a yard.
    "strecha": _SpecialSet(reach=3, family="landmarks"),
    # Each folder contains the views of one walk in one direction. The walks overlap at their ends.
    "pano360": _SpecialSet(reach=2, region=lambda folder: folder.split("_")[0]),
    # The folders are several passes along the same floor of a building.
    "ie_tower": _SpecialSet(reach=1, region=lambda folder: folder.split("__")[0]),
    # The views in each folder were cut from one panorama.
    "webcams": _SpecialSet(region=lambda folder: folder.split("_")[0]),
    "multiview": _SpecialSet(reach=4, family="landmarks"),
    "wxbs_evd": _SpecialSet(family="landmarks"),
    "stitch_pairs": _SpecialSet(reach=2, family="landmarks"),
    "megadepth_landmarks": _SpecialSet(family="landmarks"),
    # Some buildings appear twice.
    "landmarks_misc": _SpecialSet(region=lambda folder: folder, family="landmarks"),
    "sf_toy": _SpecialSet(region=lambda _: "", singles=("single",)),
    "camvid": _SpecialSet(region=lambda _: ""),
    "highway_us": _SpecialSet(region=lambda _: "", singles=("udacity_stills", "tusimple_stills")),
    "freiburg_bonn_stills": _SpecialSet(singles=("stills",)),
    "kitti_city_pedestrian": _SpecialSet(family="kitti"),
    "kitti_sfnd": _SpecialSet(family="kitti"),
}


def read_photos(folder: Path) -> list[ImageSource]:
    """Read sets of photographs. The photographs of a set are the files ``folder/SET/SUBFOLDER/*``,
    and the notes of the set are in ``folder/SET/NOTES.txt``.

    The first line of the notes states the kind of the set. In a set of kind (a), each subfolder
    shows one place. In a set of kind (b), each subfolder is a video whose consecutive frames
    overlap. In a set of kind (c), the photographs are unrelated.

    Raises:
        InputError: there is no set of photographs, or the notes do not state the kind.
    """
    notes = sorted(folder.glob("*/NOTES.txt")) or sorted(folder.glob("NOTES.txt"))
    if not notes:
        raise InputError(
            f"{folder}: no set of photographs (SET/NOTES.txt); see docs/reference/datasets.md."
        )
    return [_read_photo_set(path.parent) for path in notes]


def _read_photo_set(folder: Path) -> ImageSource:
    first_line = (folder / "NOTES.txt").read_text(errors="replace").partition("\n")[0]
    found = re.search(r"kind \((a/b|a|b|c)\)", first_line)
    if found is None:
        raise InputError(
            f"{folder}/NOTES.txt: the first line must state the kind of the set: (a), (b) or (c)."
        )
    kind = found[1]
    special = _SPECIAL_SETS.get(folder.name, _SpecialSet())
    reach_of_set = special.reach if special.reach is not None else _UNLIMITED
    files: list[Path] = []
    rows: list[tuple[int, int, int, int]] = []  # folder, position, reach, unit
    regions: list[str] = []
    for number, subfolder in enumerate(sorted(p for p in folder.iterdir() if p.is_dir())):
        single = kind == "c" or subfolder.name in special.singles
        reach = 0 if single else reach_of_set if kind == "a" else 1
        stretch = 1 if single else _UNLIMITED if kind == "a" else _STRETCH
        for k, file in enumerate(images_in(subfolder)):
            files.append(file)
            rows.append((number, k, reach, number * 10_000 + k // stretch))
            regions.append(special.region(subfolder.name) if special.region else "")
    if not files:
        raise InputError(f"{folder}: no photographs in its subfolders; restore them.")
    number, position, reach, unit = np.array(rows).T
    same_folder = number[:, None] == number[None]
    relation = np.full(same_folder.shape, DIFFERENT, np.int8)
    if special.region is not None:
        _, region = np.unique(regions, return_inverse=True)
        relation[region[:, None] == region[None]] = UNKNOWN
    if kind != "c":
        relation[same_folder] = UNKNOWN
    difference = np.abs(position[:, None] - position[None])
    relation[same_folder & (difference <= reach)] = SAME
    family = special.family or folder.name
    return ImageSource(
        folder.name, family, names_of(files), tuple(files), relation, unit.astype(np.int32)
    )
