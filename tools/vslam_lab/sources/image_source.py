"""Defines ``ImageSource``, the type that all readers of image collections return, and functions
that these readers share."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.image_files import read_grey
from vslam.loopclosure.siamese.images import Fit, Size, to_size
from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.untrusted import is_image

SAME, UNKNOWN, DIFFERENT = 1, 0, -1
_FIELD_OF_VIEW = 80.0  # horizontal field of view that turn_homography assumes, degrees
_NO_TRUTH = (
    "{}: contains no ground truth (a square matrix with at least one match); give the loop matrix "
    "of these images."
)


@dataclass(frozen=True)
class ImageSource:
    """A source of N images with a known relation between each pair of images.

    Attributes:
        name: name of the source.
        family: name of a group of sources; sources of the same family may show the same places.
        names: names of the N images, as ``folder/file``.
        images: the N image files, or their encoded bytes as ``(B,)`` uint8.
        relation: ``(N, N)`` int8, symmetric. The value is 1 if both images show the same place, -1
            if they show different places, and 0 if this is unknown. The diagonal is 1, because an
            image shows the same place as its augmented copies.
        unit: ``(N,)`` int32 label of the folder or stretch of road that an image belongs to. Images
            of the same unit are never split between training and validation.
        calibration: ``(8,)`` or ``(9,)`` camera model fx fy cx cy k1 k2 p1 p2 [k3]. None if the
            images are rectified.
        is_query: ``(N,)`` bool, True for images that a benchmark compares with all other images.
            None for a drive, where each image is compared with much earlier images.
        times: ``(N,)`` capture times, seconds; None if unknown.
    """

    name: str
    family: str
    names: tuple[str, ...]
    images: tuple[Path | NDArray[np.uint8], ...]
    relation: NDArray[np.int8]
    unit: NDArray[np.int32]
    calibration: NDArray[np.float64] | None = None
    is_query: NDArray[np.bool_] | None = None
    times: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.images)

    def read(self, index: int, size: Size, fit: Fit) -> NDArray[np.uint8]:
        """Read an image as uint8. It is undistorted and resized to ``size``.

        Raises:
            UnreadableImageError: the image is missing or damaged.
        """
        return to_size(self.grey(index), size, fit)

    def grey(self, index: int) -> NDArray[np.uint8]:
        """Read an image as ``(H, W)`` uint8. It is undistorted, but not resized."""
        file = self.images[index]
        image = read_grey(file) if isinstance(file, Path) else _decoded(file, self.names[index])
        return image if self.calibration is None else undistorted(image, self.calibration)

    def select(self, chosen: NDArray[np.int64]) -> ImageSource:
        """Return a source with only the images that have the ``(M,)`` indices ``chosen``, in this
        order."""
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            images=tuple(self.images[i] for i in chosen),
            relation=self.relation[np.ix_(chosen, chosen)],
            unit=self.unit[chosen],
            is_query=None if self.is_query is None else self.is_query[chosen],
            times=None if self.times is None else self.times[chosen],
        )


def _decoded(encoded: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    import cv2

    image = None
    with suppress(cv2.error):  # too large, or empty
        image = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise UnreadableImageError(Path(name), "cannot be decoded; pack the images again.")
    return np.asarray(image, np.uint8)


def undistorted(image: NDArray[np.uint8], calibration: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Remove the radial and tangential distortion of an image (Brown's model). The image size and
    the camera matrix stay the same."""
    import cv2

    fx, fy, cx, cy = calibration[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return np.asarray(cv2.undistort(image, K, calibration[4:]), np.uint8)


def parse_size(text: str) -> Size:
    """Parse an image size: ``129`` (a square) or ``81x145`` (height and width).

    Raises:
        InputError: the text has a different form, or a side is below 32 pixels.
    """
    height, by, width = text.lower().partition("x")
    if not by:
        width = height
    if not (height.isdecimal() and width.isdecimal()):
        raise InputError(
            f"--pixels {text}: write the side of a square, as in 129, or height and width, as in "
            "81x145."
        )
    if min(int(height), int(width)) < 32:
        raise InputError(f"--pixels {text}: a network needs 32 pixels or more on each side.")
    return int(height), int(width)


def turn_homography(width: int, height: int, degrees: float) -> NDArray[np.float64]:
    """Compute the ``(3, 3)`` homography that maps pixels of an image to pixels of the image that
    the camera would take after a rotation to the right by ``degrees``.

    The horizontal field of view is assumed to be 80 degrees, which is common on cars. The
    homography is also valid for images whose height was scaled.
    """
    focal = width / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]])
    return np.asarray(K @ R @ np.linalg.inv(K))


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder, sorted by name, without hidden files. The list is empty
    if there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(filter(is_image, folder.iterdir()))


def names_of(files: Iterable[Path]) -> tuple[str, ...]:
    """Return the names that images have in a source: ``folder/file``."""
    return tuple(f"{file.parent.name}/{file.name}" for file in files)


def read_loop_matrix(path: Path) -> NDArray[np.bool_]:
    """Read a loop matrix as ``(N, N)`` bool. An element is True if its two images close a loop.

    The loop matrix is the largest square matrix of a ``.mat`` file. It may be dense or sparse, and
    may have any name. Most matrices mark each pair once, in the row of the later image.

    Raises:
        InputError: there is no such file, or the file contains no loop matrix.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    if not path.is_file():
        raise InputError(f"{path}: no such file; give the loop matrix of these images.")
    try:
        content = loadmat(path)
    except (OSError, ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise InputError(f"{path}: not a readable .mat file; download it again.") from error
    matrices = [m for key, m in content.items() if not key.startswith("__")]
    matrices = [m for m in matrices if m.ndim == 2 and m.shape[0] == m.shape[1] and m.size > 1]
    if not matrices:
        raise InputError(_NO_TRUTH.format(path))
    largest = max(matrices, key=lambda m: m.shape[0])
    dense = largest.toarray() if hasattr(largest, "toarray") else largest
    if not dense.any():
        raise InputError(_NO_TRUTH.format(path))
    return np.asarray(dense != 0)
