"""Paints procedural textures of plants, fences, walls, signs and sky.

The values are albedos from 0 to 255. The first row is the top of the texture.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam_lab.towns.shade import SKY_FALL, SKY_RISE

Grey = NDArray[np.float32]
Rng = np.random.Generator
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX)
_LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVWZ0123456789"))


def noise(rng: Rng, height: int, width: int, cell: float, octaves: int = 4) -> Grey:
    """Make ``(height, width)`` float32 tileable noise with zero mean and unit variance.

    Args:
        cell: cell size of the coarsest grid in texels. Each octave has half the cell size and 0.7
            of the contrast of the octave before.
    """
    total = np.zeros((1, 1), np.float32)
    for octave in range(octaves):
        size = max(cell * 0.5**octave, 1.0)
        shape = max(2, round(height / size)), max(2, round(width / size))
        total = _stretch(total, *shape) + 0.7**octave * rng.standard_normal(shape, np.float32)
    total = _stretch(total, height, width)
    return np.asarray((total - total.mean()) / max(float(total.std()), 1e-6), np.float32)


def _stretch(grid: Grey, height: int, width: int) -> Grey:
    """Enlarge a grid by bilinear interpolation with periodic borders."""
    if grid.shape == (height, width):
        return grid
    padded = np.pad(grid, 1, mode="wrap")
    rows = (np.arange(height, dtype=np.float32) + 0.5) * (grid.shape[0] / height) - 0.5 + 1
    columns = (np.arange(width, dtype=np.float32) + 0.5) * (grid.shape[1] / width) - 0.5 + 1
    at = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(padded, at[0], at[1], cv2.INTER_LINEAR), np.float32)


def detail(rng: Rng, contrast: float, cell: float = 8.0, size: int = 256) -> Grey:
    """Make a fine texture with mean 128, by which a coarse texture is multiplied."""
    return np.clip(128.0 * (1.0 + contrast * noise(rng, size, size, cell, 4)), 8, 255)


def letters(rng: Rng, low: int = 3, high: int = 9) -> str:
    return "".join(rng.choice(_LETTERS, int(rng.integers(low, high))))


def write(image: Grey, rng: Rng, text: str, box: tuple[int, int, int, int], grey: float) -> None:
    """Draw ``text`` as large as possible in ``box``, which is x0, y0, x1, y1 in texels."""
    x0, y0, x1, y1 = box
    font: Any = _FONTS[int(rng.integers(len(_FONTS)))]
    thickness = 1 + (y1 - y0 > 24)
    (width, height), _ = cv2.getTextSize(text, font, 1.0, thickness)
    scale = min((x1 - x0) / max(width, 1), (y1 - y0) / max(height, 1)) * 0.9
    if scale <= 0.05:
        return
    x = int((x0 + x1 - width * scale) / 2)
    y = int((y0 + y1 + height * scale) / 2)
    ink = np.zeros(image.shape, np.uint8)  # OpenCV 5 draws text only on uint8
    cv2.putText(ink, text, (x, y), font, scale, 255, thickness, cv2.LINE_AA)
    image += (grey - image) * (ink / np.float32(255.0))


def sign(rng: Rng, size: int = 128) -> tuple[Grey, Grey]:
    """Make the texture of a round, triangular or square sign. Its alpha is symmetric."""
    grey = np.full((size, size), float(rng.uniform(190, 235)), np.float32)
    alpha = np.zeros((size, size), np.float32)
    middle, rim = (size // 2, size // 2), float(rng.uniform(40, 90))
    kind = int(rng.integers(4))
    inner = (int(size * 0.2), int(size * 0.3), int(size * 0.8), int(size * 0.7))
    if kind == 0:
        cv2.circle(alpha, middle, size // 2 - 2, 255.0, -1)
        cv2.circle(grey, middle, size // 2 - 8, rim, 11, cv2.LINE_AA)
        write(grey, rng, str(int(rng.integers(2, 9)) * 10), inner, 25)
    elif kind == 1:
        corners = np.array([[4, 10], [size - 4, 10], [size // 2, size - 6]])
        if rng.random() < 0.5:
            corners[:, 1] = size - corners[:, 1]
        cv2.fillPoly(alpha, [corners], 255.0)
        cv2.polylines(grey, [corners], True, rim, 16, cv2.LINE_AA)
        cv2.circle(grey, middle, 7, 30.0, -1)
    else:
        top = int(size * rng.uniform(0.0, 0.35))
        alpha[top : size - top] = 255.0
        grey[top : size - top] = rng.choice([60.0, 95.0, 215.0])
        ink = 235.0 if grey[size // 2, 2] < 150 else 30.0
        cv2.rectangle(grey, (4, top + 4), (size - 5, size - top - 5), ink, 3)
        lines = 1 + int(top < size * 0.2)
        for line in range(lines):
            h = (size - 2 * top - 16) // lines
            box = (10, top + 8 + line * h, size - 10, top + 8 + (line + 1) * h - 6)
            write(grey, rng, letters(rng, 3, 8), box, ink)
    return grey + 4 * noise(rng, size, size, 16), alpha


def foliage(rng: Rng, size: int = 256, density: float = 1.0) -> tuple[Grey, Grey]:
    """Make the texture and the alpha channel of a twig. Its leaves are sparser at the border."""
    grey = np.full((size, size), 28.0, np.float32)
    alpha = np.zeros((size, size), np.float32)
    for _ in range(10):
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 0.46) * size
        end = (int(size / 2 + reach * np.cos(angle)), int(size / 2 + reach * np.sin(angle)))
        for image, value in ((alpha, 255.0), (grey, 24.0)):
            cv2.line(image, (size // 2, size // 2), end, value, 2)
    _leaves(rng, grey, alpha, int(1700 * density), radial=True)
    return grey, alpha


def hedge(rng: Rng) -> tuple[Grey, Grey]:
    """Make the texture and the alpha channel of a clipped hedge, whose upper edge is uneven."""
    width, height = 512, 128
    grey = np.full((height, width), 20.0, np.float32)
    alpha = np.zeros((height, width), np.float32)
    edge = (0.07 + 0.02 * noise(rng, 1, width, 24.0, 4)[0]) * height
    alpha[np.arange(height)[:, None] > edge] = 255.0
    _leaves(rng, grey, alpha, width * height // 30, radial=False)
    alpha[-2:] = 255.0
    shade = np.linspace(1.12, 0.7, height, dtype=np.float32)[:, None]
    return grey * shade, alpha


def _leaves(rng: Rng, grey: Grey, alpha: Grey, count: int, *, radial: bool) -> None:
    height, width = grey.shape
    if radial:
        angle = rng.uniform(0, 2 * np.pi, count)
        reach = 0.47 * width * np.sqrt(rng.uniform(0, 1, count))
        lobes = 1.0 - 0.28 * np.abs(np.sin(1.5 * angle + rng.uniform(0, 3)))
        x = width / 2 + reach * lobes * np.cos(angle)
        y = height / 2 + reach * lobes * np.sin(angle)
    else:
        x, y = rng.uniform(0, width, count), rng.uniform(height * 0.06, height, count)
    light = rng.uniform(0, 1, count)
    order = np.argsort(light)  # bright leaves lie on top
    radius = np.clip(rng.gamma(6.0, width / 256 * 0.37 if radial else 0.30, count), 1.0, 14.0)
    turn = rng.uniform(0, 180, count)
    for k in order:
        at = (int(x[k]), int(y[k]))
        axes = (max(1, int(radius[k] * 1.4)), max(1, int(radius[k] * 0.8)))
        value = 20.0 + 105.0 * float(light[k]) ** 1.7
        cv2.ellipse(grey, at, axes, float(turn[k]), 0, 360, value, -1)
        cv2.ellipse(alpha, at, axes, float(turn[k]), 0, 360, 255.0, -1)


def bark(rng: Rng, size: int = 128) -> Grey:
    """Make the texture of furrowed bark, which is stretched along the trunk."""
    tall = cv2.resize(noise(rng, size // 8, size, 10.0, 3), (size, size))
    return np.clip(62 + 17 * tall + 9 * noise(rng, size, size, 12.0, 3), 10, 160)


def fence(rng: Rng) -> tuple[Grey, Grey]:
    """Make the texture and the alpha channel of a fence of pickets or bars, which is 4 m long."""
    height, width = 64, 256
    grey = np.full((height, width), float(rng.uniform(50, 190)), np.float32)
    grey += 12 * noise(rng, height, width, 16.0)
    alpha = np.zeros((height, width), np.float32)
    pitch, bar = int(rng.integers(8, 17)), int(rng.integers(3, 6))
    for x in range(0, width, pitch):
        top = int(rng.integers(1, 6))
        alpha[top:, x : x + bar] = 255.0
        grey[:, x : x + bar] *= float(rng.uniform(0.8, 1.15))
    for y in (14, 46):
        alpha[y : y + 5] = 255.0
    return grey, alpha


def garden_wall(rng: Rng) -> Grey:
    """Make the texture of a wall of coursed stone or plaster, 4 m by 1 m."""
    height, width = 128, 512
    grey = np.full((height, width), float(rng.uniform(80, 170)), np.float32)
    if rng.random() < 0.6:
        course = int(rng.integers(16, 32))
        for row, y in enumerate(range(0, height, course)):
            x = -int(rng.integers(0, 40))
            while x < width:
                w = int(rng.integers(24, 80))
                a, b = max(x, 0), min(x + w - 2, width)
                grey[y : y + course - 2, a:b] *= float(rng.uniform(0.75, 1.2))
                grey[y : y + course, max(b, 0) : b + 2] *= 0.6
                x += w
            grey[y + course - 2 : y + course] *= 0.65 if row % 2 else 0.7
    return grey + 10 * noise(rng, height, width, 64.0, 5)


def poster(rng: Rng, size: int = 128) -> Grey:
    """Make the texture of a poster with rectangles, circles and words."""
    image = np.full((size, size), float(rng.uniform(120, 235)), np.float32)
    for _ in range(int(rng.integers(3, 7))):
        x0, y0 = rng.integers(0, size - 20, 2)
        x1, y1 = x0 + int(rng.integers(15, size // 2)), y0 + int(rng.integers(10, size // 2))
        grey = float(rng.uniform(20, 240))
        if rng.random() < 0.5:
            cv2.rectangle(image, (int(x0), int(y0)), (int(x1), int(y1)), grey, -1)
        else:
            cv2.circle(image, (int(x0), int(y0)), int(rng.integers(6, 26)), grey, -1, cv2.LINE_AA)
    for _ in range(2):
        y = int(rng.integers(4, size - 30))
        write(image, rng, letters(rng), (6, y, size - 6, y + 24), float(rng.choice([15.0, 240.0])))
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), 60.0, 3)
    return image


def sky(rng: Rng) -> Grey:
    """Make a panorama of clouds over distant trees.

    The horizontal axis is the heading. The vertical axis is the tangent of the elevation, from
    `SKY_RISE` at the top to minus `SKY_FALL`.
    """
    height, width = 512, 2048
    rise = np.linspace(SKY_RISE, -SKY_FALL, height, dtype=np.float32)[:, None]
    zenith = float(rng.uniform(70, 125))  # a clear sky is dark in a grey image
    image = zenith + 75.0 * np.exp(-rise / 0.25) * np.ones((1, width), np.float32)
    clouds = noise(rng, height, width, 300.0, 6)
    clouds = clouds + 0.5 * noise(rng, height, width, 90.0, 5)
    clouds = np.clip(clouds - float(rng.uniform(0.0, 0.6)), 0, 1.6)
    image += clouds * 45.0 * np.clip(rise * 4 + 0.4, 0, 1)
    image = np.minimum(image, 250.0)
    for far, tone in ((0.050, 120.0), (0.032, 90.0)):
        top = far + 0.25 * far * noise(rng, 1, width, 240.0, 7)[0]
        rough = noise(rng, height, width, 10.0, 3)
        trees = rise < top + 0.002 * rough
        image = np.where(trees, tone + 9.0 * rough, image).astype(np.float32)
    return image
