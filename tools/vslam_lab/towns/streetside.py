"""Adds trees, parked cars, hedges, signs and rails beside the road."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vslam_lab.towns import solids
from vslam_lab.towns.ground import RoadStyle
from vslam_lab.towns.scene import Surfaces, join, patches
from vslam_lab.towns.site import AFTER, ALIASES, ALWAYS, BEFORE, Float, Site
from vslam_lab.towns.terrain import CLEARANCE, rectangle
from vslam_lab.towns.vehicles import make_car

_KERB = (0.15, 0.12)  # width and height of kerb stones, m


def plant(site: Site, xz: Float, height: float) -> None:
    """Plant a tree at the ``(2,)`` position (x, z) if there is enough space."""
    rng = np.random.default_rng([site.variation.seed, 7, site.next_thing])
    if not site.plan.claim(rectangle(xz, 0.0, 1.6, 1.6), road=site.style.lane + 1.0):
        return
    if site.variation.aliased:
        rng = np.random.default_rng([site.variation.seed, 8, site.next_thing % ALIASES])
    conifer = bool(rng.random() < 0.22)
    changes = site.changes(rng, 1.0) and not conifer
    state = rng.bit_generator.state
    for when in (BEFORE, AFTER) if changes else (ALWAYS,):
        rng.bit_generator.state = state
        twigs = site.palette.later_twigs if when == AFTER else site.palette.twigs
        model = solids.tree(
            rng, site.palette.needles if conifer else twigs, site.palette.bark[site.next_thing % 4],
            height=height, thing=site.next_thing, conifer=conifer,
        )  # fmt: skip
        heading = float(rng.uniform(0, 6.3))
        if (free := _pruned(site, model, xz)) is not None:
            site.stand(free, xz, heading, when)


def _pruned(site: Site, model: Surfaces, xz: Float) -> Surfaces | None:
    """Remove from a model of a tree the twigs that are too near to a camera.

    Returns None if 30 % or more of the twigs are too near.
    """
    near = float(np.min(np.linalg.norm(site.cameras - xz, axis=1)))
    middle = model.origin + 0.5 * (model.edge_s + model.edge_t)
    size = np.linalg.norm(model.edge_s, axis=1) + np.linalg.norm(model.edge_t, axis=1)
    reach = np.hypot(middle[:, 0], middle[:, 2]) + 0.5 * size
    low = middle[:, 1] + 0.5 * size > -1.65 - CLEARANCE - 0.7
    hangs = (reach > near - CLEARANCE - 0.2) & low
    return model.select(~hangs) if hangs.mean() < 0.3 else None


def lay_kerbs(site: Site) -> None:
    """Lay raised kerb stones between the carriageway and the pavement.

    There are no kerb stones where another road joins, and where the camera cuts a corner.
    """
    roads, edge, step = site.roads, site.style.parking, 8
    tree, cameras = cKDTree(roads.xz), cKDTree(site.cameras)
    first = np.arange(0, len(roads.xz) - step, step)
    first = first[np.abs(roads.along[first + step] - roads.along[first]) < 0.25 * step + 0.5]
    right = roads.right
    for side in (-1.0, 1.0):
        ends = [roads.xz[k] + side * edge * right[k] for k in (first, first + step)]
        back = [roads.xz[k] + side * (edge + _KERB[0]) * right[k] for k in (first, first + step)]
        free = np.ones(len(first), bool)
        for at in (ends[0], 0.5 * (ends[0] + ends[1]), ends[1]):
            free &= (tree.query(at)[0] > edge - 0.1) & (cameras.query(at)[0] > CLEARANCE + 1.2)
        a, b, c = (_on_ground(site, xz[free], _KERB[1]) for xz in (*ends, back[0]))
        along = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
        for across in (np.array([0.0, _KERB[1] + 0.1, 0.0]), c - a):
            site.parts.append(patches(a, b - a, across, site.palette.kerb, uv=along))


def _on_ground(site: Site, xz: Float, height: float) -> Float:
    """Return ``(N, 3)`` points above the ground at ``(N, 2)`` positions (x, z)."""
    up = site.route.terrain.height(xz) + height
    return np.stack([xz[:, 0], -up, xz[:, 1]], axis=1)


def fill_behind(site: Site) -> None:
    """Plant big trees between and behind the houses."""
    rng, roads = site.rng, site.roads
    for at in range(0, len(roads.xz), 14):
        for side in (-1.0, 1.0):
            far = float(rng.uniform(site.style.walk + 2.5, 34.0))
            xz = roads.xz[at] + side * far * roads.right[at] + rng.normal(0, 1.0, 2)
            plant(site, xz, float(rng.uniform(7.0, 14.0)))


def furnish(site: Site) -> None:
    """Add cars, hedges, trees, posts and shrubs along the streets."""
    roads, style, rng = site.roads, site.style, site.rng
    town = site.route.land == "town"
    for side in (-1.0, 1.0):
        for step, rate, action in (
            (21, 0.62 if town else 0.3, _park),
            (26, 0.45 if town else 0.95, _screen),
            (38, 0.5 if town else 0.6, _kerb_tree),
            (62, 0.7, _post),
            (17, 0.3 if town else 0.75, _shrub),
        ):
            for at in range(int(rng.integers(0, step)), len(roads.xz), step):
                if rng.random() < rate and not roads.junction[at]:
                    action(site, roads.xz[at], roads.right[at] * side, style)


def _park(site: Site, xz: Float, out: Float, style: RoadStyle) -> None:
    rng = site.rng
    along = float(np.arctan2(out[0], out[1])) - np.pi / 2
    heading = along + float(rng.choice([0.0, np.pi], p=[0.85, 0.15])) + float(rng.normal(0, 0.02))
    near = xz + out * (style.lane + 1.15 + float(rng.normal(0, 0.06)))
    if not site.plan.claim(rectangle(near, heading, 2.05, 5.2), road=style.lane - 0.6):
        return
    changes = site.changes(rng, 0.8)
    for when in (BEFORE, AFTER) if changes else (ALWAYS,):
        if changes and rng.random() < 0.35:
            continue
        key = site.next_thing % ALIASES if site.variation.aliased else site.next_thing
        car = make_car(np.random.default_rng([site.variation.seed, 10, key]), site.atlas,
                       site.next_thing)  # fmt: skip
        site.stand(car, near, heading, when)


def _screen(site: Site, xz: Float, out: Float, style: RoadStyle) -> None:
    """Add a hedge, fence, wall or poster at the inner edge of the pavement."""
    rng, thing = site.rng, site.next_thing
    length = float(rng.uniform(3.0, 6.4))
    heading = float(np.arctan2(out[0], out[1]))
    at = xz + out * (style.walk + float(rng.uniform(0.1, 0.5)))
    if not site.plan.claim(rectangle(at + 0.4 * out, heading, length, 0.8), road=style.walk - 0.2):
        return
    kind = rng.random()
    if kind < (0.45 if site.route.land == "town" else 0.6):
        model = solids.hedge(
            rng, length, float(rng.uniform(0.9, 2.2)),
            int(rng.choice(site.palette.hedges)), site.palette.leaves, thing,
        )  # fmt: skip
    elif kind < 0.75:
        model = solids.panel(
            length, float(rng.uniform(0.8, 1.4)), int(rng.choice(site.palette.fences)), thing
        )
    elif kind < 0.92:
        model = solids.panel(
            length,
            float(rng.uniform(0.5, 1.5)),
            int(rng.choice(site.palette.walls)),
            thing,
            depth=0.25,
        )
    else:
        for when in (BEFORE, AFTER) if site.changes(rng, 1.0) else (ALWAYS,):
            face = int(rng.choice(site.palette.posters))
            board = solids.panel(2.4, 2.6, face, site.next_thing)
            board.uv[:] = (0, 1, 0, 0, 0, 1)
            site.stand(board, at, heading, when)
        return
    site.stand(model, at, heading)


def _kerb_tree(site: Site, xz: Float, out: Float, style: RoadStyle) -> None:
    at = xz + out * (style.parking + float(site.rng.uniform(0.5, 2.5)))
    plant(site, at, float(site.rng.uniform(5.0, 10.5)))


def _shrub(site: Site, xz: Float, out: Float, style: RoadStyle) -> None:
    rng, height = site.rng, float(site.rng.uniform(0.7, 2.4))
    deep = 3.0 if site.route.land == "town" else 7.0
    at = xz + out * (style.walk + float(rng.uniform(0.7, deep)))
    if site.plan.claim(rectangle(at, 0.0, height, height), road=style.walk - 0.3):
        site.stand(
            solids.bush(rng, site.palette.twigs, height=height, thing=site.next_thing), at, 0.0
        )


def _post(site: Site, xz: Float, out: Float, style: RoadStyle) -> None:
    rng, thing = site.rng, site.next_thing
    at = xz + out * (style.parking + 0.45)
    if not site.plan.claim(rectangle(at, 0.0, 0.6, 0.6), road=style.lane + 0.6):
        return
    heading = float(np.arctan2(out[0], out[1]))
    if rng.random() < 0.5:
        site.lamps.append(at - 0.9 * out)
        model = solids.lamp_post(
            float(rng.uniform(4.8, 7.5)), 0.9, site.palette.metal, site.palette.lamp, thing
        )
    else:
        faces = [
            site.palette.signs[k]
            for k in rng.integers(len(site.palette.signs), size=rng.integers(1, 3))
        ]
        model = solids.sign_post(
            rng, float(rng.uniform(2.3, 3.1)), site.palette.metal, faces, thing
        )
        heading += -np.pi / 2 if rng.random() < 0.8 else np.pi / 2
    site.stand(model, at, heading)


def line_motorway(site: Site) -> None:
    """Add rails, posts, barriers, trees and signs along a motorway."""
    roads, rng, style = site.roads, site.rng, site.style
    for side in (-1.0, 1.0):
        for at in range(0, len(roads.xz) - 16, 16):
            out = roads.right[at + 8] * side
            heading = float(np.arctan2(out[0], out[1]))
            xz, thing = roads.xz[at + 8], site.next_thing
            rail = solids.box(
                (-2.02, -0.75, 0), (2.02, -0.42, 0.08), site.palette.metal, thing=thing, gain=1.4
            )
            post = solids.box(
                (-0.06, -0.7, 0.05), (0.06, 0.3, 0.15), site.palette.metal, thing=thing, gain=0.7
            )
            site.stand(join([rail, post]), xz + out * (style.walk + 0.4), heading)
            if rng.random() < 0.25:
                height = float(rng.uniform(0.9, 1.2))
                mark = solids.box(
                    (-0.06, -height, 0), (0.06, 0.2, 0.08), site.palette.lamp, thing=site.next_thing
                )
                site.stand(mark, xz + out * (style.walk + 1.0), heading)
        barrier = False
        for at in range(0, len(roads.xz) - 20, 20):
            out = roads.right[at] * side
            heading = float(np.arctan2(out[0], out[1]))
            barrier ^= bool(rng.random() < 0.05)
            if barrier:
                wall = solids.panel(
                    5.05, 3.0, int(rng.choice(site.palette.walls)), site.next_thing, depth=0.2
                )
                site.stand(wall, roads.xz[at] + out * (style.walk + 4.0), heading)
            elif rng.random() < 0.5:
                far = style.walk + float(rng.uniform(6.0, 30.0))
                plant(site, roads.xz[at] + out * far, float(rng.uniform(6.0, 14.0)))
            if rng.random() < 0.06:
                faces = [site.palette.signs[int(rng.integers(len(site.palette.signs)))]]
                sign = solids.sign_post(rng, 3.6, site.palette.metal, faces, site.next_thing)
                site.stand(
                    sign, roads.xz[at] + out * (style.walk + 1.6), heading - side * np.pi / 2
                )
