"""Images of a calibration board, as a camera with a known model sees it."""

from __future__ import annotations

import cv2
import numpy as np

from vslam.calibration.boards import Board
from vslam.calibration.models import CameraModel

BIT = 12  # pixels of the texture per bit of a tag
FINE = 2  # samples per pixel in each direction


def texture(
    board: Board, *, legacy: bool = False, border: int = 2, upright: bool = False
) -> tuple[np.ndarray, float, np.ndarray]:
    """Draw the printed board with its margin.

    Args:
        board: the board.
        legacy: whether a ChArUco board of even height begins with a marker, as before OpenCV 4.6.
        border: number of black bits around the tags of an AprilGrid.
        upright: whether the tags of an AprilGrid are upright. Kalibr prints them upside down.

    Returns:
        The image, the number of pixels per metre, and the position of the board's origin.
    """
    side = 60
    if board.kind == "charuco":
        size = (board.columns, board.rows)
        number = getattr(cv2.aruco, f"DICT_{board.dictionary}")
        markers = cv2.aruco.getPredefinedDictionary(number)
        made = cv2.aruco.CharucoBoard(size, board.square, board.marker, markers)
        made.setLegacyPattern(legacy)
        image = made.generateImage((side * board.columns, side * board.rows))
        return _framed(image, side, side / board.square)
    if board.kind == "checkerboard":
        fields = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
        image = np.kron(255 * fields.astype(np.uint8), np.ones((side, side), np.uint8))
        framed, scale, origin = _framed(image, side, side / board.square)
        return framed, scale, origin + side
    return _aprilgrid(board, border, upright)


def _framed(image: np.ndarray, margin: int, scale: float) -> tuple[np.ndarray, float, np.ndarray]:
    framed = cv2.copyMakeBorder(image, *(margin,) * 4, cv2.BORDER_CONSTANT, value=255)
    return framed, scale, np.array([margin, margin], float)


def _aprilgrid(board: Board, border: int, upright: bool) -> tuple[np.ndarray, float, np.ndarray]:
    """Draw an AprilGrid. A black square is in every corner between tags."""
    tag = (6 + 2 * border) * BIT
    pitch = round(tag * board.square / board.marker)
    gap = pitch - tag
    across, down = pitch * board.columns + gap, pitch * board.rows + gap
    image = np.full((down, across), 255, np.uint8)
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for row in range(board.rows):
        for column in range(board.columns):
            number = row * board.columns + column
            drawn = cv2.aruco.generateImageMarker(markers, number, tag, borderBits=border)
            y, x = down - pitch * (row + 1), gap + pitch * column
            image[y : y + tag, x : x + tag] = drawn if upright else np.rot90(drawn, 2)
    for y in range(0, down, pitch):
        for x in range(0, across, pitch):
            image[y : y + gap, x : x + gap] = 0
    framed, scale, origin = _framed(image, gap, tag / board.marker)
    return framed, scale, origin + np.array([gap, down - gap])


class Renderer:
    def __init__(self, board: Board, model: CameraModel, **printed: bool | int) -> None:
        self.printed, self.scale, self.origin = texture(board, **printed)
        self.up = board.kind == "aprilgrid"
        self.model = model
        width, height = FINE * model.width, FINE * model.height
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        xy = (np.stack([u, v], axis=-1).reshape(-1, 1, 2) + 0.5) / FINE - 0.5
        K = np.array([[model.fx, 0, model.cx], [0, model.fy, model.cy], [0, 0, 1.0]])
        D = np.array(model.distortion or (0.0,) * 4)
        if model.lens == "fisheye":
            plane = cv2.fisheye.undistortPoints(xy, K, D)
        else:
            criteria = (cv2.TERM_CRITERIA_MAX_ITER, 40, 0)
            plane = cv2.undistortPoints(xy, K, D, criteria=criteria)
        plane = plane.reshape(height, width, 2)
        self.rays = np.concatenate([plane, np.ones((height, width, 1))], axis=2)

    def image(self, T_camera_board: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Render an image with a little noise. The background of the board is grey."""
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        directions = self.rays @ R
        start = -R.T @ t
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -start[2] / directions[..., 2]
        at = start[:2] + depth[..., None] * directions[..., :2]
        at[~(depth > 0)] = 1e3
        at = at * (1, -1) if self.up else at
        # Board coordinates refer to the borders of texture pixels, but the centre of the first
        # pixel is at 0.
        maps = (at * self.scale + self.origin - 0.5).astype(np.float32)
        fine = cv2.remap(
            self.printed, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=110,
        )  # fmt: skip
        size = (self.model.width, self.model.height)
        image = cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(float)
        image = 30 + 0.75 * image + rng.normal(0.0, 1.5, image.shape)
        return np.rint(image.clip(0, 255)).astype(np.uint8)
