"""Builds rooms and halls: walls with pictures, and furniture.

The room surrounds the vertical axis of the world. The floor is at y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam_lab.towns import solids, textures
from vslam_lab.towns.render import Light
from vslam_lab.towns.scene import AtlasBuilder, Surfaces, join, patches
from vslam_lab.towns.site import ALWAYS, Variation
from vslam_lab.towns.textures import Grey, Rng
from vslam_lab.towns.town import Town

SIZES = {"room": (7.0, 2.9, 6.0), "hall": (16.0, 7.5, 24.0)}  # m along x, y and z
_AISLE = (4.2, 8.0)  # m along x and z from the axis of a hall, in which the camera flies
LAMPS = Light(
    np.array([0.0, -1.0, 0.0]), direct=0.0, ambient=0.62, haze=0.0, visibility=1e9, exposure=2.3
)
"""The light of lamps at the ceiling, without shadows."""


@dataclass(frozen=True)
class _Interior:
    """A room under construction."""

    rng: Rng
    atlas: AtlasBuilder
    parts: list[Surfaces] = field(default_factory=list)
    place: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, low: tuple[float, ...], high: tuple[float, ...], texture: int) -> None:
        """Place a box. Its texture covers each of its sides."""
        tone = float(self.rng.uniform(0.8, 1.25))
        self.parts.append(solids.box(low, high, texture, thing=len(self.place), gain=tone))
        self.place.append(np.array([low[0] + high[0], low[2] + high[2]]) / 2)


def build_room(land: str, variation: Variation) -> Town:
    """Build a room or a hall.

    Args:
        land: ``room`` or ``hall``.
        variation: only its seed is used.
    """
    rng = np.random.default_rng([variation.seed, 21])
    atlas = AtlasBuilder()
    sky = atlas.add(np.full((4, 4), 20.0))  # is never seen
    room = _Interior(rng, atlas)
    shell = _shell(room, SIZES[land])
    _line_with_pictures(room, SIZES[land], shell)
    furnish = _furnish_room if land == "room" else _furnish_hall
    furnish(room, SIZES[land])
    return Town(
        join([*shell, *room.parts]),
        atlas.build(),
        sky,
        np.array(room.place),
        np.full(len(room.place), ALWAYS, np.int8),
        (),
        np.empty((0, 2)),
    )


def _shell(room: _Interior, size: tuple[float, float, float]) -> list[Surfaces]:
    """Make the four walls, the floor and the ceiling."""
    rng, add = room.rng, room.atlas.add
    w, h, d = size
    fine = add(textures.detail(rng, 0.12, 6.0))
    corners = np.array([[-w, d], [w, d], [w, -d], [-w, -d]]) / 2  # clockwise, seen from above
    sides = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        sides.append(
            patches(
                np.array([a[0], -h, a[1]]), np.array([b[0] - a[0], 0.0, b[1] - a[1]]),
                np.array([0.0, h, 0.0]), add(_plaster(rng)), detail=fine, detail_size=0.7,
            )
        )  # fmt: skip
    for y, texture in ((0.0, _planks(rng)), (-h, _panels(rng))):
        sides.append(
            patches(
                np.array([-w / 2, y, -d / 2]), np.array([w, 0.0, 0.0]), np.array([0.0, 0.0, d]),
                add(texture), detail=fine, detail_size=0.5, gain=1.0 if y == 0.0 else 2.2,
            )
        )  # fmt: skip
    return sides


def _line_with_pictures(
    room: _Interior, size: tuple[float, float, float], shell: list[Surfaces]
) -> None:
    """Hang pictures on the walls, at all heights above a metre."""
    rng = room.rng
    h = size[1]
    for wall in shell[:4]:
        origin, edge = wall.origin[0], wall.edge_s[0]
        length = float(np.linalg.norm(edge))
        along, at = edge / length, 0.3
        while at < length - 1.2:
            wide = float(rng.uniform(0.5, 1.1)) * (1.0 if h < 4.0 else 1.8)
            tall = wide * float(rng.uniform(0.6, 1.3))
            top = float(rng.uniform(0.25, max(h - tall - 1.0, 0.3)))
            poster = room.atlas.add(textures.poster(rng))
            # Towards the axis of the room, so that the picture lies in front of the wall.
            corner = origin + at * along + np.array([0.0, top, 0.0])
            corner[[0, 2]] *= 1.0 - 0.02 / np.abs(origin[[0, 2]]).max()
            room.parts.append(
                patches(corner, wide * along, np.array([0.0, tall, 0.0]), poster, layer=1,
                        thing=len(room.place), gain=float(rng.uniform(0.8, 1.2)))
            )  # fmt: skip
            room.place.append(corner[[0, 2]])
            at += wide + float(rng.uniform(0.1, 0.9))


def _furnish_room(room: _Interior, size: tuple[float, float, float]) -> None:
    """Put shelves, cupboards and boxes along the walls, and a low table into the middle."""
    rng, (w, _, d) = room.rng, size
    for x_side, z_side in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        length = d if x_side else w
        at = -length / 2 + 0.6
        while at < length / 2 - 1.3:
            wide, deep = float(rng.uniform(0.6, 1.2)), float(rng.uniform(0.3, 0.6))
            tall = float(rng.choice([0.5, 0.9, 1.4, 2.0]))
            texture = _shelf(rng) if tall > 1.0 else textures.garden_wall(rng)
            number = room.atlas.add(texture)
            a, b = (-w / 2 + 0.02, -w / 2 + deep) if x_side < 0 else (w / 2 - deep, w / 2 - 0.02)
            c, e = (-d / 2 + 0.02, -d / 2 + deep) if z_side < 0 else (d / 2 - deep, d / 2 - 0.02)
            if x_side:
                room.add((a, -tall, at), (b, 0.0, at + wide), number)
            else:
                room.add((at, -tall, c), (at + wide, 0.0, e), number)
            if tall < 1.0:
                _put_on_top(room, (a, at) if x_side else (at, c), tall)
            at += wide + float(rng.uniform(0.1, 0.7))
    top = room.atlas.add(_planks(rng))
    x, z = rng.uniform(-0.5, 0.5, 2).tolist()
    room.add((x - 0.7, -0.72, z - 0.4), (x + 0.7, -0.68, z + 0.4), top)
    for dx, dz in ((-0.65, -0.35), (0.6, -0.35), (-0.65, 0.3), (0.6, 0.3)):
        room.add((x + dx, -0.68, z + dz), (x + dx + 0.05, 0.0, z + dz + 0.05), top)
    _put_on_top(room, (x - 0.4, z - 0.1), 0.72)
    _put_on_top(room, (x + 0.2, z - 0.2), 0.72)


def _put_on_top(room: _Interior, at: tuple[float, float], tall: float) -> None:
    rng = room.rng
    wide, deep, high = rng.uniform((0.1, 0.1, 0.08), (0.3, 0.25, 0.35)).tolist()
    low = (at[0] + 0.05, -tall - high, at[1] + 0.05)
    room.add(low, (low[0] + wide, -tall, low[2] + deep), room.atlas.add(textures.poster(rng, 64)))


def _furnish_hall(room: _Interior, size: tuple[float, float, float]) -> None:
    """Put pillars and stacks of crates around the middle of the hall."""
    rng, (w, h, d) = room.rng, size
    free_x, free_z = _AISLE
    for z in np.arange(-d / 2 + 3.0, d / 2 - 2.0, 4.5):
        for x in (-free_x - 1.2, free_x + 1.2):
            texture = room.atlas.add(textures.garden_wall(rng))
            room.add((x - 0.3, -h, z - 0.3), (x + 0.3, 0.0, z + 0.3), texture)
    for _ in range(46):
        x, z = float(rng.uniform(-w / 2 + 1, w / 2 - 1)), float(rng.uniform(-d / 2 + 1, d / 2 - 1))
        wide, high, deep = rng.uniform((0.6, 0.5, 0.6), (1.8, 1.6, 1.8)).tolist()
        inside = abs(x) < free_x + wide and abs(z) < free_z + deep
        levels = 1 if inside else int(rng.integers(1, 4))
        high = min(high, 0.8) if inside else high
        for level in range(levels):
            texture = room.atlas.add(textures.poster(rng) if rng.random() < 0.6 else _shelf(rng))
            shift = float(rng.uniform(-0.1, 0.1))
            room.add(
                (x - wide / 2 + shift, -(level + 1) * high, z - deep / 2),
                (x + wide / 2 + shift, -level * high, z + deep / 2), texture,
            )  # fmt: skip


def _plaster(rng: Rng) -> Grey:
    """The texture of a wall: stains and cracks on plaster, darker at the bottom."""
    height, width = 512, 1024
    grey = float(rng.uniform(120, 170)) + 14 * textures.noise(rng, height, width, 160.0, 7)
    rows = np.arange(height)[:, None]
    return np.clip(np.where(rows > 0.7 * height, 0.72 * grey, grey), 10, 245).astype(np.float32)


def _planks(rng: Rng) -> Grey:
    """The texture of a floor of planks, each of another tone."""
    side, plank = 1024, 32
    tone = rng.uniform(70, 150, (side // plank, 1))
    grey = np.repeat(np.repeat(tone, plank, axis=0), side, axis=1).astype(np.float32)
    for row in range(side // plank):
        cut = int(rng.integers(0, side))
        grey[row * plank : (row + 1) * plank, cut:] *= float(rng.uniform(0.75, 1.25))
        grey[row * plank : (row + 1) * plank, cut - 2 : cut + 1] *= 0.5
    grey[::plank] *= 0.5
    grain = textures.noise(rng, side, side, 24.0, 4)
    return np.clip(grey + 9 * grain, 5, 245).astype(np.float32)


def _panels(rng: Rng) -> Grey:
    """The texture of a ceiling of panels, some of which are lamps."""
    side, panel = 512, 64
    lamps = rng.random((side // panel, side // panel)) < 0.18
    tone = np.where(lamps, 240.0, rng.uniform(120, 165, lamps.shape))
    grey = np.kron(tone, np.ones((panel, panel))).astype(np.float32)
    grey[::panel] = grey[:, ::panel] = 70.0
    return np.clip(grey + 8 * textures.noise(rng, side, side, 40.0, 5), 5, 250).astype(np.float32)


def _shelf(rng: Rng) -> Grey:
    """The texture of a shelf with books."""
    height, width, boards = 256, 128, 5
    grey = np.full((height, width), 40.0, np.float32)
    for board in range(boards):
        top, bottom = board * height // boards, (board + 1) * height // boards - 5
        x = 2
        while x < width - 4:
            thick = int(rng.integers(4, 12))
            high = int(rng.uniform(0.6, 0.95) * (bottom - top))
            grey[bottom - high : bottom, x : x + thick] = float(rng.uniform(30, 230))
            band = bottom - int(rng.uniform(0.3, 0.8) * high)
            grey[band : band + 4, x : x + thick] = float(rng.uniform(20, 240))
            x += thick + int(rng.random() < 0.15) * int(rng.integers(3, 14))
        grey[bottom : bottom + 5] = 120.0
    return grey + 3 * textures.noise(rng, height, width, 16.0)
