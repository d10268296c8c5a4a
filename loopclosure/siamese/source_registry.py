"""Sources of images by name: what the networks learn from and what detectors are compared on.

A source is one set of images with a matrix that says for each pair: same place (1), another place
(-1), or not known and never used (0). Images of different sources show different places, unless
the sources are of one family (the same region photographed twice): then nothing is known.

A source is named on the command line as ``KIND:PATH``, or ``KIND:PATH[option=value,...]``. The
kinds and their options:

``kitti:DIR``: left grey images of a KITTI sequence with ground-truth poses (`kitti_source`).
    ``seq``: the sequence, 00 without it.
    ``first``, ``last``: numbers of the first and the last image, all images without them.
    ``every``: 2 for every second image.
    ``frames``: ranges of numbers in place of first and last, ``frames=0-249+1500-1699``.
    ``near``: metres within which two images show one place, 5 without it.
    ``truth``: ``.mat`` file with a matrix of loops, which then says what is the same place.
``fabmap:DIR``: Oxford CityCentre or NewCollege, Cummins and Newman 2008, or other images in order
    with a matrix, as Lip6's (`fabmap_source`).
    ``truth``: ``.mat`` file with the matrix of loops, the first one in the folder without it.
    ``side``: ``left`` or ``right`` camera, where the matrix has one row for both; left without it.
``pairs:DIR``: what ``vslam synth --pairs`` wrote (`pairs_source`); no options.
``photos:DIR``: folders of photographs with a NOTES.txt (`photo_source`); no options.
``pack:FILE.npz``: what ``vslam export places`` wrote of any of these (`pack`); no options.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from vslam.errors import InputError
from vslam.loopclosure.siamese.fabmap_source import read_fabmap
from vslam.loopclosure.siamese.image_source import ImageSource
from vslam.loopclosure.siamese.kitti_source import read_kitti
from vslam.loopclosure.siamese.pack import read_pack
from vslam.loopclosure.siamese.pairs_source import read_pairs
from vslam.loopclosure.siamese.photo_source import read_photos

# Of each kind: its reader and the names of its options.
_READERS: dict[str, tuple[Callable[..., list[ImageSource]], tuple[str, ...]]] = {
    "kitti": (read_kitti, ("seq", "first", "last", "every", "frames", "truth", "near")),
    "fabmap": (read_fabmap, ("truth", "side")),
    "pairs": (read_pairs, ()),
    "photos": (read_photos, ()),
    "pack": (read_pack, ()),
}


def split_spec(spec: str) -> tuple[str, str, dict[str, str]]:
    """``kind:path[key=value,...]`` in its parts; no path where it is spelled otherwise."""
    kind, _, rest = spec.partition(":")
    found = re.fullmatch(r"(.+?)(?:\[(.*)\])?", rest)
    if found is None:
        return kind, "", {}
    items = (item.split("=", 1) for item in (found[2] or "").split(",") if "=" in item)
    return kind, found[1], dict(items)


def open_source(spec: str) -> list[ImageSource]:
    """Open ``kind:path[options]``, see the module.

    Raises:
        InputError: unknown kind or option, or data that is missing or malformed.
    """
    kind, path, options = split_spec(spec)
    if kind not in _READERS or not path:
        raise InputError(
            f"--data {spec}: must be KIND:PATH, with one of the kinds {', '.join(_READERS)}."
        )
    reader, known = _READERS[kind]
    if wrong := [key for key in options if key not in known]:
        choice = f"choose from {', '.join(known)}" if known else "this kind takes none"
        raise InputError(f"--data {spec}: unknown option '{wrong[0]}'; {choice}.")
    try:
        return reader(Path(path).expanduser(), **options)
    except ValueError as error:
        raise InputError(f"--data {spec}: an option is not a number.") from error
