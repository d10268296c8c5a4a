"""Grow a town along a route. What stands where depends on the seed alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam.datasets.synthetic import solids, textures
from vslam.datasets.synthetic.facades import facade, random_style
from vslam.datasets.synthetic.ground import RoadStyle, make_ground
from vslam.datasets.synthetic.plan import CLEARANCE, Plan, rectangle
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.scene import Atlas, AtlasBuilder, Surfaces, join
from vslam.datasets.synthetic.terrain import Roads, roads_of
from vslam.datasets.synthetic.textures import Rng
from vslam.datasets.synthetic.vehicles import make_car

Float = NDArray[np.float64]

# When an object stands there: always, until its place is left for the first time, or from then on.
ALWAYS, BEFORE, AFTER = 0, 1, 2

_ROADS = {
    "town": RoadStyle(4.2, 6.3, 8.3, 3.0, 4.5, False, 0.8),
    "suburb": RoadStyle(4.2, 5.0, 6.6, 2.0, 5.0, True, 0.6),
    "motorway": RoadStyle(8.5, 9.6, 11.0, 6.0, 9.0, True, 0.25),
}
_ALIASES = 4  # houses that --aliased deals


@dataclass(frozen=True)
class Variation:
    """What the caller may vary.

    Attributes:
        seed: of everything.
        aliased: deal a few houses, trees and cars again and again.
        change: how much differs when a place is passed again, 0 to 1.
        moving: number of cars that drive about.
    """

    seed: int = 0
    aliased: bool = False
    change: float = 0.0
    moving: int = 0


@dataclass(frozen=True)
class Town:
    """Surfaces of all variants, and what the T things they belong to are.

    Attributes:
        surfaces: in the route's world.
        atlas: their textures.
        sky: number of the sky's panorama in the atlas.
        place: ``(T, 2)`` float64 x and z of each thing.
        when: ``(T,)`` int8 ``ALWAYS``, ``BEFORE`` or ``AFTER``.
        moving: cars in their own frames; see `solids`.
    """

    surfaces: Surfaces
    atlas: Atlas
    sky: int
    place: Float
    when: NDArray[np.int8]
    moving: tuple[Surfaces, ...]


def build_town(route: Route, variation: Variation) -> Town:
    """The town of a route."""
    return _Builder(route, variation).build()


class _Builder:
    def __init__(self, route: Route, variation: Variation) -> None:
        self._route, self._variation = route, variation
        self._rng = np.random.default_rng([variation.seed, 1])
        self._cameras = route.T_wc[:, [0, 2], 3]
        self._roads = self._with_side_streets(route.roads)
        self._plan = Plan(self._roads, self._cameras)
        self._atlas = AtlasBuilder()
        self._parts: list[Surfaces] = []
        self._place: list[Float] = []
        self._when: list[int] = []
        self._style = _ROADS[route.land]
        rng, add = self._rng, self._atlas.add
        pool = 3 if variation.aliased else 18
        self._sky = add(textures.sky(rng))
        self._twigs = [add(*textures.foliage(rng)) for _ in range(pool)]
        self._later_twigs = [add(*textures.foliage(rng, density=0.55)) for _ in range(pool)]
        self._needles = [add(*textures.foliage(rng, density=1.6)) for _ in range(6)]
        self._bark = [add(textures.bark(rng)) for _ in range(4)]
        self._hedges = [add(*textures.hedge(rng)) for _ in range(5)]
        self._leaves = add(40 + 22 * textures.noise(rng, 128, 128, 6.0, 3))
        self._fences = [add(*textures.fence(rng)) for _ in range(pool)]
        self._walls = [add(textures.garden_wall(rng)) for _ in range(pool)]
        self._signs = [self._sign() for _ in range(2 * pool)]
        self._posters = [add(textures.poster(rng)) for _ in range(2 * pool)]
        self._metal = add(np.full((16, 16), 92.0) + rng.normal(0, 9, (16, 16)))
        self._lamp = add(np.full((8, 8), 215.0))
        self._tiles = [add(self._roof_tiles()) for _ in range(6)]
        self._plaster = add(textures.detail(rng, 0.05, 9.0))
        self._render = add(np.clip(165 + 9 * textures.noise(rng, 256, 256, 90.0, 6), 0, 255))

    def build(self) -> Town:
        ground = make_ground(self._rng, self._atlas, self._roads, self._route.terrain, self._style)
        if self._route.land == "motorway":
            self._line_motorway()
        else:
            self._line_with_houses()
            self._close_sight_lines()
            self._fill_behind()
            self._furnish()
        rng = np.random.default_rng([self._variation.seed, 9])
        moving = tuple(
            make_car(rng, self._atlas, 0).surfaces for _ in range(self._variation.moving)
        )
        return Town(
            join([ground, *self._parts]),
            self._atlas.build(),
            self._sky,
            np.array(self._place).reshape(-1, 2),
            np.array(self._when, np.int8),
            moving,
        )

    # Placing things

    def _stand(self, model: Surfaces, xz: Float, heading: float, when: int = ALWAYS) -> None:
        """Put a model, whose surfaces carry the next number, on the ground."""
        up = float(self._route.terrain.height(xz[None])[0])
        self._parts.append(model.moved(solids.turn(heading), np.array([xz[0], -up, xz[1]])))
        self._place.append(xz)
        self._when.append(when)

    @property
    def _next(self) -> int:
        return len(self._place)

    def _changes(self, rng: Rng, rate: float) -> bool:
        return bool(rng.random() < rate * self._variation.change)

    def _sign(self) -> tuple[int, int]:
        face, alpha = textures.sign(self._rng)
        back = 95.0 + 5.0 * textures.noise(self._rng, face.shape[0], face.shape[1], 30.0)
        return self._atlas.add(face, alpha), self._atlas.add(back, alpha)

    def _roof_tiles(self) -> textures.Grey:
        rng = self._rng
        y, x = np.mgrid[0:256, 0:256]
        course = 60 + 40 * rng.random() + 13 * np.sin(2 * np.pi * x / 12.8)
        course = course - 24 * ((y % 16) < 3)
        return np.clip(course * (1 + 0.13 * textures.noise(rng, 256, 256, 60.0, 6)), 5, 240)

    def _with_side_streets(self, roads: Roads) -> Roads:
        if self._route.land == "motorway":
            return roads
        rng = np.random.default_rng([self._variation.seed, 2])
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

    # Houses

    def _house(self, xz: Float, heading: float, size: tuple[float, float, float]) -> None:
        """A house whose front stands at ``xz`` and looks back along ``heading``."""
        seed, number = self._variation.seed, self._next
        key = number % _ALIASES if self._variation.aliased else number
        rng = np.random.default_rng([seed, 3, key])
        style = random_style(rng, town=self._route.land == "town")
        width, height, depth = size
        changes = self._changes(np.random.default_rng([seed, 4, number]), 0.9)
        night = self._variation.change > 0.7
        walls = [(width, True), (depth, False), (width, False), (depth, False)]
        state = rng.bit_generator.state
        for when in (BEFORE, AFTER) if changes else (ALWAYS,):
            rng.bit_generator.state = state
            lived = np.random.default_rng([seed, 5, key, when])
            sides, lights = [], []
            for across, front in walls:
                grey, lit = facade(rng, lived, style, (across, height), front=front)
                sides.append(self._atlas.add(grey))
                lights.append(self._atlas.add(120 + 110 * lit, 255.0 * (lit > 0)) if night else -1)
            thing = self._next
            house = solids.join([
                solids.walls(size, sides, lights, self._plaster, thing=thing),
                solids.roof(rng, size, self._tiles[int(rng.integers(6))], self._render,
                            self._plaster, thing=thing),
            ])  # fmt: skip
            self._stand(house, xz, heading, when)

    def _try_house(
        self, front: Float, heading: float, size: tuple[float, float, float], clear: float
    ) -> bool:
        ahead = np.array([np.sin(heading), np.cos(heading)])
        middle = front + 0.5 * size[2] * ahead
        if not self._plan.claim(
            rectangle(middle, heading, size[0], size[2]), road=clear, tall=True
        ):
            return False
        self._house(front, heading, size)
        return True

    def _size(self, rng: Rng) -> tuple[float, float, float]:
        if self._variation.aliased:
            rng = np.random.default_rng([self._variation.seed, 6, self._next % _ALIASES])
        tall = 3.0 * int(rng.integers(2, 6 if self._route.land == "town" else 4))
        return (
            float(rng.uniform(8, 17)),
            tall + float(rng.uniform(0.3, 1.2)),
            float(rng.uniform(8, 12)),
        )

    def _line_with_houses(self) -> None:
        """Fronts along both sides of every road."""
        roads, rng, town = self._roads, self._rng, self._route.land == "town"
        for side in (-1.0, 1.0):
            at, setback = 0, self._style.walk + 2.0
            while at < len(roads.xz) - 20:
                size = self._size(rng)
                middle = min(at + int(2 * size[0]), len(roads.xz) - 1)
                if rng.random() < 0.45:
                    low, high = (0.3, 4.0) if town else (3.5, 9.0)
                    setback = self._style.walk + float(rng.uniform(low, high))
                out = roads.right[middle] * side
                front = roads.xz[middle] + setback * out
                heading = float(np.arctan2(out[0], out[1])) + float(rng.normal(0, 0.015))
                if self._try_house(front, heading, size, self._style.walk + 0.2):
                    gap = 0.0 if town and rng.random() < 0.45 else float(rng.uniform(2.5, 9.0))
                    at += int(4 * (size[0] + gap)) + 1
                else:
                    at += 8

    def _close_sight_lines(self) -> None:
        """Where a street opens on nothing, a house stands in the view."""
        rng = self._rng
        last = np.array([-1e9, -1e9])
        for T in self._route.T_wc:
            xz = T[[0, 2], 3]
            if np.linalg.norm(xz - last) < 4.0:
                continue
            last = xz
            heading = float(np.arctan2(T[0, 2], T[2, 2]))
            for angle in np.radians(np.arange(-42, 43, 3)):
                line = self._plan.open_ray(xz, heading + angle, 230.0)
                if line is None:
                    continue
                distance = self._plan.road_distance(line)
                for k in range(24, len(line), 3):
                    size = self._size(rng)
                    if distance[k] > self._style.walk + 1.0 and self._try_house(
                        line[k], heading + float(angle) + float(rng.normal(0, 0.25)), size,
                        self._style.walk + 0.5,
                    ):  # fmt: skip
                        break

    def _fill_behind(self) -> None:
        """Big trees between and behind the houses."""
        rng, roads = self._rng, self._roads
        for at in range(0, len(roads.xz), 14):
            for side in (-1.0, 1.0):
                far = float(rng.uniform(self._style.walk + 2.5, 34.0))
                xz = roads.xz[at] + side * far * roads.right[at] + rng.normal(0, 1.0, 2)
                self._plant(xz, float(rng.uniform(7.0, 14.0)))

    # Green and furniture

    def _plant(self, xz: Float, height: float) -> None:
        rng = np.random.default_rng([self._variation.seed, 7, self._next])
        if not self._plan.claim(rectangle(xz, 0.0, 1.6, 1.6), road=self._style.lane + 1.0):
            return
        if self._variation.aliased:
            rng = np.random.default_rng([self._variation.seed, 8, self._next % _ALIASES])
        conifer = bool(rng.random() < 0.22)
        changes = self._changes(rng, 1.0) and not conifer
        state = rng.bit_generator.state
        for when in (BEFORE, AFTER) if changes else (ALWAYS,):
            rng.bit_generator.state = state
            twigs = self._later_twigs if when == AFTER else self._twigs
            model = solids.tree(
                rng, self._needles if conifer else twigs, self._bark[self._next % 4],
                height=height, thing=self._next, conifer=conifer,
            )  # fmt: skip
            heading = float(rng.uniform(0, 6.3))
            if (free := self._pruned(model, xz)) is not None:
                self._stand(free, xz, heading, when)

    def _pruned(self, model: Surfaces, xz: Float) -> Surfaces | None:
        """Without twigs that hang into the free space around the cameras; None if few remain."""
        near = float(np.min(np.linalg.norm(self._cameras - xz, axis=1)))
        middle = model.origin + 0.5 * (model.edge_s + model.edge_t)
        size = np.linalg.norm(model.edge_s, axis=1) + np.linalg.norm(model.edge_t, axis=1)
        reach = np.hypot(middle[:, 0], middle[:, 2]) + 0.5 * size
        low = middle[:, 1] + 0.5 * size > -1.65 - CLEARANCE - 0.7
        hangs = (reach > near - CLEARANCE - 0.2) & low
        return model.select(~hangs) if hangs.mean() < 0.3 else None

    def _furnish(self) -> None:
        roads, style, rng = self._roads, self._style, self._rng
        for side in (-1.0, 1.0):
            for step, rate, action in (
                (21, 0.62, self._park),
                (26, 0.55, self._screen),
                (38, 0.55, self._kerb_tree),
                (62, 0.7, self._post),
                (17, 0.45, self._shrub),
            ):
                for at in range(int(rng.integers(0, step)), len(roads.xz), step):
                    if rng.random() < rate and not roads.junction[at]:
                        out = roads.right[at] * side
                        action(roads.xz[at], out, style)

    def _park(self, xz: Float, out: Float, style: RoadStyle) -> None:
        rng = self._rng
        along = float(np.arctan2(out[0], out[1])) - np.pi / 2
        heading = (
            along + float(rng.choice([0.0, np.pi], p=[0.85, 0.15])) + float(rng.normal(0, 0.02))
        )
        near = xz + out * (style.lane + 1.15 + float(rng.normal(0, 0.06)))
        if not self._plan.claim(rectangle(near, heading, 2.05, 5.2), road=style.lane - 0.6):
            return
        leaves = self._changes(rng, 0.8)
        for when in (BEFORE, AFTER) if leaves else (ALWAYS,):
            if leaves and rng.random() < 0.35:
                continue
            key = self._next % _ALIASES if self._variation.aliased else self._next
            car = make_car(np.random.default_rng([self._variation.seed, 10, key]), self._atlas,
                           self._next)  # fmt: skip
            self._stand(car.surfaces, near, heading, when)

    def _screen(self, xz: Float, out: Float, style: RoadStyle) -> None:
        """Hedge, fence, wall or placard at the inner edge of the pavement."""
        rng, thing = self._rng, self._next
        length = float(rng.uniform(3.0, 6.4))
        heading = float(np.arctan2(out[0], out[1]))
        at = xz + out * (style.walk + float(rng.uniform(0.1, 0.5)))
        if not self._plan.claim(
            rectangle(at + 0.4 * out, heading, length, 0.8), road=style.walk - 0.2
        ):
            return
        kind = rng.random()
        if kind < 0.5:
            model = solids.hedge(rng, length, float(rng.uniform(0.9, 2.2)),
                                 int(rng.choice(self._hedges)), self._leaves, thing)  # fmt: skip
        elif kind < 0.7:
            model = solids.panel(
                length, float(rng.uniform(0.8, 1.4)), int(rng.choice(self._fences)), thing
            )
        elif kind < 0.92:
            model = solids.panel(
                length,
                float(rng.uniform(0.5, 1.5)),
                int(rng.choice(self._walls)),
                thing,
                depth=0.25,
            )
        else:
            for when in (BEFORE, AFTER) if self._changes(rng, 1.0) else (ALWAYS,):
                face = int(rng.choice(self._posters))
                board = solids.panel(2.4, 2.6, face, self._next)
                board.uv[:] = (0, 1, 0, 0, 0, 1)
                self._stand(board, at, heading, when)
            return
        self._stand(model, at, heading)

    def _kerb_tree(self, xz: Float, out: Float, style: RoadStyle) -> None:
        rng = self._rng
        self._plant(
            xz + out * (style.parking + float(rng.uniform(0.5, 2.5))), float(rng.uniform(5.0, 10.5))
        )

    def _shrub(self, xz: Float, out: Float, style: RoadStyle) -> None:
        rng, height = self._rng, float(self._rng.uniform(0.7, 2.4))
        at = xz + out * (style.walk + float(rng.uniform(0.7, 3.0)))
        if self._plan.claim(rectangle(at, 0.0, height, height), road=style.walk - 0.3):
            self._stand(solids.bush(rng, self._twigs, height=height, thing=self._next), at, 0.0)

    def _post(self, xz: Float, out: Float, style: RoadStyle) -> None:
        rng, thing = self._rng, self._next
        at = xz + out * (style.parking + 0.45)
        if not self._plan.claim(rectangle(at, 0.0, 0.6, 0.6), road=style.lane + 0.6):
            return
        heading = float(np.arctan2(out[0], out[1]))
        if rng.random() < 0.5:
            model = solids.lamp_post(
                float(rng.uniform(4.8, 7.5)), 0.9, self._metal, self._lamp, thing
            )
        else:
            faces = [
                self._signs[k] for k in rng.integers(len(self._signs), size=rng.integers(1, 3))
            ]
            model = solids.sign_post(rng, float(rng.uniform(2.3, 3.1)), self._metal, faces, thing)
            heading += -np.pi / 2 if rng.random() < 0.8 else np.pi / 2
        self._stand(model, at, heading)

    # The motorway

    def _line_motorway(self) -> None:
        """Rails, barriers, posts, gantry signs, embankment trees."""
        roads, rng, style = self._roads, self._rng, self._style
        for side in (-1.0, 1.0):
            for at in range(0, len(roads.xz) - 16, 16):
                out = roads.right[at + 8] * side
                heading = float(np.arctan2(out[0], out[1]))
                xz, thing = roads.xz[at + 8], self._next
                rail = solids.box(
                    (-2.02, -0.75, 0), (2.02, -0.42, 0.08), self._metal, thing=thing, gain=1.4
                )
                post = solids.box(
                    (-0.06, -0.7, 0.05), (0.06, 0.3, 0.15), self._metal, thing=thing, gain=0.7
                )
                self._stand(join([rail, post]), xz + out * (style.walk + 0.4), heading)
                if rng.random() < 0.25:
                    height = float(rng.uniform(0.9, 1.2))
                    mark = solids.box(
                        (-0.06, -height, 0), (0.06, 0.2, 0.08), self._lamp, thing=self._next
                    )
                    self._stand(mark, xz + out * (style.walk + 1.0), heading)
            barrier = False
            for at in range(0, len(roads.xz) - 20, 20):
                out = roads.right[at] * side
                heading = float(np.arctan2(out[0], out[1]))
                barrier ^= bool(rng.random() < 0.05)
                if barrier:
                    wall = solids.panel(
                        5.05, 3.0, int(rng.choice(self._walls)), self._next, depth=0.2
                    )
                    self._stand(wall, roads.xz[at] + out * (style.walk + 4.0), heading)
                elif rng.random() < 0.5:
                    far = style.walk + float(rng.uniform(6.0, 30.0))
                    self._plant(roads.xz[at] + out * far, float(rng.uniform(6.0, 14.0)))
                if rng.random() < 0.06:
                    faces = [self._signs[int(rng.integers(len(self._signs)))]]
                    sign = solids.sign_post(rng, 3.6, self._metal, faces, self._next)
                    self._stand(
                        sign, roads.xz[at] + out * (style.walk + 1.6), heading - side * np.pi / 2
                    )
