"""Calibration boards: describes them, detects their corners, and recognises unknown boards.

If the images do not show the expected board, the error message tells which board they show.

A board lies in the plane z = 0 of its frame. The frame of a checkerboard or ChArUco board has x to
the right, y down and z away from the viewer. The frame of an AprilGrid is defined as in Kalibr,
with x to the right, y up and z towards the viewer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import read_document
from vslam.calibration.models import Array
from vslam.support.errors import InputError
from vslam.types.camera import Image

Kind = Literal["checkerboard", "charuco", "aprilgrid"]

_FEWEST_CORNERS = 8  # that a view must have; a homography needs four
_FEWEST_TAGS = 4
_LARGEST_M = 0.5  # largest side of a square; a larger number is usually meant in millimetres
_TAGS = "APRILTAG_36H11"
_BORDERS = (2, 1)  # black bits around a tag: Kalibr prints 2, most other programs 1
_SEARCHED_PX = 960  # longer side of the reduced image in which a checkerboard is searched
_REACH_PX = (2, 6)  # least and greatest half width of the window in which a corner is refined

# An unknown board counts as recognised if this many tags are found, or if two images show the same
# checkerboard. Fewer are not enough: in images of houses, a few false tags and a small false
# checkerboard are often found.
_RECOGNISED_TAGS = 6
# The family of a dictionary is recognised by its first tags only. This is many times faster than
# searching for all of its tags.
_TRIED_TAGS = 50
# Numbers of tags of the dictionaries of one family. Each dictionary begins with the tags of the
# next smaller one.
_SIZES = (50, 100, 250, 1000)
# The largest dictionary of each family, and the black bits around its tags.
_FAMILIES = tuple((f"{n}X{n}_1000", 1) for n in (4, 5, 6, 7))
_FAMILIES += (("ARUCO_ORIGINAL", 1), *((_TAGS, border) for border in _BORDERS))
_MOST_COLUMNS = 40
_OFF_PLACE = 0.2  # largest distance of a tag from its place in the layout, in squares
# Relative error of the measured ratio of marker to square. Blur makes markers look smaller.
_SAME_RATIO = 0.12


@dataclass(frozen=True)
class Board:
    """A printed board.

    Attributes:
        kind: the pattern.
        columns, rows: size of the board, counted in inner corners for a checkerboard, in squares
            for a ChArUco board, and in tags for an AprilGrid.
        square: side of a square in metres. For an AprilGrid, it is the distance from one tag to the
            next.
        marker: side of the black marker or tag in metres; 0 for a checkerboard.
        dictionary: dictionary of the markers of a ChArUco board. It is OpenCV's name in capitals,
            without ``DICT_``.

    Raises:
        InputError: a size is impossible, or the dictionary is unknown or has too few markers.
    """

    kind: Kind
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = "5X5_1000"

    def __post_init__(self) -> None:
        if not 0 <= self.marker < self.square <= _LARGEST_M:
            raise InputError(
                f"a board cannot have squares of {self.square:g} m and markers of {self.marker:g} "
                "m; give both in metres, such as 0.025 for 25 mm."
            )
        least = 1 if self.kind == "aprilgrid" else 3
        if not all(least <= n <= 100 for n in (self.columns, self.rows)):
            raise InputError(
                f"a {self.kind} cannot have the size {self.columns}x{self.rows}; give {least} to "
                "100 columns and rows."
            )
        n = len(_dictionary(self.dictionary).bytesList)
        if self.kind == "charuco" and n < self.columns * self.rows // 2:
            raise InputError(
                f"--dictionary {self.dictionary}: {n} markers are too few for this board; give the "
                "--size and the --dictionary that were printed."
            )

    def __str__(self) -> str:
        size = f"{self.columns}x{self.rows}"
        return {
            "checkerboard": f"checkerboard of {size} inner corners",
            "charuco": f"ChArUco board of {size} squares with markers of {self.dictionary}",
            "aprilgrid": f"AprilGrid of {size} tags",
        }[self.kind]


@dataclass(frozen=True)
class View:
    """The corners of a board that are visible in one image.

    Attributes:
        ids: ``(N,)`` int64 numbers of the corners, which are rows of `board_points`.
        xy: ``(N, 2)`` float64 positions of the corners in pixels.
    """

    name: str
    ids: NDArray[np.int64]
    xy: Array


def read_board(path: Path) -> Board:
    """Read a Kalibr target file that describes an ``aprilgrid`` or a ``checkerboard``.

    Raises:
        InputError: the file describes another kind of board, a key is missing, or a size is
            impossible.
    """
    document = read_document(path)
    kind = document.text("target_type")
    if kind == "aprilgrid":
        names, marker = ("tagCols", "tagRows"), document.number("tagSize")
        square = marker * (1 + document.number("tagSpacing"))
    elif kind == "checkerboard":
        names, marker = ("targetCols", "targetRows"), 0.0
        square = document.number("colSpacingMeters")
        if square != document.number("rowSpacingMeters"):
            raise InputError(f"{path}: the board's fields are not square; use a board of squares.")
    else:
        raise InputError(
            f"{path}: the target_type {kind} is unknown; use an aprilgrid or a checkerboard."
        )
    columns, rows = (document.integers(name, 1)[0] for name in names)
    try:
        return Board(cast("Kind", kind), columns, rows, square, marker)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def board_points(board: Board) -> Array:
    """Return the ``(N, 3)`` float64 positions of the corners in the board's frame, in metres."""
    first = 1 if board.kind == "charuco" else 0  # a ChArUco board's origin is its outer corner
    x, y = np.meshgrid(np.arange(first, board.columns), np.arange(first, board.rows))
    points = np.stack([x, y, np.zeros(x.shape)], axis=-1).reshape(-1, 3) * board.square
    if board.kind == "aprilgrid":
        # OpenCV's first corner of a tag is at the lower right of a tag that Kalibr has printed.
        tag = np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]]) * board.marker
        points = (points[:, None] + tag).reshape(-1, 3)
    return np.asarray(points, np.float64)


