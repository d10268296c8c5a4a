"""A town in time: what stands and moves in it at a frame, and how it is lit."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic.plan import CLEARANCE
from vslam.datasets.synthetic.render import Light
from vslam.datasets.synthetic.routes import CAMERA_HEIGHT, Route
from vslam.datasets.synthetic.scene import Surfaces, join
from vslam.datasets.synthetic.shadows import ShadowMap, cast_shadows
from vslam.datasets.synthetic.site import AFTER, BEFORE, Variation
from vslam.datasets.synthetic.town import Town

_NEAR, _LEFT = 60.0, 75.0  # m: a place was passed, and has been left again
_SUN_STEP = 40  # frames between two positions of the sun
_CAR_REACH = np.array([1.0, 2.4])  # half width and length of the largest car, m


@dataclass(frozen=True)
class Moment:
    """All that the renderer needs of one frame; ``night`` 0 to 1 raises the sensor's gain."""

    surfaces: Surfaces
    shadows: ShadowMap
    light: Light
    night: float


class Passes:
    """Hands out moments; safe to call from several threads."""

    def __init__(self, route: Route, town: Town, variation: Variation) -> None:
        self._route, self._town, self._variation = route, town, variation
        self._switch = _switch_frames(town.place, route.T_wc[:, [0, 2], 3])
        self._lock = threading.Lock()
        self._casts: dict[int, tuple[ShadowMap, Surfaces]] = {}

    def at(self, frame: int) -> Moment:
        """The town at frame number ``frame`` of the route."""
        changing = self._variation.change > 0
        epoch = frame // _SUN_STEP if changing else 0
        light, night = self._light(epoch * _SUN_STEP)
        with self._lock:
            if epoch not in self._casts:
                standing = self._standing(epoch * _SUN_STEP)
                shadows = cast_shadows(standing, self._town.atlas, light.sun)
                self._casts = {k: v for k, v in self._casts.items() if k >= epoch - 1}
                self._casts[epoch] = shadows, standing
            shadows, standing = self._casts[epoch]
        if changing:
            standing = self._standing(frame)
        cars = self._cars(frame)
        return Moment(join([standing, *cars]) if cars else standing, shadows, light, night)

    def _standing(self, frame: int) -> Surfaces:
        surfaces, when = self._town.surfaces, self._town.when
        if not when.any():
            return surfaces
        later = frame >= self._switch
        present = (when == 0) | ((when == BEFORE) & ~later) | ((when == AFTER) & later)
        return surfaces.select((surfaces.thing < 0) | present[surfaces.thing])

    def _light(self, frame: int) -> tuple[Light, float]:
        seed, change = self._variation.seed, self._variation.change
        rng = np.random.default_rng([seed, 11])
        azimuth, rise = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(36, 50))
        progress = min(frame / max(len(self._route.T_wc) - 1, 1), 1.0)
        progress = progress * progress * (3 - 2 * progress)
        azimuth += np.radians(110) * change * progress
        night = max(0.0, change - 0.7) / 0.3 * progress
        rise *= 1.0 - 0.35 * change * progress
        sun = np.array(
            [np.sin(azimuth) * np.cos(rise), -np.sin(rise), np.cos(azimuth) * np.cos(rise)]
        )
        light = Light(
            sun,
            direct=1.0 - night,
            ambient=0.36 * (1 - 0.7 * night),
            glow=0.9 * night,
            haze=125.0 * (1 - 0.93 * night),
            headlight=0.5 * night,
            exposure=1.5 * (1 + 1.7 * night),
        )
        return light, night

    def _cars(self, frame: int) -> list[Surfaces]:
        """The first car drives ahead, the others come towards the camera on the other lane."""
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
    """``(T,)`` the frame at which each place has been left for the first time."""
    switch = np.full(len(place), np.iinfo(np.int64).max)
    for k, xz in enumerate(place):
        distance = np.hypot(*(cameras - xz).T)
        near = np.flatnonzero(distance < _NEAR)
        if near.size:
            left = np.flatnonzero(distance[near[0] :] > _LEFT)
            if left.size:
                switch[k] = near[0] + left[0]
    return switch
