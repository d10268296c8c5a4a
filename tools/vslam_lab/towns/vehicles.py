"""Parked and moving cars, made of extruded outlines with painted sides."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam_lab.towns.scene import AtlasBuilder, Surfaces, join, patches
from vslam_lab.towns.textures import Grey, Rng, letters, noise, write

# Outlines from the front bumper over the roof to the rear. Each point is given as fractions of the
# length and of the height. The third number tells whether the strip from this point to the next one
# is paint (0) or glass (1).
_OUTLINES = {
    "hatchback": ((0.0, 0.16, 0), (0.0, 0.42, 0), (0.05, 0.52, 0), (0.27, 0.62, 1),
                  (0.45, 0.97, 0), (0.62, 1.0, 0), (0.86, 0.93, 1), (0.97, 0.62, 0),
                  (1.0, 0.17, 0)),
    "saloon": ((0.0, 0.17, 0), (0.0, 0.44, 0), (0.05, 0.53, 0), (0.28, 0.62, 1), (0.43, 0.97, 0),
               (0.56, 1.0, 0), (0.67, 0.95, 1), (0.83, 0.66, 0), (0.98, 0.62, 0), (1.0, 0.18, 0)),
    "estate": ((0.0, 0.16, 0), (0.0, 0.42, 0), (0.05, 0.52, 0), (0.26, 0.6, 1), (0.42, 0.96, 0),
               (0.6, 1.0, 0), (0.92, 0.94, 1), (0.98, 0.58, 0), (1.0, 0.17, 0)),
    "van": ((0.0, 0.13, 0), (0.0, 0.4, 0), (0.03, 0.47, 0), (0.16, 0.53, 1), (0.29, 0.95, 0),
            (0.4, 1.0, 0), (0.96, 0.98, 1), (0.99, 0.55, 0), (1.0, 0.13, 0)),
}  # fmt: skip
_SIZES = {  # length, width, height in metres
    "hatchback": (3.9, 1.70, 1.46),
    "saloon": (4.6, 1.80, 1.43),
    "estate": (4.5, 1.78, 1.50),
    "van": (4.9, 1.92, 1.95),
}

_BELT, _ROOF = 0.6, 0.78  # height of the belt line, and width of the roof, relative to the car
_TAPER_AT, _TAPER = (0.0, 0.12, 0.9, 1.0), (0.84, 1.0, 1.0, 0.9)  # relative width along the car

Float = NDArray[np.float64]


def make_car(rng: Rng, atlas: AtlasBuilder, thing: int) -> Surfaces:
    """Make a car with a random shape, colour and number plate.

    The car is at the origin of its frame, with z forward and the wheels on y = 0.
    """
    kind = str(rng.choice(list(_OUTLINES), p=[0.4, 0.24, 0.24, 0.12]))
    length, width, height = (float(x * rng.uniform(0.94, 1.06)) for x in _SIZES[kind])
    outline = np.array([(x, y) for x, y, _ in _OUTLINES[kind]])
    outline[1:-1] += rng.normal(0, 0.008, outline[1:-1].shape)
    glass = [bool(g) for *_, g in _OUTLINES[kind]]
    paint = float(rng.choice([14, 20, 28, 40, 60, 95, 140, 205]) * rng.uniform(0.9, 1.1))
    side, alpha = _paint_side(rng, outline, glass, paint)
    side_id = atlas.add(side, alpha)
    end_ids = [atlas.add(_paint_end(rng, paint, front=front)) for front in (True, False)]
    strip_ids = [atlas.add(_paint_strip(rng, paint)), atlas.add(_paint_glass(rng))]

    points = np.stack(
        [np.zeros(len(outline)), -height * outline[:, 1], length * (0.5 - outline[:, 0])], axis=1
    )
    parts = _sides((length, width, height), side_id, thing)
    # The ends are narrower than the middle, and the roof is narrower than the belt line.
    half = 0.5 * width * np.where(
        outline[:, 1] > _BELT,
        1.0 - (1.0 - _ROOF) * (outline[:, 1] - _BELT) / (1.0 - _BELT),
        np.interp(outline[:, 0], _TAPER_AT, _TAPER),
    )  # fmt: skip
    reach = half[:, None] * np.array([1.0, 0.0, 0.0])
    for k in range(len(points) - 1):
        low = min(outline[k, 1], outline[k + 1, 1])
        texture = strip_ids[1 if glass[k] and low > 0.4 else 0]
        top, bottom = k, k + 1
        if k == 0:
            texture, top, bottom = end_ids[0], 1, 0
        elif k == len(points) - 2:
            texture = end_ids[1]
        parts.append(
            _trapezium(
                points[top] - reach[top],
                points[top] + reach[top],
                points[bottom] - reach[bottom],
                points[bottom] + reach[bottom],
                texture,
                thing,
            )
        )
    shade = patches(
        np.array([-width / 2, -0.14, length / 2]),
        np.array([width, 0.0, 0.0]),
        np.array([0.0, 0.0, -length]),
        strip_ids[1],
        gain=0.2,
        thing=thing,
    )
    return join([*parts, shade])


def _trapezium(
    top_left: Float, top_right: Float, low_left: Float, low_right: Float, texture: int, thing: int
) -> Surfaces:
    """Make a trapezium of two triangles that share a texture. The corners are ``(3,)``."""
    return join([
        patches(top_left, top_right - top_left, low_left - top_left, texture, triangle=True,
                thing=thing),
        patches(low_right, low_left - low_right, top_right - low_right, texture, triangle=True,
                uv=(1, -1, 0, 1, 0, -1), thing=thing),
    ])  # fmt: skip


def _sides(size: tuple[float, float, float], texture: int, thing: int) -> list[Surfaces]:
    """Make both sides of a car of ``(length, width, height)`` metres.

    Each side has a lower part that tapers at both ends, and a cabin that leans inwards.
    """
    length, width, height = size
    parts = []
    for sign in (-1.0, 1.0):
        belt = np.array([sign * width / 2, -height * _BELT, length / 2])
        lean = np.array([sign * width / 2 * _ROOF, -height, length / 2])
        back = np.array([0.0, 0.0, -length])
        parts.append(patches(lean, back, belt - lean, texture, uv=(0, 1, 0, 0, 0, 1 - _BELT),
                             thing=thing))  # fmt: skip
        for k in range(len(_TAPER_AT) - 1):
            from_, to = _TAPER_AT[k], _TAPER_AT[k + 1]
            start = belt * [_TAPER[k], 1, 1] + from_ * back
            end = belt * [_TAPER[k + 1], 1, 1] + to * back
            parts.append(patches(start, end - start, np.array([0.0, height * _BELT, 0.0]), texture,
                                 uv=(from_, to - from_, 0, 1 - _BELT, 0, _BELT),
                                 thing=thing))  # fmt: skip
    return parts


def _paint_side(rng: Rng, outline: Float, glass: list[bool], paint: float) -> tuple[Grey, Grey]:
    """Paint the texture and the alpha channel of the side of a car."""
    width, height = 512, 128
    at = (outline * [width - 1, -(height - 1)] + [0, height - 1]).round().astype(np.int32)
    grey = np.full((height, width), paint, np.float32)
    grey *= np.linspace(1.15, 0.75, height, dtype=np.float32)[:, None]
    # The bulge below the belt line reflects the sky, and the sill reflects the street.
    at_row = np.linspace(0, 1, height, dtype=np.float32)[:, None]
    grey += 35.0 * np.exp(-(((at_row - 0.5) / 0.06) ** 2)) - 12.0 * (at_row > 0.68)
    grey = np.clip(grey, 6, 250)
    alpha = np.zeros((height, width), np.float32)
    cv2.fillPoly(alpha, [at], 255.0)
    # Side windows are the eroded outline above the belt line.
    belt = int(height * 0.40)
    cabin = np.zeros((height, width), np.uint8)
    cv2.fillPoly(cabin, [at], 255)
    cabin[belt:] = 0
    cabin = np.asarray(cv2.erode(cabin, np.ones((9, 19), np.uint8), borderValue=0), np.uint8)
    shine = 24 + 22 * np.clip(noise(rng, height, width, 90.0, 3), -1, 2)
    grey = np.where(cabin > 0, shine, grey).astype(np.float32)
    starts = [x for x, g in zip(at[:, 0], glass, strict=True) if g]
    left = int(starts[0]) if starts else width // 4
    for part in np.cumsum(rng.uniform(0.22, 0.32, 2)):
        x = int(left + (width - left) * (part + 0.05))
        cv2.line(grey, (x, 12), (x, belt), paint, 7)
        cv2.line(grey, (x, belt), (x - 6, int(0.82 * height)), paint * 0.45, 1, cv2.LINE_AA)
        cv2.line(grey, (x + 12, belt + 10), (x + 26, belt + 10), paint * 0.5 + 60, 2)
    y = int(height * rng.uniform(0.55, 0.66))
    cv2.line(grey, (8, y), (width - 8, y - 3), paint * 0.7, 2, cv2.LINE_AA)
    cv2.line(grey, (8, y + 3), (width - 8, y), min(paint * 1.25 + 12, 245), 1, cv2.LINE_AA)
    cv2.rectangle(grey, (0, int(0.45 * height)), (22, int(0.55 * height)), 205.0, -1)
    cv2.rectangle(grey, (width - 16, int(0.42 * height)), (width, int(0.6 * height)), 85.0, -1)
    grey[int(0.87 * height) :] = 26.0
    # Wheels are ellipses, because texels are not square.
    for x in (int(width * 0.185), int(width * 0.80)):
        centre, rim = (x, height - 29), float(rng.uniform(90, 190))
        axes = np.array([37, 28])
        cv2.ellipse(grey, centre, (43, 32), 0, 0, 360, 14.0, -1)
        cv2.ellipse(alpha, centre, axes.tolist(), 0, 0, 360, 255.0, -1)
        cv2.ellipse(grey, centre, axes.tolist(), 0, 0, 360, 24.0, -1)
        cv2.ellipse(grey, centre, (axes * 0.64).astype(int).tolist(), 0, 0, 360, rim, -1)
        spokes = int(rng.integers(5, 10))
        for k in range(spokes):
            a = 2 * np.pi * k / spokes + 0.3
            end = (int(x + 22 * np.cos(a)), int(centre[1] + 16 * np.sin(a)))
            cv2.line(grey, centre, end, rim * 0.35, 4)
    return np.clip(grey, 5, 250), alpha


def _paint_end(rng: Rng, paint: float, *, front: bool) -> Grey:
    size = 128
    grey = np.full((size, size), paint, np.float32)
    grey *= np.linspace(1.1, 0.8, size, dtype=np.float32)[:, None]
    lamp = 215.0 if front else 70.0
    top = int(size * (0.12 if front else 0.1))
    tall = int(size * (0.22 if front else rng.uniform(0.2, 0.4)))
    wide = int(size * rng.uniform(0.14, 0.24))
    for x in (3, size - 3 - wide):
        cv2.rectangle(grey, (x, top), (x + wide, top + tall), lamp, -1)
        cv2.rectangle(grey, (x, top), (x + wide, top + tall), 35.0, 2)
        cv2.circle(grey, (x + wide // 2, top + tall // 2), 6, 240.0 if front else 150.0, -1)
    if front:
        cv2.rectangle(grey, (size // 4, top + 4), (3 * size // 4, top + tall), 25.0, -1)
        for y in range(top + 7, top + tall, 5):
            cv2.line(grey, (size // 4, y), (3 * size // 4, y), paint * 0.6 + 40, 1)
    else:
        cv2.line(grey, (4, int(0.52 * size)), (size - 4, int(0.52 * size)), paint * 0.45, 2)
    plate = int(size * rng.uniform(0.55, 0.66))
    cv2.rectangle(grey, (36, plate), (92, plate + 15), 228.0, -1)
    write(grey, rng, letters(rng, 6, 8), (38, plate + 1, 90, plate + 14), 25.0)
    grey[int(0.88 * size) :] = 28.0
    return np.clip(grey + 3 * noise(rng, size, size, 40.0), 5, 250)


def _paint_strip(rng: Rng, paint: float) -> Grey:
    grey = np.full((64, 64), paint, np.float32) * (1.0 + 0.15 * noise(rng, 64, 64, 40.0, 3))
    grey[:, :2] *= 0.6
    grey[:, -2:] *= 0.6
    grey[:2] *= 0.6
    return np.clip(grey, 5, 250)


def _paint_glass(rng: Rng) -> Grey:
    """Paint a pane of glass that reflects the bright sky above and dark houses below."""
    slope = np.linspace(1, 0, 64, dtype=np.float32)[:, None]
    edge = float(rng.uniform(0.3, 0.7)) + 0.12 * noise(rng, 1, 64, 24.0, 3)
    grey = 18.0 + 14.0 * slope + 70.0 * slope * (slope > edge)
    grey = grey + 4.0 * noise(rng, 64, 64, 30.0, 2)
    grey[:3] = grey[-3:] = 15.0
    grey[:, :3] = grey[:, -3:] = 15.0
    return np.clip(grey, 5, 250)
