"""Houses, trees and street furniture as flat surfaces.

Each model has its own frame, with x right, y down, z away from the viewer, and the ground at y = 0.
The front of a model lies in the plane z = 0 or faces -z.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam_lab.towns.scene import FOLIAGE, SCREEN, Surfaces, join, patches
from vslam_lab.towns.textures import Rng

FOUNDATION = 1.2  # m; walls extend this far below the ground, so that no gap opens on slopes

Vector = tuple[float, ...] | NDArray[np.float64]


def turn(heading: float) -> NDArray[np.float64]:
    """Return the ``(3, 3)`` rotation of the z axis to a heading in radians, from +z towards +x."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def box(
    low: Vector, high: Vector, texture: int, *, thing: int, repeat: float = 0.0, gain: float = 1.0,
    material: int = 0,
) -> Surfaces:  # fmt: skip
    """Make the sides and the top of a box.

    The texture covers ``repeat`` metres. If ``repeat`` is 0, it covers a whole side.
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    w, h, d = x1 - x0, y1 - y0, z1 - z0
    origin = [[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1], [x0, y0, z1]]
    s = [[w, 0, 0], [0, 0, d], [-w, 0, 0], [0, 0, -d], [w, 0, 0]]
    t = [[0, h, 0]] * 4 + [[0, 0, -d]]
    uv = np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (5, 1))
    if repeat > 0:
        uv[:, 1] = np.array([w, d, w, d, w]) / repeat
        uv[:, 5] = np.array([h, h, h, h, d]) / repeat
        uv[:, 0] = np.arange(5) * 0.37
    return patches(np.array(origin), np.array(s, float), np.array(t, float), texture, uv=uv,
                   thing=thing, gain=gain, material=material)  # fmt: skip


def walls(
    size: tuple[float, float, float], textures: list[int], lights: list[int], fine: int,
    *, thing: int,
) -> Surfaces:  # fmt: skip
    """Make the front, right, back and left wall of a house.

    Args:
        size: width, height and depth in metres.
        textures: textures of the four walls, whose lower edge is at the ground.
        lights: textures of the lit windows of the four walls; -1 for none.
        fine: detail texture.
        thing: number of the house.
    """
    w, h, d = size
    origin = np.array([[-w / 2, -h, 0], [w / 2, -h, 0], [w / 2, -h, d], [-w / 2, -h, d]])
    s = np.array([[w, 0, 0], [0, 0, d], [-w, 0, 0], [0, 0, -d]])
    down = np.array([0.0, h, 0.0])
    parts = []
    for k in range(4):
        side = patches(origin[k], s[k], down, textures[k], detail=fine, detail_size=1.3,
                       thing=thing)  # fmt: skip
        below = patches(origin[k] + down, s[k], np.array([0.0, FOUNDATION, 0.0]), textures[k],
                        uv=(0, 1, 0, 0.985, 0, 0.01), gain=0.8, thing=thing)  # fmt: skip
        parts += [side, below]
        if lights[k] >= 0:
            parts.append(patches(origin[k], s[k], down, lights[k], layer=1, material=SCREEN,
                                 thing=thing))  # fmt: skip
    return join(parts)


def roof(
    rng: Rng, size: tuple[float, float, float], tiles: int, wall: int, fine: int, *, thing: int
) -> Surfaces:
    """Make a gable or flat roof with chimneys for a house of ``(width, height, depth)`` metres."""
    w, h, d = size
    tone = float(rng.uniform(0.6, 1.4))
    over = 0.45
    if h > 7.0 and rng.random() < 0.15:
        return box((-w / 2 - 0.2, -h - 0.5, -0.2), (w / 2 + 0.2, -h, d + 0.2), wall, thing=thing,
                   repeat=3.0, gain=0.7)  # fmt: skip
    rise = float(rng.uniform(0.32, 0.55)) * d
    parts = []
    drop = over * rise / (d / 2)
    ridge = np.array([0.0, -h - rise, d / 2])
    for sign in (-1, 1):
        eave = np.array([-w / 2 - over, -h + drop, d / 2 + sign * (d / 2 + over)])
        top = np.array([-w / 2 - over, ridge[1], ridge[2]])
        length = float(np.linalg.norm(eave - top))
        parts.append(patches(top, np.array([w + 2 * over, 0, 0]), eave - top, tiles,
                             uv=(rng.random(), w / 5.0, 0, rng.random(), 0, length / 5.0),
                             detail=fine, detail_size=0.9, gain=tone, thing=thing))  # fmt: skip
    for x in (-w / 2, w / 2):
        parts.append(patches(np.array([x, -h, 0.0]), np.array([0, 0, d]),
                             np.array([0, -rise, d / 2]), wall, triangle=True,
                             uv=(0.1, 0.5, 0.2, 0.1, 0, 0.3), detail=fine, detail_size=1.3,
                             thing=thing))  # fmt: skip
    for _ in range(int(rng.integers(0, 3))):
        x, z = float(rng.uniform(-0.4, 0.4)) * w, d * float(rng.uniform(0.3, 0.7))
        parts.append(box((x - 0.35, -h - rise - 0.9, z - 0.3), (x + 0.35, -h - 0.3, z + 0.3),
                         wall, thing=thing, gain=0.6))  # fmt: skip
    for _ in range(int(rng.integers(0, 4))):
        x = float(rng.uniform(-0.38, 0.38)) * w
        up = h + 0.25 * rise
        parts.append(box((x - 0.7, -up - 1.3, 0.08 * d), (x + 0.7, -up + 0.3, 0.4 * d), wall,
                         thing=thing, gain=0.9))  # fmt: skip
        parts.append(patches(np.array([x - 0.5, -up - 1.1, 0.08 * d]), np.array([1.0, 0, 0]),
                             np.array([0, 1.0, 0]), tiles, layer=1, gain=0.4,
                             thing=thing))  # fmt: skip
    return join(parts)


def tree(
    rng: Rng, twigs: list[int], bark: int, *, height: float, thing: int, conifer: bool = False
) -> Surfaces:
    """Make a tree: a trunk, branches, and a crown of twigs on flat cards with alpha."""
    radius = float(rng.uniform(0.018, 0.028)) * height
    clear = height * (0.12 if conifer else float(rng.uniform(0.28, 0.4)))
    parts = [_trunk(radius, clear + 0.25 * height, bark, thing)]
    if conifer:
        cards = int(rng.integers(18, 26))
        level = np.linspace(0.02, 0.97, cards)
        spread = 0.24 * height * (1.05 - level)
        middle = np.column_stack([
            rng.normal(0, 0.25, cards) * spread, -(clear + level * (height - clear)),
            rng.normal(0, 0.25, cards) * spread])  # fmt: skip
        size = np.clip(2.1 * spread, 0.8, None)
    else:
        cards = int(rng.integers(18, 26))
        wide, tall = 0.30 * height * float(rng.uniform(0.85, 1.15)), 0.5 * (height - clear)
        direction = rng.normal(0, 1, (cards, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        reach = rng.uniform(0.25, 0.8, (cards, 1))
        middle = direction * reach * [wide, tall, wide] + [0, -(clear + tall), 0]
        size = rng.uniform(0.32, 0.5, cards) * height * 0.62
    if not conifer:
        for at in middle[: int(rng.integers(4, 8))]:
            parts.append(_branch(rng, np.array([0.0, -0.9 * clear, 0.0]), 0.8 * at,
                                 radius, bark, thing))  # fmt: skip
    parts.append(_cards(rng, middle, size, twigs, thing, 0.8 if conifer else 1.0))
    return join(parts)


def bush(rng: Rng, twigs: list[int], *, height: float, thing: int) -> Surfaces:
    """Make a bush of twigs that reach down to the ground."""
    cards = int(rng.integers(4, 8))
    middle = np.column_stack([
        rng.normal(0, 0.3 * height, cards), rng.uniform(-0.75, -0.4, cards) * height,
        rng.normal(0, 0.3 * height, cards)])  # fmt: skip
    return _cards(rng, middle, rng.uniform(0.7, 1.1, cards) * height, twigs, thing, 0.9)


def _trunk(radius: float, height: float, bark: int, thing: int) -> Surfaces:
    angle = 2 * np.pi * np.arange(7) / 6
    ring = radius * np.column_stack([np.cos(angle), np.zeros(7), np.sin(angle)])
    return patches(
        ring[:-1] - [0, height, 0],
        np.diff(ring, axis=0),
        np.array([0.0, height + 0.5, 0.0]),
        bark,
        uv=np.column_stack([angle[:-1], np.full(6, 0.17), np.zeros((6, 3)), np.full(6, height)]),
        thing=thing,
    )


def _branch(rng: Rng, start: Vector, end: Vector, radius: float, bark: int, thing: int) -> Surfaces:
    way = np.asarray(end) - np.asarray(start)
    side = np.cross(way, rng.normal(0, 1, 3))
    side /= np.linalg.norm(side)
    other = np.cross(side, way / np.linalg.norm(way))
    across = 1.1 * radius * np.stack([side, other])
    return patches(start - 0.5 * across, across, np.tile(way, (2, 1)), bark,
                   uv=(0, 0.3, 0, 0, 0, 2.0), thing=thing)  # fmt: skip


def _cards(
    rng: Rng, middle: NDArray[np.float64], size: NDArray[np.float64], twigs: list[int],
    thing: int, gain: float,
) -> Surfaces:  # fmt: skip
    """Make N square twigs with random rotations. ``size`` has their side lengths in metres."""
    n = len(middle)
    heading, tilt, roll = rng.uniform((0, -0.6, 0), (2 * np.pi, 0.6, 6.3), (n, 3)).T[:, :, None]
    zero = np.zeros_like(heading)
    across = np.hstack([np.cos(heading), zero, -np.sin(heading)])
    normal = np.hstack([np.sin(heading), np.sin(tilt), np.cos(heading)])
    up = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), across)
    s = size[:, None] * (np.cos(roll) * across + np.sin(roll) * up)
    t = size[:, None] * (np.cos(roll) * up - np.sin(roll) * across)
    cards = patches(middle - 0.5 * (s + t), s, t, 0, material=FOLIAGE, thing=thing)
    cards.texture[:] = rng.choice(twigs, n)
    cards.gain[:] = gain * rng.uniform(0.8, 1.25, n)
    return cards


def hedge(rng: Rng, length: float, height: float, texture: int, top: int, thing: int) -> Surfaces:
    """Make a clipped hedge along x."""
    depth, shift = float(rng.uniform(0.5, 0.9)), float(rng.random())
    uv = (shift, length / 4.0, 0, 0, 0, 1)
    x0, x1 = -length / 2, length / 2
    along, down = np.array([length, 0.0, 0.0]), np.array([0.0, height + 0.3, 0.0])
    ends = np.array([0.0, 0.0, depth])
    lid = -0.92 * height
    kind: dict[str, Any] = {"thing": thing, "material": FOLIAGE}
    side = (0, 0.15, 0, 0, 0, 1)
    return join([
        patches(np.array([x0, -height, 0.0]), along, down, texture, uv=uv, **kind),
        patches(np.array([x0, -height, depth]), along, down, texture, uv=uv, **kind),
        patches(np.array([x0, -height, 0.0]), ends, down, texture, uv=side, **kind),
        patches(np.array([x1, -height, 0.0]), ends, down, texture, uv=side, **kind),
        patches(np.array([x0, lid, 0.0]), along, ends, top, uv=uv, **kind),
    ])  # fmt: skip


def panel(
    length: float, height: float, texture: int, thing: int, *, depth: float = 0.0
) -> Surfaces:
    """Make a fence along x, or a wall if ``depth`` is not 0. The texture covers 4 m."""
    if depth > 0:
        return box((-length / 2, -height, 0), (length / 2, 0.4, depth), texture, thing=thing,
                   repeat=4.0)  # fmt: skip
    return patches(np.array([-length / 2, -height, 0.0]), np.array([length, 0, 0]),
                   np.array([0, height, 0]), texture, uv=(0, length / 4.0, 0, 0, 0, 1),
                   thing=thing)  # fmt: skip


def lamp_post(height: float, arm: float, metal: int, screen: int, thing: int) -> Surfaces:
    """Make a street lamp whose arm extends towards -z."""
    return join([
        box((-0.07, -height, -0.07), (0.07, 0.3, 0.07), metal, thing=thing),
        box((-0.04, -height - 0.05, -arm), (0.04, -height + 0.03, 0.05), metal, thing=thing),
        box((-0.16, -height - 0.08, -arm - 0.5), (0.16, -height + 0.06, -arm), screen,
            thing=thing, material=SCREEN, gain=0.8),
    ])  # fmt: skip


def sign_post(
    rng: Rng, height: float, metal: int, faces: list[tuple[int, int]], thing: int
) -> Surfaces:
    """Make signs on a pole, which face -z. ``faces`` has the two textures of each sign."""
    parts = [box((-0.035, -height, -0.035), (0.035, 0.3, 0.035), metal, thing=thing)]
    top = -height
    for face in faces:
        size = float(rng.uniform(0.6, 0.95))
        for z, texture in zip((-0.06, -0.045), face, strict=True):
            parts.append(patches(np.array([-size / 2, top, z]), np.array([size, 0, 0]),
                                 np.array([0, size, 0]), texture, thing=thing))  # fmt: skip
        top += size + 0.05
    return join(parts)
