"""A town under construction and its textures. Many functions add objects to the town."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam_lab.towns import solids, textures
from vslam_lab.towns.ground import RoadStyle
from vslam_lab.towns.routes import Route
from vslam_lab.towns.scene import AtlasBuilder, Surfaces
from vslam_lab.towns.terrain import Plan, Roads
from vslam_lab.towns.textures import Rng


@dataclass(frozen=True)
class Palette:
    """The numbers of the town's textures in the atlas.

    ``signs`` contains a front and a back texture for each sign. ``later_twigs`` are the sparser
    twigs of trees whose appearance has changed.
    """

    sky: int
    twigs: list[int]
    later_twigs: list[int]
    needles: list[int]
    bark: list[int]
    hedges: list[int]
    leaves: int
    fences: list[int]
    walls: list[int]
    signs: list[tuple[int, int]]
    posters: list[int]
    metal: int
    lamp: int
    kerb: int
    tiles: list[int]
    plaster: int
    render: int


def make_palette(rng: Rng, atlas: AtlasBuilder, pool: int) -> Palette:
    """Paint the textures. ``pool`` is the number of variants of trees, fences and walls."""
    add = atlas.add
    return Palette(
        sky=add(textures.sky(rng)),
        twigs=[add(*textures.foliage(rng)) for _ in range(pool)],
        later_twigs=[add(*textures.foliage(rng, density=0.55)) for _ in range(pool)],
        needles=[add(*textures.foliage(rng, density=1.6)) for _ in range(6)],
        bark=[add(textures.bark(rng)) for _ in range(4)],
        hedges=[add(*textures.hedge(rng)) for _ in range(5)],
        leaves=add(40 + 22 * textures.noise(rng, 128, 128, 6.0, 3)),
        fences=[add(*textures.fence(rng)) for _ in range(pool)],
        walls=[add(textures.garden_wall(rng)) for _ in range(pool)],
        signs=[_sign(rng, atlas) for _ in range(2 * pool)],
        posters=[add(textures.poster(rng)) for _ in range(2 * pool)],
        metal=add(np.full((16, 16), 92.0) + rng.normal(0, 9, (16, 16))),
        lamp=add(np.full((8, 8), 215.0)),
        kerb=add(_kerb(rng)),
        tiles=[add(_roof_tiles(rng)) for _ in range(6)],
        plaster=add(textures.detail(rng, 0.07, 3.0)),
        render=add(np.clip(165 + 9 * textures.noise(rng, 256, 256, 90.0, 6), 0, 255)),
    )


def _sign(rng: Rng, atlas: AtlasBuilder) -> tuple[int, int]:
    face, alpha = textures.sign(rng)
    back = 95.0 + 5.0 * textures.noise(rng, face.shape[0], face.shape[1], 30.0)
    return atlas.add(face, alpha), atlas.add(back, alpha)


def _kerb(rng: Rng) -> textures.Grey:
    """The kerb stones are 1 m long. The texture covers 4 m."""
    tone = np.repeat(rng.uniform(135, 175, 4), 128)[None, :]
    grey = tone * (1.0 + 0.09 * textures.noise(rng, 32, 512, 8.0, 3))
    grey[:, ::128] = grey[:, 1::128] = 60.0
    return np.clip(grey, 10, 240)


def _roof_tiles(rng: Rng) -> textures.Grey:
    y, x = np.mgrid[0:256, 0:256]
    grey = 60 + 40 * rng.random() + 13 * np.sin(2 * np.pi * x / 12.8)
    tone = rng.uniform(0.8, 1.2, (16, 20))[y // 16, x // 13]
    grey = grey * np.where(y % 16 < 4, 0.55, 1.0) * tone
    return np.clip(grey * (1 + 0.13 * textures.noise(rng, 256, 256, 60.0, 6)), 5, 240)


Float = NDArray[np.float64]

# When an object exists: always (ALWAYS), until the camera leaves its place for the first time
# (BEFORE), or only after that (AFTER).
ALWAYS, BEFORE, AFTER = 0, 1, 2
ALIASES = 4  # number of different houses, trees and cars with --aliased


@dataclass(frozen=True)
class Variation:
    """A variation of a town.

    Attributes:
        seed: seed of all random numbers.
        aliased: whether a few houses, trees and cars are repeated, so that different places look
            alike.
        change: how much a place has changed when the camera passes it again, from 0 to 1.
        moving: number of moving cars.
    """

    seed: int = 0
    aliased: bool = False
    change: float = 0.0
    moving: int = 0


@dataclass(frozen=True)
class Site:
    """A town under construction, with everything that is needed to add objects to it.

    Objects are called things in this package.

    Attributes:
        roads: the roads of the route, with side streets.
        style: cross-section of the roads.
        plan: occupied ground.
        palette: numbers of the textures in the atlas.
        rng: random generator for everything that may differ between variations.
        cameras: ``(N, 2)`` x and z of all possible camera positions.
        lamps: x and z of each street lamp.
        parts: surfaces of the things, in the world frame of the route.
        place: position of each thing, as in `town.Town`.
        when: in which part of the drive each thing exists, as in `town.Town`.
    """

    route: Route
    variation: Variation
    roads: Roads
    style: RoadStyle
    plan: Plan
    atlas: AtlasBuilder
    palette: Palette
    rng: Rng
    cameras: Float
    lamps: list[Float] = field(default_factory=list)
    parts: list[Surfaces] = field(default_factory=list)
    place: list[Float] = field(default_factory=list)
    when: list[int] = field(default_factory=list)

    @property
    def next_thing(self) -> int:
        """The number of the next object, for ``Surfaces.thing``."""
        return len(self.place)

    def stand(self, model: Surfaces, xz: Float, heading: float, when: int = ALWAYS) -> None:
        """Place a model on the ground as the next object. Its ``thing`` must be `next_thing`."""
        up = float(self.route.terrain.height(xz[None])[0])
        self.parts.append(model.moved(solids.turn(heading), np.array([xz[0], -up, xz[1]])))
        self.place.append(xz)
        self.when.append(when)

    def changes(self, rng: Rng, rate: float) -> bool:
        """Draw at random whether an object has changed when the camera passes it again."""
        return bool(rng.random() < rate * self.variation.change)
