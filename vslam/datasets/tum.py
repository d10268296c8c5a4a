"""RGB-D sequences of TUM, and all data in their layout [Sturm et al., IROS 2012].

FOLDER/rgb.txt, depth.txt    a time in seconds and an image file a line
FOLDER/groundtruth.txt       optional: t tx ty tz qx qy qz qw
FOLDER/calibration.yaml      optional: the camera (docs/cameras.md); without it one of TUM's three,
                             by "freiburg1", "freiburg2" or "freiburg3" in the folder's name
"""

from __future__ import annotations

from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.files import read_calibration
from vslam.calibration.models import Calibration, CameraModel
from vslam.calibration.rectification import Rectification, rectify
from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.ground_truth import poses_at
from vslam.datasets.image_files import (
    check_not_empty,
    find_sequence,
    read_grey,
    read_grey_of_size,
    select_frames,
    size_text,
)
from vslam.errors import InputError, UnreadableImageError
from vslam.trajectory import read_trajectory

_HOME = "https://cvg.cit.tum.de/data/datasets/rgbd-dataset"
CALIBRATION = "calibration.yaml"
_NEAR_S = 0.02  # as TUM's associate.py
_DEPTH_SCALE = 5000.0  # TUM's "file formats"
# Of a Kinect: its projector stands so far from its camera (ORB-SLAM2, section III-A).
_VIRTUAL_BASELINE = 0.08
# TUM's "intrinsic camera calibration"; the images of freiburg3 are undistorted already.
_CAMERAS = {
    "freiburg1": CameraModel(
        517.3, 516.5, 318.6, 255.3, 640, 480, "pinhole", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "freiburg2": CameraModel(
        520.9, 521.0, 325.1, 249.7, 640, 480, "pinhole", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "freiburg3": CameraModel(535.4, 539.2, 320.1, 247.6, 640, 480),
}


@dataclass(frozen=True)
class TumSequence:
    """The selected frames of one sequence; see :class:`vslam.datasets.sequence.Sequence`.

    Attributes:
        name: of the folder.
        camera: of the undistorted images, with the virtual baseline; monocular without depth.
        timestamps: ``(N,)`` float64 seconds of the colour images.
        ground_truth: ``(N, 4, 4)`` float64 ``T_wc`` in the world of the file, or None.
        colour, depth: N image files each; depth is empty for the colour images alone.
        depth_scale: what depth images count in a metre.
        rectification: undistorts both.
    """

    name: str
    camera: Camera
    timestamps: NDArray[np.float64]
    ground_truth: NDArray[np.float64] | None
    colour: tuple[Path, ...]
    depth: tuple[Path, ...]
    depth_scale: float
    rectification: Rectification

    @property
    def dataset(self) -> str:
        return "tum"

    def __len__(self) -> int:
        return len(self.colour)

    def read(self, index: int, image_map: ImageMap = map) -> tuple[Image, DepthImage | None]:
        """Grey image ``(H, W)`` uint8 and depth ``(H, W)`` float32 metres, both undistorted, None
        without depth. Safe to call from several threads.

        Raises:
            UnreadableImageError: a file is missing, damaged, of another size, or the depth not of
                16 bits.
        """
        size = self.camera.width, self.camera.height
        left = self.rectification.left(read_grey_of_size(self.colour[index], *size))
        if not self.depth:
            return left, None
        steps = self.rectification.left_depth(_read_depth(self.depth[index], *size))
        return left, steps * np.float32(1.0 / self.depth_scale)


def open_tum(
    root: Path,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path] = (),
    depth_scale: float | None = None,
) -> TumSequence:
    """Open a sequence; its images are undistorted as they are read.

    A frame is a colour image with the depth image nearest in time, within 20 ms; each is used
    once, the nearest first, as by TUM's ``associate.py``. The ground truth is interpolated
    (`vslam.datasets.ground_truth.poses_at`).

    Args:
        root: the sequence's folder, or one with several.
        name: of the sequence in it; None for the folder itself, or the only one in it.
        start: first frame, counted over the pairs.
        every: take every N-th frame.
        max_frames: at most so many, None for all.
        monocular: read the colour images alone; there need be no depth.
        calib: file to be used instead of the folder's, or of TUM's cameras.
        depth_scale: what depth images count in a metre; None: as the calibration says, or 5000.

    Raises:
        InputError: data missing or malformed, no pairs, calibration or ground truth unusable.
        UnreadableImageError: a file is empty, the first pair cannot be decoded or does not fit.
    """
    folder = find_sequence(root, name, is_tum)
    if folder is None:
        raise InputError(
            f"{root}: no data in TUM's RGB-D layout here (no rgb.txt); download a sequence from "
            f"{_HOME}, unpack it and name its folder with --data."
        )
    times, colour_files = _read_list(folder / "rgb.txt")
    frames = partners = np.arange(len(times))
    depth_files: list[Path] = []
    if not monocular:
        depth_times, depth_files = _read_list(folder / "depth.txt")
        frames, partners = associate(times, depth_times, _NEAR_S)
        if not len(frames):
            raise InputError(
                f"{folder}: no colour image has a depth image within 20 ms; take rgb.txt and "
                "depth.txt of one recording, or run on the colour images with --sensor mono."
            )
    chosen = select_frames(folder, len(frames), start, every, max_frames)
    times = times[frames[chosen]]
    colour = tuple(colour_files[k] for k in frames[chosen])
    depth = () if monocular else tuple(depth_files[k] for k in partners[chosen])
    for path in (*colour, *depth):
        check_not_empty(path)
    height, width = read_grey(colour[0]).shape
    calibration = _calibration(folder, calib, width, height)
    rectification = rectify(calibration)
    camera = rectification.camera
    if not monocular:
        _read_depth(depth[0], width, height)
        baseline = calibration.virtual_baseline or _VIRTUAL_BASELINE
        camera = replace(camera, baseline=baseline, depth=True)
    truth = folder / "groundtruth.txt"
    return TumSequence(
        name=folder.resolve().name,
        camera=camera,
        timestamps=times,
        ground_truth=(poses_at(truth, read_trajectory(truth), times) if truth.is_file() else None),
        colour=colour,
        depth=depth,
        depth_scale=depth_scale or calibration.depth_scale or _DEPTH_SCALE,
        rectification=rectification,
    )


def is_tum(folder: Path) -> bool:
    """Whether a folder holds a sequence in this layout."""
    return (folder / "rgb.txt").is_file()


def associate(
    first: NDArray[np.float64], second: NDArray[np.float64], max_difference: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair times that are less than ``max_difference`` apart, the nearest first, each once.

    Args:
        first, second: ``(N,)`` and ``(M,)`` seconds, increasing.

    Returns:
        ``(P,)`` indices into each, those into ``first`` increasing.
    """
    low = np.searchsorted(second, first - max_difference, side="right")
    high = np.searchsorted(second, first + max_difference, side="left")
    near = [(i, j) for i in range(len(first)) for j in range(low[i], high[i])]
    near.sort(key=lambda pair: (abs(first[pair[0]] - second[pair[1]]), pair))
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for i, j in near:
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    pairs = np.array(sorted(partner.items()), np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _read_list(path: Path) -> tuple[NDArray[np.float64], list[Path]]:
    """Times (s, increasing) and image files."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        alone = ", or run on the colour images with --sensor mono"
        raise InputError(
            f"{path}: the list of images is missing or no text; unpack the sequence again"
            f"{alone if path.stem == 'depth' else ''}."
        ) from error
    times: list[float] = []
    files: list[Path] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        time, _, name = line.strip().partition(" ")
        try:
            times.append(float(time))
        except ValueError:
            name = ""
        if not name or not np.isfinite(times[-1]):
            raise InputError(
                f"{path}: line {number} is not a time in seconds and a file; repair it."
            )
        if len(times) > 1 and times[-1] <= times[-2]:
            raise InputError(
                f"{path}: line {number} is not later than the one before it; sort the list by time."
            )
        files.append(path.parent / name.strip())
    if not times:
        raise InputError(f"{path}: the list of images is empty; unpack the sequence again.")
    return np.array(times), files


def _calibration(folder: Path, calib: Several[Path], width: int, height: int) -> Calibration:
    own = folder / CALIBRATION
    if calib or own.is_file():
        found = read_calibration(calib or [own], (width, height)).left_alone()
    else:
        found = _known_camera(folder)
    model = found.left
    if (model.width, model.height) != (width, height):
        raise InputError(
            f"{found.source}: made for {model.width}x{model.height} pixels but the images have "
            f"{width}x{height}; take the calibration of these images."
        )
    return found


def _known_camera(folder: Path) -> Calibration:
    for name, model in _CAMERAS.items():
        if name in folder.resolve().name:
            return Calibration(model, source=f"TUM's camera {name}")
    raise InputError(
        f"{folder}: of no known camera (no {', '.join(_CAMERAS)} in its name, no {CALIBRATION}); "
        "name a calibration with --calib."
    )


def _read_depth(path: Path, width: int, height: int) -> NDArray[np.uint16]:
    import cv2

    try:
        image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise UnreadableImageError(path, "cannot be decoded; download the file again.")
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise UnreadableImageError(
            path,
            f"depth of {8 * image.dtype.itemsize} bits and {channels} channels; it must be one "
            "channel of 16 bits, so take the original.",
        )
    if image.shape != (height, width):
        raise UnreadableImageError(
            path,
            f"depth of {size_text(image.shape)} pixels but the colour image has {width}x{height}; "
            "take depth that is registered to the colour images.",
        )
    return np.asarray(image, np.uint16)
