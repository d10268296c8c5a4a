"""Calibration boards, and the detection of their corners by OpenCV.

A board is flat. Its frame has x to the right, y down and z away from the viewer; an AprilGrid's is
Kalibr's, with y up and z towards the viewer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.documents import read_document
from vslam.calibration.models import Array
from vslam.camera import Image
from vslam.errors import InputError

Kind = Literal["checkerboard", "charuco", "aprilgrid"]

_FEWEST_CORNERS = 8  # of a view; a homography needs four
_FEWEST_TAGS = 4
_TAGS = "APRILTAG_36h11"
_BORDERS = (2, 1)  # bits of black around a tag: Kalibr prints 2, most other programs 1
_FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", _TAGS)
_SEARCHED_PX = 960  # longer side of the image that a checkerboard is searched in
_REACH_PX = (2, 6)  # of the refinement, to each side


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
    """

    kind: Kind
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = "5X5_1000"

    def __str__(self) -> str:
        counted = {"checkerboard": "inner corners", "charuco": "squares", "aprilgrid": "tags"}
        kind = {
            "checkerboard": "checkerboard",
            "charuco": "ChArUco board",
            "aprilgrid": "AprilGrid",
        }
        markers = f" with markers of {self.dictionary}" if self.kind == "charuco" else ""
        return f"{kind[self.kind]} of {self.columns}x{self.rows} {counted[self.kind]}{markers}"


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
        InputError: the file is no such target, or a key is missing.
    """
    document = read_document(path)
    kind = document.text("target_type")
    if kind == "aprilgrid":
        columns, rows = int(document.number("tagCols")), int(document.number("tagRows"))
        tag = document.number("tagSize")
        return Board("aprilgrid", columns, rows, tag * (1 + document.number("tagSpacing")), tag)
    if kind == "checkerboard":
        columns, rows = int(document.number("targetCols")), int(document.number("targetRows"))
        square = document.number("colSpacingMeters")
        if square != document.number("rowSpacingMeters"):
            raise InputError(f"{path}: the fields of the board are not square; use another board.")
        return Board("checkerboard", columns, rows, square)
    raise InputError(f"{path}: target_type {kind} is unknown; known are aprilgrid, checkerboard.")


def board_points(board: Board) -> Array:
    """``(N, 3)`` float64, the corners of a board in its frame, in metres."""
    if board.kind == "charuco":
        return np.asarray(_charuco(board).getChessboardCorners(), np.float64)
    across, down = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    flat = np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    points = np.asarray(flat * board.square, np.float64)
    if board.kind == "checkerboard":
        return points
    # The corners of a tag clockwise, from the lower right one on: where OpenCV begins with a tag
    # that Kalibr prints.
    around = np.array([[1, 0, 0], [0, 0, 0], [0, 1, 0], [1, 1, 0]]) * board.marker
    return np.asarray((points[:, None] + around).reshape(-1, 3))


def corner_finder(board: Board) -> Finder:
    """The function that finds the corners of a board in an ``(H, W)`` uint8 image; it returns None
    for an image that does not show enough of the board.

    Raises:
        InputError: OpenCV knows no such markers, or has too few of them for the board.
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


def _checkerboard_finder(board: Board) -> Finder:
    import cv2

    def find(image: Image) -> Corners | None:
        times = max(1.0, max(image.shape) / _SEARCHED_PX)
        small = cv2.resize(image, None, None, 1 / times, 1 / times, cv2.INTER_AREA)
        found, xy = cv2.findChessboardCornersSB(
            small, (board.columns, board.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            return None
        whole = (xy.reshape(-1, 2).astype(np.float64) + 0.5) * times - 0.5
        return Corners(np.arange(len(xy)), whole)

    return find


def _charuco(board: Board) -> Any:
    import cv2

    size, markers = (board.columns, board.rows), _dictionary(board.dictionary)
    if len(markers.bytesList) < board.columns * board.rows // 2:
        raise InputError(
            f"--dictionary {board.dictionary}: too few markers for {size[0]}x{size[1]} squares; "
            "name a larger one."
        )
    return cv2.aruco.CharucoBoard(size, board.square, board.marker, markers)


def _charuco_finder(board: Board) -> Finder:
    import cv2

    detectors = []
    for legacy in (False, True):  # OpenCV before 4.6 began boards of even height with a marker
        layout = _charuco(board)
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
    import cv2

    detectors = []
    for bits in _BORDERS:
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = bits
        detectors.append(cv2.aruco.ArucoDetector(_dictionary(_TAGS), parameters))
    points = board_points(board)

    def find(image: Image) -> Corners | None:
        for detector in detectors:
            tags, found, _ = detector.detectMarkers(image)
            if found is None:
                continue
            known = found.ravel() < board.columns * board.rows
            if np.count_nonzero(known) >= _FEWEST_TAGS:
                numbers = found.ravel()[known].astype(np.int64)
                ids = (4 * numbers[:, None] + np.arange(4)).ravel()
                xy = np.concatenate(tags)[known].reshape(-1, 2).astype(np.float64)
                # Other programs than Kalibr do not print the tags upside down, which shows only in
                # the grid as a whole.
                ids = min(ids, ids ^ 2, key=lambda each: _off_plane(points[each], xy))
                return Corners(ids, xy)
        return None

    return find


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


def _dictionary(name: str) -> Any:
    import cv2

    number = getattr(cv2.aruco, f"DICT_{name}", None)
    if number is None:
        raise InputError(
            f"--dictionary {name}: OpenCV has no such markers; known are 4X4_50, "
            "5X5_100, 6X6_250, 7X7_1000, APRILTAG_36h11 and the like."
        )
    return cv2.aruco.getPredefinedDictionary(number)


def seen_instead(board: Board, images: Iterable[Image]) -> str:
    """What images show where the board is not found: the end of a sentence, or empty."""
    import cv2

    if board.kind == "checkerboard":
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        sizes: Counter[tuple[int, int]] = Counter()
        for image in images:
            found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
            if found:
                sizes[(max(meta.shape), min(meta.shape))] += 1
        if not sizes:
            return ""
        columns, rows = sizes.most_common(1)[0][0]
        return f"a board of {columns}x{rows} inner corners is seen: give --size {columns}x{rows}"
    wanted = _TAGS if board.kind == "aprilgrid" else board.dictionary
    seen: Counter[str] = Counter()
    for image in images:
        for name in _FAMILIES:
            ids = cv2.aruco.ArucoDetector(_dictionary(name)).detectMarkers(image)[1]
            seen[name] += 0 if ids is None else len(ids)
    name, n = seen.most_common(1)[0]
    if n < _FEWEST_TAGS:
        return ""
    if name.rpartition("_")[0] == wanted.rpartition("_")[0]:
        return "its markers are seen: check --size, --square and --marker"
    of_board = "aprilgrid" if name == _TAGS else f"charuco --dictionary {name}"
    return f"markers of {name} are seen: give --board {of_board}"
