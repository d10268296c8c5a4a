"""Houses along the streets, and at the ends of sight lines that would otherwise be open."""

from __future__ import annotations

import numpy as np

from vslam.datasets.synthetic import solids
from vslam.datasets.synthetic.facades import facade, random_style
from vslam.datasets.synthetic.plan import rectangle
from vslam.datasets.synthetic.site import AFTER, ALIASES, ALWAYS, BEFORE, Float, Site
from vslam.datasets.synthetic.textures import Rng


def _house(site: Site, xz: Float, heading: float, size: tuple[float, float, float]) -> None:
    """Build a house whose front stands at ``xz`` and faces against ``heading``."""
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


def _try_house(
    site: Site, front: Float, heading: float, size: tuple[float, float, float], clear: float
) -> bool:
    ahead = np.array([np.sin(heading), np.cos(heading)])
    middle = front + 0.5 * size[2] * ahead
    if not site.plan.claim(rectangle(middle, heading, size[0], size[2]), road=clear, tall=True):
        return False
    _house(site, front, heading, size)
    return True


def _size(site: Site, rng: Rng) -> tuple[float, float, float]:
    if site.variation.aliased:
        rng = np.random.default_rng([site.variation.seed, 6, site.next_thing % ALIASES])
    if site.route.land == "town":
        tall, width = 3.0 * int(rng.integers(2, 6)), float(rng.uniform(8, 17))
    else:
        tall, width = 2.8 * int(rng.integers(1, 3)), float(rng.uniform(8, 13))
    return (width, tall + float(rng.uniform(0.3, 1.2)), float(rng.uniform(8, 12)))


def line_with_houses(site: Site) -> None:
    """Build houses along both sides of every road."""
    roads, rng, town = site.roads, site.rng, site.route.land == "town"
    for side in (-1.0, 1.0):
        at, setback = 0, site.style.walk + (2.0 if town else 6.0)
        while at < len(roads.xz) - 20:
            size = _size(site, rng)
            middle = min(at + int(2 * size[0]), len(roads.xz) - 1)
            if rng.random() < 0.45:
                low, high = (0.3, 4.0) if town else (4.0, 11.0)
                setback = site.style.walk + float(rng.uniform(low, high))
            out = roads.right[middle] * side
            front = roads.xz[middle] + setback * out
            heading = float(np.arctan2(out[0], out[1])) + float(rng.normal(0, 0.015))
            if _try_house(site, front, heading, size, site.style.walk + 0.2):
                gap = 0.0
                if not (town and rng.random() < 0.45):
                    gap = float(rng.uniform(2.5, 9.0) if town else rng.uniform(5.0, 16.0))
                at += int(4 * (size[0] + gap)) + 1
            else:
                at += 8


def close_sight_lines(site: Site) -> None:
    """Build houses that end every open line of sight along the route."""
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
                size = _size(site, rng)
                if distance[k] > site.style.walk + 1.0 and _try_house(site, 
                    line[k], heading + float(angle) + float(rng.normal(0, 0.25)), size,
                    site.style.walk + 0.5,
                ):  # fmt: skip
                    break