def find_corners(board: Board, image: Image, name: str = "") -> View | None:
    """Find a board in an ``(H, W)`` uint8 image. Returns None if too few corners are visible."""
    find = {"checkerboard": _checkerboard, "charuco": _charuco, "aprilgrid": _aprilgrid}[board.kind]
    found = find(board, image)
    return None if found is None else _refined(board, image, View(name, *found))


def same_order(board: Board, left: View, right: View) -> View:
    """Renumber the corners in the right image so that they correspond to those in the left image.

    Some checkerboards look the same upside down, so the numbering of their corners may start at
    either end. The function chooses the numbering for which the offsets between corresponding
    corners of the two images vary least.
    """
    if board.kind != "checkerboard":
        return right
    grid = right.xy.reshape(board.rows, board.columns, 2)
    turned = [np.rot90(grid, k) for k in range(4)]
    xy = [each.reshape(-1, 2) for each in turned if each.shape == grid.shape]
    return replace(right, xy=min(xy, key=lambda each: np.std(each - left.xy, axis=0).sum()))


def other_board(board: Board, images: Sequence[Image]) -> str:
    """Return a text that names the board in ``images`` and its options, for an error message. The
    text is empty if the images show ``board``, or if no board is recognised."""
    small = [_reduced(image)[0] for image in images]
    found = _recognised_tags(small) or _recognised_checkerboard(small)
    if found is None:
        return ""
    if found.kind == board.kind and found.columns == board.columns:  # some rows may be out of view
        found = replace(found, rows=max(found.rows, board.rows))
    n = (found.columns * found.rows + 1) // 2  # number of markers of a ChArUco board
    given, tags = (_dictionary(each.dictionary).bytesList[:n] for each in (board, found))
    # The dictionary of ``board`` is right if it begins with the markers of the recognised board.
    dictionary = board.dictionary
    if found.kind == "charuco" and not np.array_equal(given, tags):
        least = next((size for size in _SIZES if size >= n), _SIZES[-1])
        dictionary = found.dictionary.replace("_1000", f"_{least}")
    found = replace(found, dictionary=dictionary)
    ratio = found.marker / found.square
    same_layout = replace(found, square=board.square, marker=board.marker) == board
    if same_layout and abs(board.marker / board.square - ratio) <= _SAME_RATIO * ratio:
        return ""
    options = f"--board {found.kind} --size {found.columns}x{found.rows}"
    options += f" --dictionary {found.dictionary}" if found.kind == "charuco" else ""
    if found.marker:
        options += f", and measure --square and --marker (about {ratio:.1f} of --square)"
    article = "an" if found.kind == "aprilgrid" else "a"
    return f"the images show {article} {found}: give {options}"


