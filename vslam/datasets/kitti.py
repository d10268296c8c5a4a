"""Reads grey stereo sequences of KITTI odometry [Geiger et al., CVPR 2012].

root/sequences/NN/image_0/000000.png   rectified images of the left camera
root/sequences/NN/image_1/000000.png   rectified images of the right camera
root/sequences/NN/calib.txt            calibration
root/sequences/NN/times.txt            times in seconds
root/poses/NN.txt                      ground truth, for the sequences 00 to 10

The images may also have other formats, such as JPEG or WebP.
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration import files as calibration_files
from vslam.camera import Camera
from vslam.datasets.frames import Source
from vslam.datasets.image_files import checked_files, list_images, select_frames
from vslam.datasets.rectified import rectified
from vslam.errors import InputError, UnreadableImageError
from vslam.trajectory import read_kitti_poses, read_table

_HOME = "https://www.cvlibs.net/datasets/kitti/eval_odometry.php"


def open_kitti(
    root: Path | str,
    name: str,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path | str] = (),
) -> Source:
    """Open a sequence of KITTI odometry. Images of frames that are not selected may be missing.

    The k-th row of ``times.txt`` and of the poses belongs to the k-th image. If such a file has
    more rows than there are images, the number in the file name of an image is the number of its
    row. Therefore, an excerpt of a sequence can be used with the files of the whole sequence.

    Args:
        root: folder that contains ``sequences`` and, optionally, ``poses``. As in KITTI's archives,
            it may contain ``dataset/sequences`` instead.
        name: name of the sequence, for example ``00``.
        start, every, max_frames: of the existing frames, read ``start``, ``start + every`` and so
            on, at most ``max_frames`` frames.
        monocular: read only the left camera. The right camera's images need not exist.
        calib: calibration files, which are used instead of ``calib.txt``. If they are given, the
            images are rectified when they are read.

    Raises:
        InputError: data is missing, the left or the right image of a frame is missing, or the
            calibration, the times or the poses are unusable.
        UnreadableImageError: the first pair cannot be decoded.
    """
    base = _find_root(root)
    folder = _find_sequence(base, name)
    listed = [list_images(folder / f"image_{side}") for side in range(1 if monocular else 2)]
    stems = sorted(set().union(*listed), key=_by_number)
    if not stems:
        raise InputError(
            f"{folder}: no images in image_0 and image_1; "
            f"download the grayscale images (22 GB) from {_HOME}."
        )
    chosen = select_frames(folder, len(stems), start, every, max_frames)
    sides = _files_of_frames(folder, listed, [stems[k] for k in chosen])
    times = _read_times(folder / "times.txt")
    frames = _row_numbers(folder / "times.txt", stems, len(times))[chosen]
    truth = _read_ground_truth(base / "poses" / f"{name}.txt", stems, len(times), chosen)
    images = checked_files("kitti", name, times[frames], truth, sides)
    left, *right = (f"{width}x{height}" for width, height in images.sizes)
    if right and right[0] != left:
        raise UnreadableImageError(
            sides[1][0],
            f"has {right[0]} pixels but the left image has {left}; use the rectified images of "
            "both cameras.",
        )
    if calib:
        return rectified(images, calibration_files.read_calibration(calib, images.sizes[0]))
    width, height = images.sizes[0]
    camera = read_calibration(folder / "calib.txt", width=width, height=height, monocular=monocular)
    return Source(
        dataset=images.dataset,
        name=name,
        camera=camera,
        stored=images.stored,
        ground_truth=images.ground_truth,
    )


def list_kitti(root: Path | str) -> list[tuple[str, int, int]]:
    """List the name of each sequence, and its numbers of left and right images.

    Raises:
        InputError: ``root`` holds no KITTI data.
    """
    folders = sorted(p for p in (_find_root(root) / "sequences").iterdir() if p.is_dir())
    return [
        (p.name, len(list_images(p / "image_0")), len(list_images(p / "image_1"))) for p in folders
    ]


def read_calibration(
    path: Path | str, *, width: int, height: int, monocular: bool = False
) -> Camera:
    """Read the projection matrices P0 and P1 from ``calib.txt``.

    Args:
        width: image width in pixels. The file does not state the image size.
        height: image height in pixels.
        monocular: read only P0. The file need not contain P1.

    Raises:
        InputError: the file is missing or malformed, or its values do not describe a rectified
            pair.
    """
    fix = "take calib.txt of this sequence from KITTI's calibration files"
    try:
        lines = [line.split() for line in Path(path).read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: the calibration is missing or unreadable; {fix}.") from error
    keyed = {words[0].rstrip(":"): words[1:] for words in lines if words[0].endswith(":")}
    names = ["P0"] if monocular else ["P0", "P1"]
    try:
        rows = [keyed[name] for name in names] if keyed else lines[: len(names)]
        P = np.array(rows, dtype=np.float64).reshape(len(names), 3, 4)
    except (KeyError, ValueError) as error:
        wanted = "P0 is not a row" if monocular else "P0 and P1 are not two rows"
        raise InputError(f"{path}: {wanted} of 12 numbers; {fix}.") from error
    if not np.isfinite(P).all():
        raise InputError(f"{path}: {' or '.join(names)} holds NaN or infinity; {fix}.")
    fx, fy, cx, cy = P[0, 0, 0], P[0, 1, 1], P[0, 0, 2], P[0, 1, 2]
    if fx <= 0 or fy <= 0 or not np.allclose(P[0, :, :3], P[-1, :, :3]):
        raise InputError(
            f"{path}: P0 and P1 do not share one positive focal length and centre, so the pair is "
            f"not rectified; {fix}."
        )
    baseline = (P[0, 0, 3] - P[-1, 0, 3]) / fx
    if baseline <= 0 and not monocular:
        raise InputError(
            f"{path}: the baseline of P0 and P1 is {baseline:.3f} m but must be positive; {fix}, "
            "or run on the left camera alone with --sensor mono."
        )
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{path}: the principal point ({cx:.1f}, {cy:.1f}) lies outside the "
            f"{width}x{height} image; {fix}."
        )
    return Camera(float(fx), float(fy), float(cx), float(cy), float(baseline), width, height)


def _find_root(root: Path | str) -> Path:
    root = Path(root)
    for base in (root, root / "dataset"):
        if (base / "sequences").is_dir():
            return base
    raise InputError(
        f"{root}: holds no KITTI odometry data (no folder 'sequences'); download the grayscale "
        f"images (22 GB), calibration files and ground truth poses from {_HOME}, unpack them into "
        "one folder and give it with --data or $KITTI_ROOT; --dataset synthetic needs no download."
    )


def _find_sequence(base: Path, name: str) -> Path:
    folder = base / "sequences" / name
    found = sorted(p for p in (base / "sequences").iterdir() if p.is_dir())
    if name not in [p.name for p in found]:
        there = [p.name for p in found if list_images(p / "image_0")]
        choice = f"choose one of {', '.join(there)}" if there else "no sequence there has images"
        raise InputError(f"{folder}: no such sequence; {choice}.")
    return folder


def _by_number(stem: str) -> tuple[int, str]:
    return (int(stem) if stem.isdecimal() else -1, stem)


def _files_of_frames(
    folder: Path, sides: list[dict[str, Path]], stems: list[str]
) -> list[tuple[Path, ...]]:
    for side, images in enumerate(sides):
        if not images:
            instead = ", or run on the left camera alone with --sensor mono" if side else ""
            raise InputError(
                f"{folder}/image_{side}: no images of the {('left', 'right')[side]} camera, but "
                "stereo needs both cameras; download the grayscale images (22 GB) from "
                f"{_HOME}{instead}."
            )
    complete = [all(stem in side for side in sides) for stem in stems]
    if not all(complete):
        first = complete.index(False)
        side = 0 if stems[first] not in sides[0] else 1
        fix = f"restore image_{side}/{stems[first]}"
        if first:
            fix += f" and those after it, or add --max-frames {first}"
        raise InputError(
            f"{folder}: unequal counts, {len(sides[0])} left and {len(sides[1])} right images, and "
            f"{len(sides[0].keys() & sides[1].keys())} frames have both; {fix}."
        )
    return [tuple(side[stem] for stem in stems) for side in sides]


def _read_times(path: Path) -> NDArray[np.float64]:
    times = read_table(path, (1,), "a time in seconds")[:, 0]
    if (bad := np.flatnonzero(np.diff(times) <= 0)).size:
        raise InputError(
            f"{path}: time {bad[0] + 2} is not later than the one before it; "
            "take times.txt of this sequence from KITTI's calibration files."
        )
    return times


def _row_numbers(path: Path, stems: list[str], n_rows: int) -> NDArray[np.int64]:
    """Return the row of each image in ``times.txt`` or in the file of the poses, from 0."""
    fix = "take the file of this sequence from KITTI's archives"
    if n_rows < len(stems):
        raise InputError(f"{path}: only {n_rows} rows for {len(stems)} images; {fix}.")
    if n_rows == len(stems) or not all(stem.isdecimal() for stem in stems):
        return np.arange(len(stems))
    rows = np.array([int(stem) for stem in stems])
    if rows[-1] >= n_rows:
        raise InputError(f"{path}: has {n_rows} rows but none for image {stems[-1]}; {fix}.")
    return rows


def _read_ground_truth(
    path: Path, stems: list[str], n_times: int, chosen: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    if not path.exists():
        return None
    poses = read_kitti_poses(path)
    if len(poses) not in (n_times, len(stems)):
        raise InputError(
            f"{path}: has {len(poses)} poses, but there are {len(stems)} images and {n_times} "
            "times; take the file of this sequence, or remove it to run without ground truth."
        )
    return poses[_row_numbers(path, stems, len(poses))[chosen]]
