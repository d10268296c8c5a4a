"""Computes the state of a town at each frame: static objects, moving objects, and light."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam_lab.towns.render import Light, Moment
from vslam_lab.towns.rooms import LAMPS, SIZES
from vslam_lab.towns.routes import CAMERA_HEIGHT, Route
from vslam_lab.towns.scene import Surfaces, join
from vslam_lab.towns.shadows import (
    NO_LAMPS,
    ShadowMap,
    cast_shadows,
    lamp_pools,
)
from vslam_lab.towns.site import AFTER, ALWAYS, BEFORE, Variation
from vslam_lab.towns.terrain import CLEARANCE
from vslam_lab.towns.town import Town

_NEAR, _LEFT = 60.0, 75.0  # m: distances at which a place counts as reached, and as left
_AGAIN, _STRETCH = 60, 15  # frames: shortest time until a revisit, and shortest length of a revisit
_SHADOW_MAPS = 8  # number of shadow maps that are kept
_CLOUD = 12.0  # frames around the start of a pass in which a cloud hides the sun while it moves
_CAR_REACH = np.array([1.1, 2.7])  # half the width and length of the largest car, m


class Passes:
    """Computes the surfaces and the light at each frame of a drive. The class is thread-safe."""

    def __init__(self, route: Route, town: Town, variation: Variation) -> None:
        self._route, self._town, self._variation = route, town, variation
        self._switch = _switch_frames(town.place, route.T_wc[:, [0, 2], 3])
        self._lock = threading.Lock()
        self._shadows: dict[int, ShadowMap] = {}  # by pass
        self._starts = pass_starts(route.T_wc) if variation.change > 0 else [0]
        self._pools = lamp_pools(town.lamps)

    def at(self, frame: int) -> Moment:
        number = int(np.searchsorted(self._starts, frame, side="right")) - 1
        inside = self._route.land in SIZES
        light, night = (LAMPS, 0.0) if inside else self._light(frame, number)
        standing = self._static_surfaces(frame)
        with self._lock:
            if number not in self._shadows:
                begin, end = (*self._starts, len(self._route.T_wc))[number : number + 2]
                occluders = self._static_surfaces((begin + end) // 2)
                self._shadows[number] = cast_shadows(occluders, self._town.atlas, light.sun)
                while len(self._shadows) > _SHADOW_MAPS:
                    del self._shadows[next(iter(self._shadows))]
            shadows = self._shadows[number]
        cars = self._cars(frame)
        surfaces = join([standing, *cars]) if cars else standing
        return Moment(surfaces, shadows, light, night, self._pools if night > 0 else NO_LAMPS)

    def _static_surfaces(self, frame: int) -> Surfaces:
        surfaces, when = self._town.surfaces, self._town.when
        if not when.any():
            return surfaces
        later = frame >= self._switch
        present = (when == ALWAYS) | ((when == BEFORE) & ~later) | ((when == AFTER) & later)
        return surfaces.select((surfaces.thing < 0) | present[surfaces.thing])

    def _light(self, frame: int, number: int) -> tuple[Light, float]:
        """Return the light at a frame of pass ``number``, and the darkness (0 by day, 1 at night).

        A pass is a part of the drive in which no street is revisited. The sun moves only between
        two passes, while a cloud hides it. Night falls slowly during the whole drive.
        """
        seed, change = self._variation.seed, self._variation.change
        rng = np.random.default_rng([seed, 11])
        azimuth, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(33, 46))
        moved = change * number / max(len(self._starts) - 1, 1)
        azimuth += np.radians(110) * moved
        rise *= 1.0 - 0.35 * moved
        progress = min(frame / max(len(self._route.T_wc) - 1, 1), 1.0)
        progress = progress * progress * (3 - 2 * progress)
        night = max(0.0, change - 0.7) / 0.3 * progress
        from_start = min((abs(frame - start) for start in self._starts[1:]), default=1000)
        clear = 1.0 - float(np.exp(-((from_start / _CLOUD) ** 2)))
        sun = np.array(
            [np.sin(azimuth) * np.cos(rise), -np.sin(rise), np.cos(azimuth) * np.cos(rise)]
        )
        light = Light(
            sun,
            direct=clear * (1.0 - night),
            ambient=0.29 * (2 - clear) * (1 - 0.7 * night),
            glow=0.9 * night,
            haze=125.0 * (1 - 0.93 * night),
            headlight=0.5 * night,
            exposure=1.95 * (1 + 1.4 * night),
        )
        return light, night

    def _cars(self, frame: int) -> list[Surfaces]:
        """The first moving car is ahead of the camera. The others approach on the other lane."""
        T_wc = self._route.T_wc
        here, cars = T_wc[frame], []
        for k, model in enumerate(self._town.moving):
            if k == 0:
                at, shift, turn = frame + 24, 0.0, 1.0
            else:
                period = len(T_wc) + 60
                at = int(-1.15 * frame + k * period / len(self._town.moving)) % period
                shift, turn = -4.2, -1.0
            if at >= len(T_wc):
                continue
            T = T_wc[at]
            R = T[:3, :3] * [turn, 1.0, turn]
            t = T[:3, 3] + shift * T[:3, 0] + CAMERA_HEIGHT * T[:3, 1]
            away = np.abs((here[:3, 3] - t) @ R)[[0, 2]]
            if (away > _CAR_REACH + CLEARANCE).any():
                cars.append(model.moved(R, t))
        return cars


def _switch_frames(place: NDArray[np.float64], cameras: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each of T places, return the frame at which the camera first leaves the place.

    The result is the largest int64 if the camera never reaches the place, or never leaves it.
    """
    switch = np.full(len(place), np.iinfo(np.int64).max)
    for k, xz in enumerate(place):
        distance = np.hypot(*(cameras - xz).T)
        near = np.flatnonzero(distance < _NEAR)
        if near.size:
            left = np.flatnonzero(distance[near[0] :] > _LEFT)
            if left.size:
                switch[k] = near[0] + left[0]
    return switch


def pass_starts(T_wc: NDArray[np.float64]) -> list[int]:
    """Divide a drive into passes, and return the first frame of each pass.

    The first pass begins at frame 0. A new pass begins whenever the camera returns to a street in
    which it was before.

    Args:
        T_wc: ``(N, 4, 4)`` poses of the drive.
    """
    xz = T_wc[:, [0, 2], 3]
    tree = cKDTree(xz)
    known = np.array([
        min(near) < k - _AGAIN for k, near in enumerate(tree.query_ball_point(xz, 6.0))
    ])  # fmt: skip
    edges = np.flatnonzero(np.diff(np.r_[0, known, 0]))
    return [0, *(int(a) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= _STRETCH)]