def _checkerboard(board: Board, image: Image) -> tuple[NDArray[np.int64], Array] | None:
    small, times = _reduced(image)
    size, flags = (board.columns, board.rows), cv2.CALIB_CB_NORMALIZE_IMAGE
    found, xy = cv2.findChessboardCornersSB(small, size, flags=flags)
    if not found:
        return None
    return np.arange(len(xy)), (xy.reshape(-1, 2).astype(np.float64) + 0.5) * times - 0.5


def _reduced(image: Image) -> tuple[Image, float]:
    """Reduce an image to a size at which OpenCV finds a checkerboard quickly. Returns the image and
    the factor by which it was reduced."""
    times = max(1.0, max(image.shape) / _SEARCHED_PX)
    small = cv2.resize(image, None, None, 1 / times, 1 / times, cv2.INTER_AREA)
    return cast("Image", small), times


def _charuco(board: Board, image: Image) -> tuple[NDArray[np.int64], Array] | None:
    size, markers = (board.columns, board.rows), _dictionary(board.dictionary)
    layout = cv2.aruco.CharucoBoard(size, board.square, board.marker, markers)
    ids, xy = np.empty(0, np.int64), np.empty((0, 2))
    # Boards of even height that OpenCV printed before version 4.6 begin with a marker. The layout
    # that fits more tags is the correct one.
    for legacy in (False, True)[: 2 - board.rows % 2]:
        layout.setLegacyPattern(legacy)
        at, numbers, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(image)
        if numbers is not None and len(numbers) > len(ids):
            ids, xy = numbers.ravel().astype(np.int64), at.reshape(-1, 2).astype(np.float64)
    if len(ids) < _FEWEST_CORNERS or not np.ptp(board_points(board)[ids, :2], axis=0).all():
        return None  # corners on one line do not determine the pose of the board
    return ids, xy


def _aprilgrid(board: Board, image: Image) -> tuple[NDArray[np.int64], Array] | None:
    for border in _BORDERS:
        numbers, xy = _find_tags(image, _TAGS, border)
        known = numbers < board.columns * board.rows
        if np.count_nonzero(known) >= _FEWEST_TAGS:
            ids = (4 * numbers[known, None] + np.arange(4)).ravel()
            at, plane = xy[known].reshape(-1, 2), np.add(board_points(board), [0, 0, 1])
            # Most programs print the tags upright. Kalibr turns them, which swaps corners 0 and 2.
            # With the correct order of corners, an affine map fits the image better.
            error = [np.linalg.lstsq(plane[each], at)[1].sum() for each in (ids, ids ^ 2)]
            return ids if error[0] <= error[1] else ids ^ 2, at
    return None


def _find_tags(
    image: Image, dictionary: str, border: int, most: int | None = None
) -> tuple[NDArray[np.int64], Array]:
    """Find markers or AprilTags of a dictionary in an image.

    Args:
        border: number of black bits around a tag.
        most: search only for the first ``most`` tags of the dictionary; None searches for all.

    Returns:
        ``(N,)`` numbers of the tags, and ``(N, 4, 2)`` positions of their corners in pixels.
    """
    tags, parameters = _dictionary(dictionary), cv2.aruco.DetectorParameters()
    tags.bytesList, parameters.markerBorderBits = tags.bytesList[:most], border
    corners, numbers, _ = cv2.aruco.ArucoDetector(tags, parameters).detectMarkers(image)
    found = np.empty(0) if numbers is None else numbers
    return found.ravel().astype(np.int64), np.array(corners, np.float64).reshape(-1, 4, 2)


