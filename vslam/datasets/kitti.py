"""Reads stereo sequences of KITTI odometry [Geiger et al., CVPR 2012].

root/sequences/NN/image_0/000000.png   rectified images of the left camera
root/sequences/NN/image_1/000000.png   rectified images of the right camera
root/sequences/NN/calib.txt            calibration
root/sequences/NN/times.txt            times in seconds
root/poses/NN.txt                      ground truth, for the sequences 00 to 10
root/sequences/NN/imu.csv              optional: inertial samples, see `vslam.datasets.imu_csv`
root/sequences/NN/calibration.yaml     optional: where the IMU is, see docs/howto/imu.md

If there are no grey images, the colour images in image_2 and image_3 are read instead. The images
may also have other formats, such as JPEG or WebP.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration import files as calibration_files
from vslam.datasets.frames import Source, selection
from vslam.datasets.image_files import checked_files, list_images
from vslam.datasets.imu import Imu
from vslam.datasets.imu_csv import IMU_FILE, read_imu_csv
from vslam.datasets.rectified import rectified
from vslam.datasets.times import FIX_LIST, ordered_list, times_of_list
from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.file_kinds import read_text, what_is_in
from vslam.types.camera import Camera
from vslam.types.trajectory import read_kitti_poses

_HOME = "https://www.cvlibs.net/datasets/kitti/eval_odometry.php"
_FIX = "take calib.txt of this sequence from KITTI's calibration files"
_PAIRS = ((0, 1), (2, 3))  # numbers of the grey and of the colour cameras


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
    cameras, places, listed = find_cameras(lambda k: folder / f"image_{k}", monocular)
    stems = sorted(set().union(*listed), key=_by_number)
    if not stems:
        raise InputError(
            f"{folder}: no images in image_0 and image_1, or in image_2 and image_3"
            f"{what_is_in(places[0])}; add them (the grayscale images, 22 GB, are at {_HOME})."
        )
    path = folder / "times.txt"
    rows, timing = times_of_list(path, FIX_LIST)
    of_images = [rows[k] for k in row_numbers(path, stems, len(rows))]
    times, kept = ordered_list(of_images, timing, FIX_LIST)
    selected = selection(folder, len(kept), start, every, max_frames)
    chosen = kept[selected]
    sides = files_of_frames(places, listed, [stems[k] for k in chosen])
    truth = _read_ground_truth(base / "poses" / f"{name}.txt", stems, len(rows), chosen)
    own = folder / "calib.txt"
    if truth is not None and cameras[0] != 0:  # the poses are those of camera 0
        truth[:, :3, 3] += truth[:, :3, :3] @ _centre(own, cameras[0])
    images = checked_files("kitti", name, np.array(times)[selected], truth, sides, timing=timing)
    left, *right = (f"{width}x{height}" for width, height in images.sizes)
    if right and right[0] != left:
        raise UnreadableImageError(
            sides[1][0],
            f"has {right[0]} pixels but the left image has {left}; use the rectified images of "
            "both cameras.",
        )
    images = replace(images, imu=_imu_of(folder))
    if calib:
        return rectified(images, calibration_files.read_calibration(calib, images.sizes[0]))
    width, height = images.sizes[0]
    return Source(
        dataset=images.dataset,
        name=name,
        camera=read_calibration(own, width=width, height=height, cameras=cameras),
        stored=images.stored,
        ground_truth=images.ground_truth,
        timing=timing,
        imu=images.imu,
    )


def list_kitti(root: Path | str) -> list[tuple[str, int, int]]:
    """List the name of each sequence, and its numbers of left and right images.

    Raises:
        InputError: ``root`` holds no KITTI data.
    """
    folders = sorted(p for p in (_find_root(root) / "sequences").iterdir() if p.is_dir())
    listed = []
    for folder in folders:
        left, right = _images_of_sequence(folder)
        listed.append((folder.name, len(left), len(right)))
    return listed


def read_calibration(
    path: Path | str, *, width: int, height: int, cameras: tuple[int, ...] = (0, 1)
) -> Camera:
    """Read the projection matrices of one or two cameras from ``calib.txt``.

    Args:
        width: image width in pixels. The file does not state the image size.
        height: image height in pixels.
        cameras: numbers of the left and the right camera, or of the only camera.

    Raises:
        InputError: the file is missing or malformed, or its values do not describe a rectified
            pair.
    """
    P = _projections(Path(path), cameras)
    names = " and ".join(f"P{k}" for k in cameras)
    fx, fy, cx, cy = P[0, 0, 0], P[0, 1, 1], P[0, 0, 2], P[0, 1, 2]
    if fx <= 0 or fy <= 0 or not np.allclose(P[0, :, :3], P[-1, :, :3]):
        raise InputError(
            f"{path}: {names} do not share one positive focal length and centre, so the pair is "
            f"not rectified; {_FIX}."
        )
    # The last columns are K t, and t is a camera's translation from camera 0.
    first, second = (one[0, 3] - cx * one[2, 3] for one in (P[0], P[-1]))
    baseline = (first - second) / fx
    if baseline <= 0 and len(cameras) == 2:
        raise InputError(
            f"{path}: the baseline of {names} is {baseline:.3f} m but must be positive; {_FIX}, "
            "or run on the left camera alone with --sensor mono."
        )
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{path}: the principal point ({cx:.1f}, {cy:.1f}) lies outside the "
            f"{width}x{height} image; {_FIX}."
        )
    return Camera(float(fx), float(fy), float(cx), float(cy), float(baseline), width, height)


def _projections(path: Path, cameras: tuple[int, ...]) -> NDArray[np.float64]:
    """Read the ``(C, 3, 4)`` projection matrices of C cameras."""
    if not path.is_file():
        raise InputError(f"{path}: the calibration is missing; {_FIX}.")
    text = read_text(path, "a calibration of KITTI").replace(",", " ")
    lines = [line.split() for line in text.splitlines() if line.strip()]
    keyed = {words[0].rstrip(":"): words[1:] for words in lines if words[0].endswith(":")}
    names = [f"P{k}" for k in cameras]
    try:
        rows = [keyed[name] for name in names] if keyed else [lines[k] for k in cameras]
        P = np.array(rows, dtype=np.float64).reshape(len(names), 3, 4)
    except (LookupError, ValueError) as error:
        wanted = " and ".join(names) + (" is not a row" if len(names) == 1 else " are not two rows")
        raise InputError(f"{path}: {wanted} of 12 numbers; {_FIX}.") from error
    if not np.isfinite(P).all():
        raise InputError(f"{path}: {' or '.join(names)} holds NaN or infinity; {_FIX}.")
    return P


def _centre(path: Path, camera: int) -> NDArray[np.float64]:
    """Read the ``(3,)`` position of a camera in the frame of camera 0, in metres."""
    K, Kt = np.split(_projections(path, (camera,))[0], [3], axis=1)
    return -np.linalg.solve(K, Kt[:, 0])


def _find_root(root: Path | str) -> Path:
    root = Path(root)
    for base in (root, root / "dataset"):
        if (base / "sequences").is_dir():
            return base
    raise InputError(
        f"{root}: holds no KITTI odometry data (no folder 'sequences'{what_is_in(root)}); give its "
        "folder with --data, or leave --dataset out if it is other data; or download the grayscale "
        f"images (22 GB), calibration files and ground truth poses from {_HOME}, unpack them into "
        "one folder and give it with --data or $KITTI_ROOT; --dataset synthetic needs no download."
    )


def _find_sequence(base: Path, name: str) -> Path:
    folder = base / "sequences" / name
    found = sorted(p for p in (base / "sequences").iterdir() if p.is_dir())
    if name not in [p.name for p in found]:
        there = [p.name for p in found if _images_of_sequence(p)[0]]
        choice = f"choose one of {', '.join(there)}" if there else "no sequence there has images"
        raise InputError(f"{folder}: no such sequence; {choice}.")
    return folder


def _by_number(stem: str) -> tuple[int, str]:
    return (int(stem) if stem.isdecimal() else -1, stem)


def _images_of_sequence(folder: Path) -> list[dict[str, Path]]:
    return find_cameras(lambda k: folder / f"image_{k}", monocular=False)[2]


def find_cameras(
    place: Callable[[int], Path], monocular: bool
) -> tuple[tuple[int, ...], list[Path], list[dict[str, Path]]]:
    """Find the images of the grey cameras 0 and 1 or, without these, of the colour cameras 2 and 3.

    Args:
        place: function that returns the folder of the images of a camera.
        monocular: find only the images of the left camera.

    Returns:
        The numbers of the cameras, the folders of their images, and the images of each camera by
        stem. If no pair is complete, a pair of which one camera has images is returned.
    """
    found = []
    for pair in _PAIRS:
        cameras = pair[:1] if monocular else pair
        places = [place(k) for k in cameras]
        found.append((cameras, places, [list_images(folder) for folder in places]))
        if all(found[-1][2]):
            return found[-1]
    return next((one for one in found if any(one[2])), found[0])


def files_of_frames(
    places: list[Path], sides: list[dict[str, Path]], stems: list[str]
) -> list[tuple[Path, ...]]:
    """Return the files of each camera. Each frame must have an image of every camera.

    Args:
        places: folder of the images of each camera, for error messages.
        sides: the images of each camera by stem.
        stems: stems of the frames.

    Raises:
        InputError: an image is missing.
    """
    for side, images in enumerate(sides):
        if not images:
            instead = ", or run on the left camera alone with --sensor mono" if side else ""
            raise InputError(
                f"{places[side]}: no images of the {('left', 'right')[side]} camera, but stereo "
                f"needs both cameras; add them{instead}."
            )
    complete = [all(stem in side for side in sides) for stem in stems]
    if not all(complete):
        first = complete.index(False)
        side = 0 if stems[first] not in sides[0] else 1
        fix = f"restore {places[side] / stems[first]}"
        if first:
            fix += f" and those after it, or add --max-frames {first}"
        raise InputError(
            f"{places[0]}: unequal counts, {len(sides[0])} left and {len(sides[1])} right "
            f"images, and {len(sides[0].keys() & sides[1].keys())} frames have both; {fix}."
        )
    return [tuple(side[stem] for stem in stems) for side in sides]


def row_numbers(path: Path, stems: list[str], n_rows: int) -> NDArray[np.int64]:
    """Return the row of each image in a file with a row for each image of the whole sequence.

    Rows are counted from 0. If the file has more rows than there are images, the stem of an image
    is the number of its row.

    Args:
        path: the file, for error messages.
        stems: stems of the images, in their order.
        n_rows: number of rows of the file.

    Raises:
        InputError: the file has no row for one of the images.
    """
    fix = "take the file of this sequence from KITTI's archives"
    if n_rows < len(stems):
        raise InputError(f"{path}: only {n_rows} rows for {len(stems)} images; {fix}.")
    if n_rows == len(stems) or not all(stem.isdecimal() for stem in stems):
        return np.arange(len(stems))
    rows = np.array([int(stem) for stem in stems])
    if rows[-1] >= n_rows:
        raise InputError(f"{path}: has {n_rows} rows but none for image {stems[-1]}; {fix}.")
    return rows


def _imu_of(folder: Path) -> Imu | None:
    """Find the IMU of a sequence. KITTI's own sequences have none."""
    file, calibration = folder / IMU_FILE, folder / calibration_files.CALIBRATION
    if not file.is_file():
        return None
    imu = Imu(str(file), partial(read_imu_csv, file))
    if not calibration.is_file():
        return imu
    found = calibration_files.read_calibration([calibration])
    return replace(imu, calibration=found.imu, noise=found.imu_noise)


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
    return poses[row_numbers(path, stems, len(poses))[chosen]]
