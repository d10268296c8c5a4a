"""Images of places, and which of them show the same one: what the networks learn from.

A source is one set of images with a matrix that says for each pair: same place (1), another place
(-1), or not known and never used (0). Images of different sources show different places, unless
the sources are of one family (the same region photographed twice): then nothing is known.

Sources are named on the command line as ``kind:path``, with options in brackets:

``kitti:DIR[seq=00,first=250,last=1500]``  a KITTI sequence with ground truth poses; in place of
    first and last ``frames=0-249+1500-1699``, ``truth=FILE.mat`` for a matrix of its loops,
    ``near=20`` for the metres that one place reaches
``fabmap:DIR[truth=FILE.mat]``             Oxford CityCentre or NewCollege (Cummins and Newman 2008)
``pairs:DIR``                              what ``vslam synth --pairs`` wrote
``photos:DIR``                             folders of photographs with a NOTES.txt, see below
``pack:FILE.npz``                          what ``vslam export places`` wrote of any of these
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError, ResultsError
from vslam.loopclosure.siamese.images import Fit, Size, read_grey, to_size
from vslam.trajectory import read_kitti_poses, read_table

SAME, UNKNOWN, DIFFERENT = 1, 0, -1
_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp"}
_UNDISTORT_COLUMNS = (8, 9)
_VIEW = ("x_a", "z_a", "yaw_a", "x_b", "z_b", "yaw_b")
_FAR = 25.0  # m, beyond which two images of a drive show different places
_CELL = 80.0  # m, of a rendered town: stays together when training and validation are divided


@dataclass(frozen=True)
class Places:
    """One source of N images.

    Attributes:
        name: of the source, part of every image's name.
        family: sources of one family may show the same places.
        names: of the N images, ``folder/file``.
        images: N files, or their encoded bytes as ``(B,)`` uint8.
        relation: ``(N, N)`` int8, symmetric, 1 same, -1 different, 0 unknown; the diagonal is 1:
            an image and another augmentation of it.
        unit: ``(N,)`` int32; images of one unit (a folder, a stretch of road) stay together when
            training and validation are divided.
        calibration: ``(8,)`` or ``(9,)`` fx fy cx cy k1 k2 p1 p2 [k3], None if rectified.
        asks: ``(N,)`` bool, images that ask for their place in a benchmark while the others are
            asked for; None for a drive, where each asks for those long before it.
    """

    name: str
    family: str
    names: tuple[str, ...]
    images: tuple[Path | NDArray[np.uint8], ...]
    relation: NDArray[np.int8]
    unit: NDArray[np.int32]
    calibration: NDArray[np.float64] | None = None
    asks: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.images)

    def read(self, index: int, size: Size, fit: Fit) -> NDArray[np.uint8]:
        """The image, undistorted and of that size.

        Raises:
            UnreadableImageError: missing or damaged.
        """
        return to_size(self.grey(index), size, fit)

    def grey(self, index: int) -> NDArray[np.uint8]:
        """The image, undistorted, ``(H, W)``.

        Raises:
            UnreadableImageError: missing or damaged.
        """
        image = read_grey(self.images[index], self.names[index])
        return image if self.calibration is None else undistorted(image, self.calibration)

    def select(self, chosen: NDArray[np.int64]) -> Places:
        """The images ``chosen``, in their order."""
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            images=tuple(self.images[i] for i in chosen),
            relation=self.relation[np.ix_(chosen, chosen)],
            unit=self.unit[chosen],
            asks=None if self.asks is None else self.asks[chosen],
        )


def undistorted(image: NDArray[np.uint8], calibration: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Remove radial and tangential distortion (Brown's model), same size and camera matrix."""
    import cv2

    fx, fy, cx, cy = calibration[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return np.asarray(cv2.undistort(image, K, calibration[4:]), np.uint8)


def split_spec(spec: str) -> tuple[str, str, dict[str, str]]:
    """``kind:path[key=value,...]`` in its parts; no path where it is spelled otherwise."""
    kind, _, rest = spec.partition(":")
    found = re.fullmatch(r"(.+?)(?:\[(.*)\])?", rest)
    if found is None:
        return kind, "", {}
    items = (item.split("=", 1) for item in (found[2] or "").split(",") if "=" in item)
    return kind, found[1], dict(items)


def open_source(spec: str) -> list[Places]:
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


def relation_of_poses(
    T_wc: NDArray[np.float64],
    *,
    near: float = 5.0,
    turned: float = 30.0,
    far: float = _FAR,
) -> NDArray[np.int8]:
    """Same place: nearer than ``near`` metres and ``turned`` degrees; different: beyond ``far``."""
    centre, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    apart = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    cosine = forward @ forward.T
    relation = np.zeros(apart.shape, np.int8)
    relation[(apart < near) & (cosine > np.cos(np.radians(turned)))] = SAME
    relation[apart > far] = DIFFERENT
    np.fill_diagonal(relation, SAME)
    return relation


def read_kitti(
    root: Path,
    seq: str = "00",
    first: str = "0",
    last: str = "1000000",
    every: str = "1",
    frames: str = "",
    truth: str = "",
    near: str = "5",
) -> list[Places]:
    """Left grey images of a KITTI sequence; those numbered first to last, both included.

    Args:
        root: KITTI root.
        seq, first, last, every: which images; every second one for 2.
        frames: ranges instead of first and last, ``0-249+1500-1699``.
        truth: ``.mat`` file with a matrix of the whole sequence that marks the same places; the
            others are different beyond 25 m and not known below.
        near: metres within which two images show one place, below 25. The matrices of loop
            detection count places as the same up to 20 m apart and more.

    Raises:
        InputError: no images in that range, no poses for them, no such matrix, or a ``near`` that
            is out of range.
    """
    base = root if (root / "sequences").is_dir() else root / "dataset"
    folder = base / "sequences" / seq / "image_0"
    spans = [span.split("-") for span in frames.split("+")] if frames else [[first, last]]
    wanted = [range(int(low), int(high) + 1, int(every)) for low, high in spans]
    files = [f for f in _images(folder) if f.stem.isdecimal()]
    files = [f for f in files if any(int(f.stem) in span for span in wanted)]
    if len(files) < 2:
        asked = frames or f"{first} to {last}"
        raise InputError(f"{folder}: no images numbered {asked}; see datasets.md.")
    poses = read_kitti_poses(base / "poses" / f"{seq}.txt")
    number = np.array([int(f.stem) for f in files])
    if number[-1] >= len(poses):
        raise InputError(
            f"{base}/poses/{seq}.txt: {len(poses)} poses, none for image {files[-1].stem}; take "
            "the file of this sequence."
        )
    T_wc = poses[number]
    steps = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    stretch = (np.concatenate([[0.0], np.cumsum(steps)]) // 100.0).astype(np.int32)  # of 100 m
    if not 0.0 < float(near) < _FAR:
        raise InputError(f"near={near}: must be above 0 and below {_FAR:g} m.")
    relation = relation_of_poses(T_wc, near=float(near))
    if truth:
        path = Path(truth).expanduser()
        loops = read_loop_matrix(path)
        if len(loops) <= number[-1]:
            raise InputError(
                f"{path}: {len(loops)} rows, none for image {files[-1].stem}; take the matrix of "
                "this sequence."
            )
        marked = loops[np.ix_(number, number)]
        relation[relation == SAME] = UNKNOWN
        relation[marked | marked.T] = SAME
        np.fill_diagonal(relation, SAME)
    name = f"kitti{seq}"
    return [Places(name, name, _names(files), tuple(files), relation, stretch)]


def read_loop_matrix(path: Path) -> NDArray[np.bool_]:
    """The first square matrix of a ``.mat`` file, ``(N, N)`` bool: which images close a loop.

    Raises:
        InputError: no such file, or no such matrix in it.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path)
    except (OSError, ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise InputError(f"{path}: not a readable .mat file; download it again.") from error
    matrices = [m for key, m in content.items() if not key.startswith("__")]
    matrices = [m for m in matrices if m.ndim == 2 and m.shape[0] == m.shape[1] and m.size > 1]
    if not matrices:
        raise InputError(f"{path}: no ground truth in it (no square matrix with a match).")
    found = matrices[0].toarray() if hasattr(matrices[0], "toarray") else matrices[0]
    if not found.any():
        raise InputError(f"{path}: no ground truth in it (no square matrix with a match).")
    return np.asarray(found != 0)


def read_fabmap(folder: Path, truth: str = "", eye: str = "left") -> list[Places]:
    """Images of one of the FAB-MAP collections with its ground-truth matrix.

    The matrix has a row for each image, or one for each pair of left and right images (odd and
    even numbers): then the images of one eye are taken. A ``calibration.txt`` in the folder (fx
    fy cx cy k1 k2 p1 p2 [k3] on one line) has the images undistorted.

    Raises:
        InputError: no images, no matrix, or sizes that do not belong together.
    """
    files = _images(folder)
    if not files:
        raise InputError(f"{folder}: no images; see datasets.md.")
    named = Path(truth).expanduser() if truth else None
    path = named or next(iter(sorted(folder.glob("*.mat"))), None)
    if path is None:
        raise InputError(f"{folder}: no ground-truth matrix; name it: fabmap:DIR[truth=FILE.mat].")
    loops = read_loop_matrix(path)
    n = len(loops)
    if 2 * n == len(files):
        files = files[0 if eye == "left" else 1 :: 2]
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
    return [Places(name, name, _names(files), tuple(files), relation, unit, model)]


def read_pairs(folder: Path) -> list[Places]:
    """Rendered pairs: ``pairs.csv`` with columns a, b (files) and same (1 or 0), others allowed.

    With the columns x_a, z_a, yaw_a and those of b (m, degrees), images of different pairs are
    related, too: :func:`relation_of_views`. Without, nothing is known across pairs.

    Raises:
        InputError: no or malformed list, or no pair in it.
    """
    path = folder / "pairs.csv"
    try:
        with path.open(newline="") as file:
            rows = [(row["a"], row["b"], int(row["same"]), row) for row in csv.DictReader(file)]
        placed = bool(rows) and set(_VIEW) <= set(rows[0][3])
        found = [[float(row[key]) for key in _VIEW] for *_, row in rows] if placed else []
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: no list of pairs (columns a, b, same); write it with 'vslam synth --pairs'."
        ) from error
    if not rows:
        raise InputError(f"{path}: no pair in it; write it again with 'vslam synth --pairs'.")
    number: dict[str, int] = {}
    for a, b, *_ in rows:
        number.setdefault(a, len(number))
        number.setdefault(b, len(number))
    relation = np.zeros((len(number), len(number)), np.int8)
    unit = np.zeros(len(number), np.int32)
    if placed:
        views = np.zeros((len(number), 3))
        for (a, b, *_), view in zip(rows, found, strict=True):
            views[[number[a], number[b]]] = np.array(view).reshape(2, 3)
        relation = relation_of_views(views)
        cell = np.floor(views[:, :2] / _CELL).astype(np.int64)
        unit = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
    for k, (a, b, same, _) in enumerate(rows):
        i, j = number[a], number[b]
        relation[i, j] = relation[j, i] = SAME if same else DIFFERENT
        if not placed:
            unit[i] = unit[j] = k
    np.fill_diagonal(relation, SAME)
    files = tuple(folder / name for name in number)
    asks = np.isin([*number], [b for _, b, *_ in rows])
    return [Places(folder.name, folder.name, _names(files), files, relation, unit, asks=asks)]


def relation_of_views(
    views: NDArray[np.float64],
    *,
    near: float = 5.0,
    turned: float = 35.0,
    far: float = 40.0,
    sight: float = 160.0,
    street: float = 25.0,
) -> NDArray[np.int8]:
    """Same place: nearer than ``near`` metres and ``turned`` degrees.

    Different: beyond ``far`` metres, and not within ``sight`` in one street (``street`` metres to
    the side) seen in one direction or against it.

    Args:
        views: ``(N, 3)`` x and z in metres, yaw in degrees from z towards x.
    """
    xz, yaw = views[:, :2], np.radians(views[:, 2])
    ahead = np.stack([np.sin(yaw), np.cos(yaw)], 1)
    away = xz[None] - xz[:, None]
    distance = np.linalg.norm(away, axis=2)
    aside = np.abs(away[..., 0] * ahead[:, None, 1] - away[..., 1] * ahead[:, None, 0])
    cosine = ahead @ ahead.T
    along = (np.abs(cosine) > 0.7) & (aside < street) & (distance < sight)
    relation = np.zeros(distance.shape, np.int8)
    relation[(distance < near) & (cosine > np.cos(np.radians(turned)))] = SAME
    relation[(distance > far) & ~(along | along.T)] = DIFFERENT
    return relation


def read_photos(folder: Path) -> list[Places]:
    """Sets of photographs of places, ``folder/SET/SUBFOLDER/*`` with ``folder/SET/NOTES.txt``.

    The first line of the notes tells the kind: (a) each subfolder shows one place, (b) each is a
    video in order, whose neighbours overlap, (c) unrelated photographs. ``_EXCEPTIONS`` says
    where a set's own notes restrict that.

    Raises:
        InputError: no such set, or notes that name no kind.
    """
    notes = sorted(folder.glob("*/NOTES.txt")) or sorted(folder.glob("NOTES.txt"))
    if not notes:
        raise InputError(f"{folder}: no set of photographs (SET/NOTES.txt); see datasets.md.")
    return [_read_photo_set(path.parent) for path in notes]


@dataclass(frozen=True)
class _Exception:
    """What the notes of a set say beyond its kind.

    Attributes:
        reach: photographs of a folder farther apart in its order may show different things.
        region: of a folder; what folders of one region have in common is not known.
        family: of the set.
        singles: folders of photographs that have nothing to do with each other.
    """

    reach: int | None = None
    region: Callable[[str], str] | None = None
    family: str | None = None
    singles: tuple[str, ...] = ()


_EXCEPTIONS = {
    # Turning round one standpoint: distant photographs show different things.
    "pano_rotation": _Exception(reach=1, family="landmarks"),
    # Opposite walls of one yard.
    "strecha": _Exception(reach=3, family="landmarks"),
    # Folders are headings of one walk, and overlap at their borders.
    "pano360": _Exception(reach=2, region=lambda folder: folder.split("_")[0]),
    # Several passes of one floor.
    "ie_tower": _Exception(reach=1, region=lambda folder: folder.split("__")[0]),
    # Windows cut from one panorama.
    "webcams": _Exception(region=lambda folder: folder.split("_")[0]),
    "multiview": _Exception(reach=4, family="landmarks"),
    "wxbs_evd": _Exception(family="landmarks"),
    "stitch_pairs": _Exception(reach=2, family="landmarks"),
    "megadepth_landmarks": _Exception(family="landmarks"),
    # Some buildings appear twice.
    "landmarks_misc": _Exception(region=lambda folder: folder, family="landmarks"),
    "sf_toy": _Exception(region=lambda _: "", singles=("single",)),
    "camvid": _Exception(region=lambda _: ""),
    "highway_us": _Exception(region=lambda _: "", singles=("udacity_stills", "tusimple_stills")),
    "freiburg_bonn_stills": _Exception(singles=("stills",)),
    "kitti_city_pedestrian": _Exception(family="kitti"),
    "kitti_sfnd": _Exception(family="kitti"),
}
_STRETCH = 25  # frames of a video that stay together when training and validation are divided


def _read_photo_set(folder: Path) -> Places:
    first_line = (folder / "NOTES.txt").read_text(errors="replace").partition("\n")[0]
    found = re.search(r"kind \((a/b|a|b|c)\)", first_line)
    if found is None:
        raise InputError(f"{folder}/NOTES.txt: the first line names no kind (a), (b) or (c).")
    kind = found[1]
    exception = _EXCEPTIONS.get(folder.name, _Exception())
    of_set = exception.reach if exception.reach is not None else 1_000_000
    files: list[Path] = []
    rows: list[tuple[int, int, int, int]] = []  # folder, position, reach, unit
    regions: list[str] = []
    for number, subfolder in enumerate(sorted(p for p in folder.iterdir() if p.is_dir())):
        single = kind == "c" or subfolder.name in exception.singles
        reach = 0 if single else of_set if kind == "a" else 1
        stretch = 1 if single else 1_000_000 if kind == "a" else _STRETCH
        for k, file in enumerate(_images(subfolder)):
            files.append(file)
            rows.append((number, k, reach, number * 10_000 + k // stretch))
            regions.append(exception.region(subfolder.name) if exception.region else "")
    if not files:
        raise InputError(f"{folder}: no photographs in its subfolders; restore them.")
    number, position, reach, unit = np.array(rows).T
    together = number[:, None] == number[None]
    relation = np.full(together.shape, DIFFERENT, np.int8)
    if exception.region is not None:
        _, region = np.unique(regions, return_inverse=True)
        relation[region[:, None] == region[None]] = UNKNOWN
    if kind != "c":
        relation[together] = UNKNOWN
    apart = np.abs(position[:, None] - position[None])
    relation[together & (apart <= reach)] = SAME
    family = exception.family or folder.name
    return Places(folder.name, family, _names(files), tuple(files), relation, unit.astype(np.int32))


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in _SUFFIXES)


def _names(files: Sequence[Path]) -> tuple[str, ...]:
    return tuple(f"{file.parent.name}/{file.name}" for file in files)


def write_pack(sources: Sequence[Places], path: Path, size: Size, fit: Fit) -> None:
    """Write sources as one file: images at the size of the network, JPEG, with their relations.

    For machines that cannot hold the originals (docs/training.md).

    Raises:
        UnreadableImageError: an image is missing or damaged.
        ResultsError: the file cannot be written.
    """
    import cv2

    arrays: dict[str, NDArray] = {"count": np.array(len(sources))}
    for k, source in enumerate(sources):
        encoded = [
            cv2.imencode(".jpg", source.read(i, size, fit), (cv2.IMWRITE_JPEG_QUALITY, 85))[1]
            for i in range(len(source))
        ]
        arrays[f"{k}_text"] = np.array([source.name, source.family, *source.names])
        arrays[f"{k}_sizes"] = np.array([len(e) for e in encoded])
        arrays[f"{k}_bytes"] = np.concatenate([e.ravel() for e in encoded])
        arrays[f"{k}_relation"], arrays[f"{k}_unit"] = source.relation, source.unit
    try:
        np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written ({error.strerror}).") from error


def read_pack(path: Path) -> list[Places]:
    """Read what :func:`write_pack` wrote.

    Raises:
        InputError: missing or damaged file.
    """
    try:
        with np.load(path) as content:
            sources = []
            for k in range(int(content["count"])):
                name, family, *names = content[f"{k}_text"].tolist()
                ends = np.cumsum(content[f"{k}_sizes"])[:-1]
                images = tuple(np.split(content[f"{k}_bytes"], ends))
                relation, unit = content[f"{k}_relation"], content[f"{k}_unit"]
                sources.append(Places(name, family, tuple(names), images, relation, unit))
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise InputError(
            f"{path}: not a pack of places; write it with 'vslam export places'."
        ) from error
    return sources


_READERS: dict[str, tuple[Callable[..., list[Places]], tuple[str, ...]]] = {
    "kitti": (read_kitti, ("seq", "first", "last", "every", "frames", "truth", "near")),
    "fabmap": (read_fabmap, ("truth", "eye")),
    "pairs": (read_pairs, ()),
    "photos": (read_photos, ()),
    "pack": (read_pack, ()),
}
