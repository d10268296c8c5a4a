"""Builds a town along a route.

The town depends only on the route and on the variation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam_lab.towns import solids, streetside
from vslam_lab.towns.facades import facade, random_style
from vslam_lab.towns.ground import RoadStyle, make_ground
from vslam_lab.towns.routes import Route
from vslam_lab.towns.scene import Atlas, AtlasBuilder, Surfaces, join
from vslam_lab.towns.site import (
    AFTER,
    ALIASES,
    ALWAYS,
    BEFORE,
    Float,
    Site,
    Variation,
    make_palette,
)
from vslam_lab.towns.terrain import Plan, Roads, rectangle, roads_of
from vslam_lab.towns.textures import Rng
from vslam_lab.towns.vehicles import make_car

_ROADS = {
    "town": RoadStyle(4.2, 6.3, 8.3, 3.0, 4.5, False, 0.8),
    "suburb": RoadStyle(4.2, 6.2, 7.6, 2.0, 5.0, False, 0.6),
    "motorway": RoadStyle(8.5, 9.6, 11.0, 6.0, 9.0, True, 0.25),
}


@dataclass(frozen=True)
class Town:
    """A town that consists of T things (objects).

    If an object changes during the drive, its old state and its new state are separate things.

    Attributes:
        surfaces: all surfaces, in the world frame of the route.
        atlas: textures of the surfaces.
        sky: number of the sky's panorama in the atlas.
        place: ``(T, 2)`` float64 x and z of each thing.
        when: ``(T,)`` int8. A thing exists during the whole drive (``ALWAYS``), or only before or
            after the change of an object (``BEFORE``, ``AFTER``).
        moving: surfaces of the moving cars, in the frames of the cars (see `solids`).
        lamps: ``(L, 2)`` float64 x and z of street lamps.
    """

    surfaces: Surfaces
    atlas: Atlas
    sky: int
    place: Float
    when: NDArray[np.int8]
    moving: tuple[Surfaces, ...]
    lamps: Float


def build_town(route: Route, variation: Variation, aside: tuple[float, ...] = (0.0,)) -> Town:
    """Build the town of a route.

    Args:
        aside: lateral shifts of the camera in metres, to the right. The space at these positions is
            kept free.
    """
    rng = np.random.default_rng([variation.seed, 1])
    atlas = AtlasBuilder()
    motorway = route.land == "motorway"
    roads = route.roads if motorway else _with_side_streets(route.roads, variation.seed)
    places = route.T_wc[:, None, :3, 3] + np.array(aside)[:, None] * route.T_wc[:, None, :3, 0]
    cameras = places.reshape(-1, 3)[:, [0, 2]]
    site = Site(
        route,
        variation,
        roads,
        _ROADS[route.land],
        Plan(roads, cameras),
        atlas,
        make_palette(rng, atlas, 3 if variation.aliased else 18),
        rng,
        cameras,
    )
    ground = make_ground(rng, atlas, roads, route.terrain, site.style)
    if motorway:
        streetside.line_motorway(site)
    else:
        line_with_houses(site)
        close_sight_lines(site)
        streetside.fill_behind(site)
        streetside.furnish(site)
        streetside.lay_kerbs(site)
    rng = np.random.default_rng([variation.seed, 9])
    moving = tuple(make_car(rng, atlas, 0) for _ in range(variation.moving))
    return Town(
        join([ground, *site.parts]),
        atlas.build(),
        site.palette.sky,
        np.array(site.place).reshape(-1, 2),
        np.array(site.when, np.int8),
        moving,
        np.array(site.lamps).reshape(-1, 2),
    )


def _with_side_streets(roads: Roads, seed: int) -> Roads:
    rng = np.random.default_rng([seed, 2])
    tree, stubs = cKDTree(roads.xz), []
    at = int(rng.integers(120, 240))
    while at < len(roads.xz) - 40:
        side = float(rng.choice([-1.0, 1.0]))
        slant = roads.right[at] * side + roads.forward[at] * float(rng.uniform(-0.25, 0.25))
        line = roads.xz[at] + np.arange(0.0, 48.0, 0.5)[:, None] * slant
        if tree.query(line[50:])[0].min() > 20.0 and not roads.junction[at]:
            stubs.append(line)
        at += int(rng.integers(220, 520))
    if not stubs:
        return roads
    extra = roads_of(stubs)
    xz = np.vstack([roads.xz, extra.xz])
    near = cKDTree(extra.xz).query(roads.xz)[0] < 6.0
    far = tree.query(extra.xz)[0] < 9.0
    return Roads(
        xz,
        np.r_[roads.heading, extra.heading],
        np.r_[roads.along, extra.along + roads.along[-1] + 100.0],
        np.r_[roads.junction | near, extra.junction | far],
    )


def _build_house(site: Site, xz: Float, heading: float, size: tuple[float, float, float]) -> None:
    """Build a house whose front is at ``xz`` and faces in the direction opposite to ``heading``."""
    seed, number = site.variation.seed, site.next_thing
    key = number % ALIASES if site.variation.aliased else number
    rng = np.random.default_rng([seed, 3, key])
    style = random_style(rng, town=site.route.land == "town")
    width, height, depth = size
    changes = site.changes(np.random.default_rng([seed, 4, number]), 0.9)
    night = site.variation.change > 0.7
    walls = [(width, True), (depth, False), (width, False), (depth, False)]
    state = rng.bit_generator.state
    for when in (BEFORE, AFTER) if changes else (ALWAYS,):
        rng.bit_generator.state = state
        lived = np.random.default_rng([seed, 5, key, when])
        sides, lights = [], []
        for across, front in walls:
            grey, lit = facade(rng, lived, style, (across, height), front=front)
            sides.append(site.atlas.add(grey))
            lights.append(site.atlas.add(120 + 110 * lit, 255.0 * (lit > 0)) if night else -1)
        thing = site.next_thing
        house = solids.join([
            solids.walls(size, sides, lights, site.palette.plaster, thing=thing),
            solids.roof(rng, size, site.palette.tiles[int(rng.integers(6))], site.palette.render,
                        site.palette.plaster, thing=thing),
        ])  # fmt: skip
        site.stand(house, xz, heading, when)


def _build_house_if_free(
    site: Site, front: Float, heading: float, size: tuple[float, float, float], clear: float
) -> bool:
    ahead = np.array([np.sin(heading), np.cos(heading)])
    middle = front + 0.5 * size[2] * ahead
    if not site.plan.claim(rectangle(middle, heading, size[0], size[2]), road=clear, tall=True):
        return False
    _build_house(site, front, heading, size)
    return True


def _random_size(site: Site, rng: Rng) -> tuple[float, float, float]:
    """Draw the width, height and depth of a house in metres."""
    if site.variation.aliased:
        rng = np.random.default_rng([site.variation.seed, 6, site.next_thing % ALIASES])
    if site.route.land == "town":
        tall, width = 3.0 * int(rng.integers(2, 6)), float(rng.uniform(8, 17))
    else:
        tall, width = 2.8 * int(rng.integers(1, 3)), float(rng.uniform(8, 13))
    return (width, tall + float(rng.uniform(0.3, 1.2)), float(rng.uniform(8, 12)))


def line_with_houses(site: Site) -> None:
    roads, rng, town = site.roads, site.rng, site.route.land == "town"
    for side in (-1.0, 1.0):
        at, setback = 0, site.style.walk + (2.0 if town else 6.0)
        while at < len(roads.xz) - 20:
            size = _random_size(site, rng)
            middle = min(at + int(2 * size[0]), len(roads.xz) - 1)
            if rng.random() < 0.45:
                low, high = (0.3, 4.0) if town else (4.0, 11.0)
                setback = site.style.walk + float(rng.uniform(low, high))
            out = roads.right[middle] * side
            front = roads.xz[middle] + setback * out
            heading = float(np.arctan2(out[0], out[1])) + float(rng.normal(0, 0.015))
            if _build_house_if_free(site, front, heading, size, site.style.walk + 0.2):
                gap = 0.0
                if not (town and rng.random() < 0.45):
                    gap = float(rng.uniform(2.5, 9.0) if town else rng.uniform(5.0, 16.0))
                at += int(4 * (size[0] + gap)) + 1
            else:
                at += 8


def close_sight_lines(site: Site) -> None:
    """Build houses that block every open line of sight along the route."""
    rng = site.rng
    last = np.array([-1e9, -1e9])
    for T in site.route.T_wc:
        xz = T[[0, 2], 3]
        if np.linalg.norm(xz - last) < 4.0:
            continue
        last = xz
        heading = float(np.arctan2(T[0, 2], T[2, 2]))
        for angle in np.radians(np.arange(-42, 43, 3)):
            line = site.plan.open_ray(xz, heading + angle, 230.0)
            if line is None:
                continue
            distance = site.plan.road_distance(line)
            for k in range(24, len(line), 3):
                size = _random_size(site, rng)
                if distance[k] <= site.style.walk + 1.0:
                    continue
                facing = heading + float(angle) + float(rng.normal(0, 0.25))
                if _build_house_if_free(site, line[k], facing, size, site.style.walk + 0.5):
                    break
