"""Building a town along a route; its layout depends only on route and variation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam.datasets.synthetic import houses, streetside
from vslam.datasets.synthetic.ground import RoadStyle, make_ground
from vslam.datasets.synthetic.palette import make_palette
from vslam.datasets.synthetic.plan import Plan
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.scene import Atlas, AtlasBuilder, Surfaces, join
from vslam.datasets.synthetic.site import Float, Site, Variation
from vslam.datasets.synthetic.terrain import Roads, roads_of
from vslam.datasets.synthetic.vehicles import make_car

_ROADS = {
    "town": RoadStyle(4.2, 6.3, 8.3, 3.0, 4.5, False, 0.8),
    "suburb": RoadStyle(4.2, 6.2, 7.6, 2.0, 5.0, False, 0.6),
    "motorway": RoadStyle(8.5, 9.6, 11.0, 6.0, 9.0, True, 0.25),
}


@dataclass(frozen=True)
class Town:
    """A town: surfaces of T things, in all their variants before and after a change.

    Attributes:
        surfaces: all surfaces, in the route's world.
        atlas: their textures.
        sky: number of the sky's panorama in the atlas.
        place: ``(T, 2)`` float64 x and z of each thing.
        when: ``(T,)`` int8 ``ALWAYS``, ``BEFORE`` or ``AFTER``.
        moving: cars in their own frames; see `solids`.
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
    """Build the town of a route, with room for cameras that are ``aside`` metres to its right."""
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
        houses.line_with_houses(site)
        houses.close_sight_lines(site)
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
    """The roads of the route, and short side streets that branch off."""
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