def _dictionary(name: str) -> Any:
    number = getattr(cv2.aruco, f"DICT_{name}", None)
    if number is None:
        raise InputError(
            f"--dictionary {name}: OpenCV has no such markers; give a name such as 5X5_1000."
        )
    return cv2.aruco.getPredefinedDictionary(number)


def _refined(board: Board, image: Image, view: View) -> View | None:
    """Refine each corner to the intersection of the edges around it. Drop corners that move far."""
    share = {  # half width of the window as a fraction of the distance between neighbouring corners
        "checkerboard": 0.3,
        "charuco": 0.4 * (1.0 - board.marker / board.square),
        "aprilgrid": min(0.4, 0.12 * board.marker / (board.square - board.marker)),
    }[board.kind]
    apart = np.linalg.norm(view.xy[:, None] - view.xy, axis=2)
    reach = int(np.clip(share * apart[apart > 0.0].min(), *_REACH_PX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
    start = view.xy.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start, (reach, reach), (-1, -1), criteria)
    xy = np.asarray(moved, np.float64).reshape(-1, 2)
    kept = np.linalg.norm(xy - view.xy, axis=1) <= reach
    if board.kind == "checkerboard":  # the numbers are only correct if no corner is missing
        return replace(view, xy=np.where(kept[:, None], xy, view.xy))
    return View(view.name, view.ids[kept], xy[kept]) if kept.sum() >= _FEWEST_CORNERS else None


def _recognised_checkerboard(images: Sequence[Image]) -> Board | None:
    """Recognise a checkerboard that at least two images show. Its squares are assumed to be 0.1 m
    wide."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (4, 3), flags)
        if found:
            sizes[max(meta.shape), min(meta.shape)] += 1
    return next((Board("checkerboard", *at, 0.1) for at, n in sizes.most_common(1) if n > 1), None)


def _recognised_tags(images: Sequence[Image]) -> Board | None:
    """Recognise a ChArUco board or AprilGrid, using the image that shows the most tags. Its squares
    are assumed to be 0.1 m wide. Its dictionary is the largest one of the family."""
    counts = [
        (len(_find_tags(image, *family, _TRIED_TAGS)[0]), image, family)
        for image, family in product(images, _FAMILIES)
    ]
    n, image, (family, border) = max(counts, key=itemgetter(0))
    if n < _RECOGNISED_TAGS:
        return None
    tags = _find_tags(image, family, border)
    kinds: tuple[tuple[Kind, int], ...] = (("charuco", 1), ("charuco", 0), ("aprilgrid", 0))
    layouts = [
        _layout(kind, first, columns, family, *tags)
        for (kind, first), columns in product(kinds, range(3, _MOST_COLUMNS))
        if kind == "charuco" or family == _TAGS
    ]
    _, found = max(layouts, key=itemgetter(0))
    return found if found is not None and find_corners(found, image) is not None else None


def _layout(
    kind: Kind, first: int, columns: int, family: str, numbers: NDArray[np.int64], xy: Array
) -> tuple[int, Board | None]:
    """Fit a board with a given number of columns to the tags in an image. It is assumed that tag 0
    is in column ``first`` of the first row.

    Returns:
        The number of tags that fit, and the board; 0 and None if too few tags fit, or if such a
        board is impossible.
    """
    step = 2 if kind == "charuco" else 1  # a ChArUco board has a tag on every other square
    squares = np.indices((step * numbers.max() // columns + 2, columns)).sum(axis=0)
    at = np.argwhere(squares % step == first)[numbers, ::-1].astype(np.float64)
    H, mask = cv2.findHomography(xy.mean(axis=1), at, cv2.RANSAC, _OFF_PLACE, maxIters=200)
    if H is None or (n := int(np.count_nonzero(mask))) < _RECOGNISED_TAGS:
        return 0, None
    fits = mask.ravel() > 0
    tags = cv2.perspectiveTransform(xy[fits].reshape(1, -1, 2), H).reshape(-1, 4, 2)
    ratio = float(np.median(np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2)))
    if not 0.0 < ratio < 1.0:
        return 0, None
    rows = max(3 if kind == "charuco" else 1, int(at[fits, 1].max()) + 1)
    try:
        return n, Board(kind, columns, rows, 0.1, 0.1 * ratio, family)
    except InputError:
        return 0, None
