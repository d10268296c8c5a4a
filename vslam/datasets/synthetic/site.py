"""A town under construction: what its builders share."""

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

# When an object stands there: always, until its place is left for the first time, or from then on.
ALWAYS, BEFORE, AFTER = 0, 1, 2
ALIASES = 4  # houses, trees and cars that --aliased deals


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
class Site:
    """What stands so far, and what is needed to add to it.

    Attributes:
        route, variation: what to build.
        roads: of the route, with side streets.
        style: cross-section of the roads.
        plan: ground that is taken.
        atlas, palette: textures.
        rng: for what need not be the same in another variation.
        parts: surfaces of each thing, in the route's world.
        place, when: of each thing; see `town.Town`.
        cameras: ``(N, 2)`` x and z of all places where a camera may stand.
        lamps: x and z of street lamps.
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
        """Number that the surfaces of the next thing must carry."""
        return len(self.place)

    def stand(self, model: Surfaces, xz: Float, heading: float, when: int = ALWAYS) -> None:
        """Put a model, whose surfaces carry `next_thing`, on the ground."""
        up = float(self.route.terrain.height(xz[None])[0])
        self.parts.append(model.moved(solids.turn(heading), np.array([xz[0], -up, xz[1]])))
        self.place.append(xz)
        self.when.append(when)

    def changes(self, rng: Rng, rate: float) -> bool:
        """Draw whether a thing differs when its place is passed again."""
        return bool(rng.random() < rate * self.variation.change)
