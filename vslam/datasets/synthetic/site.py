"""A town under construction, which is shared by all functions that add to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic import solids
from vslam.datasets.synthetic.ground import RoadStyle
from vslam.datasets.synthetic.palette import Palette
from vslam.datasets.synthetic.plan import Plan
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.scene import AtlasBuilder, Surfaces
from vslam.datasets.synthetic.terrain import Roads
from vslam.datasets.synthetic.textures import Rng

Float = NDArray[np.float64]

# When an object exists: always, until its place is left for the first time, or from then on.
ALWAYS, BEFORE, AFTER = 0, 1, 2
ALIASES = 4  # number of different houses, trees and cars with --aliased


@dataclass(frozen=True)
class Variation:
    """The variation of a town.

    Attributes:
        seed: seed of all random numbers.
        aliased: repeat a few houses, trees and cars, so that different places look alike.
        change: how much a place has changed when it is passed again, 0 to 1.
        moving: number of moving cars.
    """

    seed: int = 0
    aliased: bool = False
    change: float = 0.0
    moving: int = 0


@dataclass(frozen=True)
class Site:
    """The town so far, and everything that is needed to add to it.

    Attributes:
        route, variation: what is built.
        roads: the route's roads with side streets.
        style: cross-section of the roads.
        plan: occupied ground.
        atlas, palette: textures.
        rng: random generator for everything that may differ between variations.
        cameras: ``(N, 2)`` x and z of all possible camera positions.
        lamps: x and z of the street lamps.
        parts: surfaces of each thing, in the route's world.
        place, when: for each thing; see `town.Town`.
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
        """The ``thing`` number for the surfaces of the next thing."""
        return len(self.place)

    def stand(self, model: Surfaces, xz: Float, heading: float, when: int = ALWAYS) -> None:
        """Place a model on the ground; its surfaces must have the number `next_thing`."""
        up = float(self.route.terrain.height(xz[None])[0])
        self.parts.append(model.moved(solids.turn(heading), np.array([xz[0], -up, xz[1]])))
        self.place.append(xz)
        self.when.append(when)

    def changes(self, rng: Rng, rate: float) -> bool:
        """Draw at random whether an object has changed when its place is passed again."""
        return bool(rng.random() < rate * self.variation.change)
