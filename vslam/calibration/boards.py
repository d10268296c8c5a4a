"""Calibration boards, the detection of their corners by OpenCV, and the recognition of a board that
is not the expected one.

A board is flat. Its frame has x to the right, y down and z away from the viewer; an AprilGrid's is
Kalibr's, with y up and z towards the viewer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import read_document
from vslam.calibration.models import Array
from vslam.camera import Image
from vslam.errors import InputError

Kind = Literal["checkerboard", "charuco", "aprilgrid"]

_FEWEST_CORNERS = 8  # of a view; a homography needs four
_FEWEST_TAGS = 4
_LARGEST_M = 0.5  # side of a square; larger numbers are usually millimetres
_TAGS = "APRILTAG_36h11"
_BORDERS = (2, 1)  # bits of black around a tag: Kalibr prints 2, most other programs 1
_SEARCHED_PX = 960  # longer side of the image in which a checkerboard is searched
_REACH_PX = (2, 6)  # of the refinement, to each side

# For the recognition of a board. Houses and fences show a few false tags and small checkerboards;
# more than these, or the same one twice, come from a board.
_RECOGNISED_TAGS = 6
_SMALLEST = (4, 3)
_SIZES = (50, 100, 250, 1000)
_FAMILIES = (
    *((f"{bits}X{bits}_1000", 1) for bits in (4, 5, 6, 7)),
    ("ARUCO_ORIGINAL", 1),
    *((_TAGS, bits) for bits in _BORDERS),
)  # the largest dictionary of each family, and the bits of black around its tags
_TRIED_TAGS = 50
_MOST_COLUMNS = 40
_OFF_PLACE = 0.25  # distance of a tag from its place in the layout, in tag sides
_TRIALS = 200  # of RANSAC; few tags are wrong
_SAME_RATIO = 0.12  # relative error of marker / square, which blur makes too small


@dataclass(frozen=True)
class Board:
    """A printed board.

    Attributes:
        kind: what is printed.
        columns, rows: inner corners of a checkerboard, squares of a ChArUco board, tags of an
            AprilGrid.
        square: side of a square in metres; of an AprilGrid, the distance from one tag to the next.
        marker: side of the black marker or tag in metres; 0 for a checkerboard.
        dictionary: OpenCV's name of a ChArUco board's markers, without ``DICT_``.

    Raises:
        InputError: a size is impossible.
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
                f"a board has no squares of {self.square:g} m with markers of {self.marker:g} m; "
                "give both in metres, such as 0.025 for 25 mm, and the marker smaller."
            )
        least = 1 if self.kind == "aprilgrid" else 3
        if not all(least <= n <= 100 for n in (self.columns, self.rows)):
            raise InputError(
                f"a {self.kind} has no size of {self.columns}x{self.rows}; give {least} to 100 "
                "columns and rows."
            )

    def __str__(self) -> str:
        size = f"{self.columns}x{self.rows}"
        return {
            "checkerboard": f"checkerboard of {size} inner corners",
            "charuco": f"ChArUco board of {size} squares with markers of {self.dictionary}",
            "aprilgrid": f"AprilGrid of {size} tags",
        }[self.kind]


@dataclass(frozen=True)
class Corners:
    """The corners of a board that one image shows.

    Attributes:
        ids: ``(N,)`` int64, rows of `board_points`.
        xy: ``(N, 2)`` float64 pixels.
    """

    ids: NDArray[np.int64]
    xy: Array


Finder = Callable[[Image], Corners | None]


