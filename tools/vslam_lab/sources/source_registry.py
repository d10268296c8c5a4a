"""Opens sources of images by name. The sources are used to train networks and to compare loop
detectors.

A source is a set of images with a matrix. For each pair of images, the matrix states what the
images show: the same place (1), different places (-1), or unknown (0). Unknown pairs are never
used.

Images of different sources show different places, unless the sources belong to the same family.
Between sources of the same family, the relation is unknown. An example of a family is two sets of
photographs of the same region.

On the command line, a source is named ``KIND:PATH`` or ``KIND:PATH[option=value,...]``. The kinds
and their options are:

``kitti:DIR``: left grey images of a KITTI sequence with ground-truth poses (``kitti_source``).
    ``seq``: the sequence; the default is 00.
    ``first``, ``last``: numbers of the first and the last image; the default is all images.
    ``every``: step between images; with 2, every second image is used.
    ``frames``: ranges of image numbers that replace first and last: ``frames=0-249+1500-1699``.
    ``near``: distance in metres within which two images show the same place; the default is 5.
    ``truth``: ``.mat`` file with a loop matrix, which marks the pairs that show the same place.
``fabmap:DIR``: Oxford CityCentre or NewCollege (Cummins and Newman 2008), or another ordered set of
    images with a loop matrix, for example the sets of Lip6 (``fabmap_source``).
    ``truth``: ``.mat`` file with the loop matrix; the default is the first one in the folder.
    ``side``: ``left`` or ``right``. This camera is used if the matrix has one row for each pair;
    the default is left.
``pairs:DIR``: output of ``vslam synth --pairs`` (``pairs_source``). It has no options.
``photos:DIR``: folders of photographs with a NOTES.txt (``photo_source``). It has no options.
``pack:FILE.npz``: output of ``vslam export places`` (``pack``). It has no options.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from vslam.support.errors import InputError, did_you_mean
from vslam_lab.sources.fabmap_source import read_fabmap
from vslam_lab.sources.image_source import ImageSource
from vslam_lab.sources.kitti_source import read_kitti
from vslam_lab.sources.pack import read_pack
from vslam_lab.sources.pairs_source import read_pairs
from vslam_lab.sources.photo_source import read_photos

# The reader of each kind and the names of its options.
_READERS: dict[str, tuple[Callable[..., list[ImageSource]], tuple[str, ...]]] = {
    "kitti": (read_kitti, ("seq", "first", "last", "every", "frames", "truth", "near")),
    "fabmap": (read_fabmap, ("truth", "side")),
    "pairs": (read_pairs, ()),
    "photos": (read_photos, ()),
    "pack": (read_pack, ()),
}


def split_spec(spec: str) -> tuple[str, str, dict[str, str]]:
    """Split ``kind:path[key=value,...]`` into kind, path and options. The path is empty if the text
    does not have this form.

    Raises:
        InputError: an option has no value.
    """
    kind, _, rest = spec.partition(":")
    found = re.fullmatch(r"(.+?)(?:\[(.*)\])?", rest)
    if found is None:
        return kind, "", {}
    options = {}
    for item in filter(None, (found[2] or "").split(",")):
        key, equals, value = item.partition("=")
        if not equals:
            raise InputError(f"--data {spec}: the option '{key}' has no value; write {key}=VALUE.")
        options[key] = value
    return kind, found[1], options


def open_source(spec: str) -> list[ImageSource]:
    """Open the image source that ``kind:path[options]`` specifies. The docstring of this module
    lists the kinds.

    Raises:
        InputError: the kind or an option is unknown, or data is missing or malformed.
    """
    kind, path, options = split_spec(spec)
    if kind not in _READERS or not path:
        raise InputError(
            f"--data {spec}: must be KIND:PATH{did_you_mean(kind, _READERS)}, where KIND is one of "
            f"{', '.join(_READERS)}."
        )
    reader, known = _READERS[kind]
    if unknown := [key for key in options if key not in known]:
        choice = f"choose from {', '.join(known)}" if known else "this kind has no options"
        raise InputError(f"--data {spec}: unknown option '{unknown[0]}'; {choice}.")
    try:
        return reader(Path(path).expanduser(), **options)
    except ValueError as error:
        raise InputError(f"--data {spec}: an option is not a number.") from error