def read_board(path: Path) -> Board:
    """Read a target of Kalibr: an ``aprilgrid`` or a ``checkerboard``.

    Raises:
        InputError: the file is no such target, a key is missing, or a size is impossible.
    """
    document = read_document(path)
    kind = document.text("target_type")
    marker = 0.0
    if kind == "aprilgrid":
        names = "tagCols", "tagRows"
        marker = document.number("tagSize")
        square = marker * (1 + document.number("tagSpacing"))
    elif kind == "checkerboard":
        names = "targetCols", "targetRows"
        square = document.number("colSpacingMeters")
        if square != document.number("rowSpacingMeters"):
            raise InputError(f"{path}: the fields of the board are not square; use another board.")
    else:
        raise InputError(
            f"{path}: the target_type {kind} is unknown; use an aprilgrid or a checkerboard."
        )
    columns, rows = (int(document.number(name)) for name in names)
    try:
        return Board(cast("Kind", kind), columns, rows, square, marker)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def board_points(board: Board) -> Array:
    """``(N, 3)`` float64, the corners of a board in its frame, in metres."""
    first = 1 if board.kind == "charuco" else 0  # its inner corners, counted from its outer one
    across, down = np.meshgrid(np.arange(first, board.columns), np.arange(first, board.rows))
    flat = np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    points = np.asarray(flat * board.square, np.float64)
    if board.kind != "aprilgrid":
        return points
    # The corners of a tag clockwise, from the lower right one on: where OpenCV begins with a tag
    # that Kalibr prints.
    around = np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]]) * board.marker
    return np.asarray((points[:, None] + around).reshape(-1, 3))


def corner_finder(board: Board) -> Finder:
    """The function that finds the corners of a board in an ``(H, W)`` uint8 image; it returns None
    for an image that does not show enough of the board.

    Raises:
        InputError: the dictionary has too few markers for the board.
    """
    finders = {
        "checkerboard": _checkerboard_finder,
        "charuco": _charuco_finder,
        "aprilgrid": _aprilgrid_finder,
    }
    find, points = finders[board.kind](board), board_points(board)

    def find_refined(image: Image) -> Corners | None:
        found = find(image)
        return None if found is None else _refined(board, points, image, found)

    return find_refined


def same_order(board: Board, left: Corners, right: Corners) -> Corners:
    """The right corners, numbered like the left ones.

    A checkerboard that looks the same upside down may be numbered from either end. Of all the
    numberings, that of the left image gives the most similar directions.
    """
    if board.kind != "checkerboard":
        return right
    grid = right.xy.reshape(board.rows, board.columns, 2)
    turned = [np.rot90(grid, k) for k in range(4)]
    numbered = [g.reshape(-1, 2) for g in turned if g.shape == grid.shape]
    centred = left.xy - left.xy.mean(axis=0)
    off = [float(np.linalg.norm(xy - xy.mean(axis=0) - centred)) for xy in numbered]
    return Corners(right.ids, numbered[int(np.argmin(off))])


def other_board(board: Board, images: Sequence[Image]) -> str:
    """What images show instead of ``board`` and the options that describe it, as a clause; empty if
    they show this board, or none that is recognised."""
    small = [_reduced(image)[0] for image in images]
    found = _tagged_board(small) or _checkerboard(small)
    if found is None:
        return ""
    if found.kind == board.kind and found.columns == board.columns:  # some rows may be out of sight
        found = replace(found, rows=max(found.rows, board.rows))
    family, given = (each.dictionary.rpartition("_")[0] for each in (found, board))
    if found.kind != "charuco" or family == given:
        found = replace(found, dictionary=board.dictionary)
    ratio = found.marker / found.square
    known = replace(found, square=board.square, marker=board.marker) == board
    if known and abs(board.marker / board.square - ratio) <= _SAME_RATIO * ratio:
        return ""
    options = f"--board {found.kind} --size {found.columns}x{found.rows}"
    options += f" --dictionary {found.dictionary}" if found.kind == "charuco" else ""
    if found.marker:
        options += f", and measure --square and --marker (about {ratio:.1f} of --square)"
    article = "an" if found.kind == "aprilgrid" else "a"
    return f"the images show {article} {found}: give {options}"


def _checkerboard_finder(board: Board) -> Finder:
    import cv2

    def find(image: Image) -> Corners | None:
        small, times = _reduced(image)
        found, xy = cv2.findChessboardCornersSB(
            small, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            return None
        whole = (xy.reshape(-1, 2).astype(np.float64) + 0.5) * times - 0.5
        return Corners(np.arange(len(xy)), whole)

    return find


def _reduced(image: Image) -> tuple[Image, float]:
    """An image in which a checkerboard is found quickly, and how many times smaller it is."""
    import cv2

    times = max(1.0, max(image.shape) / _SEARCHED_PX)
    small = cv2.resize(image, None, None, 1 / times, 1 / times, cv2.INTER_AREA)
    return cast("Image", small), times


def _charuco_finder(board: Board) -> Finder:
    import cv2

    size, markers = (board.columns, board.rows), _dictionary(board.dictionary)
    if len(markers.bytesList) < board.columns * board.rows // 2:
        raise InputError(
            f"--dictionary {board.dictionary}: has too few markers for {size[0]}x{size[1]} "
            "squares; give the size and the dictionary that are printed."
        )
    detectors = []
    for legacy in (False, True):  # OpenCV before 4.6 began boards of even height with a marker
        layout = cv2.aruco.CharucoBoard(size, board.square, board.marker, markers)
        layout.setLegacyPattern(legacy)
        detectors.append(cv2.aruco.CharucoDetector(layout))
    points = board_points(board)

    def find(image: Image) -> Corners | None:
        for detector in detectors[: 1 + (board.rows % 2 == 0)]:
            xy, ids, _, _ = detector.detectBoard(image)
            if ids is not None and len(ids) >= _FEWEST_CORNERS:
                rows = np.asarray(ids, np.int64).ravel()
                if np.ptp(points[rows, :2], axis=0).all():  # corners in a row fix no pose
                    return Corners(rows, xy.reshape(-1, 2).astype(np.float64))
        return None

    return find


def _aprilgrid_finder(board: Board) -> Finder:
    detectors = [_tag_detector(_TAGS, border) for border in _BORDERS]
    points = board_points(board)

    def find(image: Image) -> Corners | None:
        for detect in detectors:
            numbers, xy = detect(image)
            known = numbers < board.columns * board.rows
            if np.count_nonzero(known) >= _FEWEST_TAGS:
                ids = (4 * numbers[known, None] + np.arange(4)).ravel()
                at = xy[known].reshape(-1, 2)
                # Other programs than Kalibr do not print the tags upside down, which shows only in
                # the grid as a whole.
                ids = min(ids, ids ^ 2, key=lambda each: _off_plane(points[each], at))
                return Corners(ids, at)
        return None

    return find


def _tag_detector(
    name: str, border: int, most: int | None = None
) -> Callable[[Image], tuple[NDArray[np.int64], Array]]:
    """The function that finds the first tags of a dictionary, or all: ``(N,)`` their numbers and
    ``(N, 4, 2)`` their corners."""
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    dictionary = _dictionary(name)
    dictionary.bytesList = dictionary.bytesList[:most]
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(image: Image) -> tuple[NDArray[np.int64], Array]:
        corners, numbers, _ = detector.detectMarkers(image)
        found = np.empty(0) if numbers is None else numbers
        return found.ravel().astype(np.int64), np.array(corners, np.float64).reshape(-1, 4, 2)

    return detect


def _dictionary(name: str) -> Any:
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _refined(board: Board, points: Array, image: Image, corners: Corners) -> Corners | None:
    """Corners moved to where the edges meet; those that moved far are left out.

    The window is small enough to show nothing but the two edges of a corner.
    """
    import cv2

    alone = {
        "checkerboard": 0.3 * board.square,
        "charuco": 0.4 * (board.square - board.marker),
        "aprilgrid": 0.6 * min(board.square - board.marker, 0.2 * board.marker),
    }
    xy = corners.xy
    metres, pixels = (np.linalg.norm(at[:, None] - at, axis=2) for at in (points[corners.ids], xy))
    near = (metres > 0.0) & (metres < 1.5 * metres[metres > 0.0].min())
    smallest = (pixels[near] / metres[near]).min()  # pixels per metre
    reach = int(np.clip(alone[board.kind] * smallest, *_REACH_PX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
    start = xy.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start, (reach, reach), (-1, -1), criteria)
    refined = np.asarray(moved, np.float64).reshape(-1, 2)
    kept = np.linalg.norm(refined - xy, axis=1) <= reach
    if board.kind == "checkerboard":  # only a whole grid can be numbered
        return Corners(corners.ids, np.where(kept[:, None], refined, xy))
    if np.count_nonzero(kept) < _FEWEST_CORNERS:
        return None
    return Corners(corners.ids[kept], refined[kept])


def _off_plane(points: Array, xy: Array) -> float:
    """How badly a homography fits corners, in pixels."""
    import cv2

    H, _ = cv2.findHomography(points[:, :2], xy)
    if H is None:
        return float("inf")
    mapped = cv2.perspectiveTransform(points[None, :, :2], H)[0]
    return float(np.linalg.norm(mapped - xy, axis=1).mean())


def _checkerboard(images: Sequence[Image]) -> Board | None:
    """The checkerboard that at least two images show, with squares of 0.1 m."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(image, _SMALLEST, flags)
        if found:
            sizes[max(meta.shape), min(meta.shape)] += 1
    (size, n), *_ = sizes.most_common(1) or [((0, 0), 0)]
    return Board("checkerboard", *size, 0.1) if n > 1 else None


def _tagged_board(images: Sequence[Image]) -> Board | None:
    """The ChArUco board or AprilGrid of which an image shows most tags, with squares of 0.1 m."""
    # The first tags of every dictionary tell the family, in a twentieth of the time of all tags.
    detectors = [(family, _tag_detector(*family, _TRIED_TAGS)) for family in _FAMILIES]
    n, image, (name, border) = max(
        (
            (len(detect(image)[0]), image, family)
            for image in images
            for family, detect in detectors
        ),
        key=itemgetter(0),
    )
    if n < _RECOGNISED_TAGS:
        return None
    numbers, xy = _tag_detector(name, border)(image)
    kinds: tuple[tuple[Kind, int], ...] = (("charuco", 1), ("charuco", 0))
    if name == _TAGS:
        kinds += (("aprilgrid", 0),)
    layouts = [
        _layout(kind, first, columns, name, numbers, xy)
        for (kind, first), columns in product(kinds, range(3, _MOST_COLUMNS))
    ]
    _, found = max(layouts, key=itemgetter(0))
    return found if found is not None and corner_finder(found)(image) is not None else None


def _layout(
    kind: Kind, first: int, columns: int, family: str, numbers: NDArray[np.int64], xy: Array
) -> tuple[int, Board | None]:
    """How many tags fit a board of so many columns, and the board; none of it if they are few.

    Args:
        first: the square of the first row that has the first tag.
        family: dictionary of the tags.
        numbers, xy: the tags that are seen, ``(N,)``, and their corners, ``(N, 4, 2)`` pixels.
    """
    import cv2

    step = 2 if kind == "charuco" else 1  # tags are on every other square
    squares = np.indices((step * numbers.max() // columns + 2, columns)).sum(axis=0)
    at = np.argwhere(squares % step == first)[numbers, ::-1].astype(np.float64)
    side = float(np.median(np.linalg.norm(xy - np.roll(xy, 1, axis=1), axis=2)))
    H, mask = cv2.findHomography(
        at, xy.mean(axis=1), cv2.RANSAC, _OFF_PLACE * side, maxIters=_TRIALS
    )
    if H is None or (n := int(np.count_nonzero(mask))) < _RECOGNISED_TAGS:
        return 0, None
    fits = mask.ravel() > 0
    tags = cv2.perspectiveTransform(xy.reshape(1, -1, 2), np.linalg.inv(H)).reshape(-1, 4, 2)[fits]
    ratio = float(np.median(np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2)))
    if not 0.0 < ratio < 1.0:
        return 0, None
    bits, _, size = family.rpartition("_")
    if size == "1000":  # the smaller dictionaries are its first markers
        family = f"{bits}_{next(n for n in _SIZES if n > numbers[fits].max())}"
    rows = max(3 if kind == "charuco" else 1, int(at[fits, 1].max()) + 1)
    return n, Board(kind, columns, rows, 0.1, 0.1 * ratio, family)
