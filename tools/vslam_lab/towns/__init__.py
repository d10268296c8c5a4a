"""Rendered towns: stereo drives with exact ground truth, in KITTI's format.

The drives are rendered on this computer, so that nothing has to be downloaded.
"""

from __future__ import annotations

from dataclasses import replace

from vslam.datasets.frames import Source
from vslam.datasets.kitti import open_kitti
from vslam.support.errors import InputError
from vslam_lab.towns.inertial import simulated_imu
from vslam_lab.towns.motions import MOTIONS, built_in_motion
from vslam_lab.towns.routes import (
    DRIVES,
    ROUTES,
    Route,
    built_in_route,
    route_of_poses,
)
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import OnFrame, cache_folder, render_sequence

__all__ = [
    "DRIVES",
    "MOTIONS",
    "ROUTES",
    "Route",
    "Variation",
    "built_in_route",
    "cache_folder",
    "has_imu",
    "open_synthetic",
    "parse_drive",
    "render_sequence",
    "route_named",
    "route_of_poses",
]

_IMU = "imu"  # part of the name of a drive


def parse_drive(name: str) -> tuple[str, Variation]:
    """Split the name of a drive into the name of the route and the variation of its town.

    An example is ``05+change:0.5+moving:6+aliased+seed:1+imu``. A name in `DRIVES` stands for a
    route with a variation, to which more parts may be added. ``imu`` is no variation (`has_imu`).

    Raises:
        InputError: a part of the name is unknown.
    """
    first, plus, further = name.partition("+")
    route, *parts = (DRIVES.get(first, first) + plus + further).split("+")
    variation = Variation()
    try:
        for part in parts:
            key, _, value = part.partition(":")
            if key == "change" and 0.0 <= float(value) <= 1.0:
                variation = replace(variation, change=float(value))
            elif key == "moving" and int(value) >= 0:
                variation = replace(variation, moving=int(value))
            elif key == "seed" and int(value) >= 0:
                variation = replace(variation, seed=int(value))
            elif part == "aliased":
                variation = replace(variation, aliased=True)
            elif part != _IMU:
                raise ValueError
    except ValueError:
        raise InputError(
            f"--seq {name}: '{part}' is not understood; the route may only be followed by "
            "+change:X (0 to 1), +moving:CARS, +seed:N, +aliased and +imu."
        ) from None
    return route, variation


def has_imu(name: str) -> bool:
    """Return whether the name of a drive asks for the samples of an IMU."""
    return _IMU in name.split("+")[1:]


def route_named(name: str, variation: Variation) -> Route:
    """Make one of `ROUTES` or `MOTIONS`. The path of a motion depends on the seed.

    Raises:
        InputError: the name is unknown.
    """
    if name in MOTIONS:
        return built_in_motion(name, variation.seed)
    return built_in_route(name, MOTIONS)


def open_synthetic(
    name: str,
    variation: Variation | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> Source:
    """Open a drive on a built-in route. Frames that are not in the cache are rendered first.

    Args:
        name: name of the drive, for example ``05+change:0.5+seed:1`` (`parse_drive`).
        variation: variation of the town. If it is given, it is used instead of the variation in the
            name.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
        monocular: read only the left camera.
        threads: number of threads of the renderer.
        on_frame: called with the number of rendered frames and the number of all frames.

    Raises:
        InputError: the route or the variation is unknown, or `render_sequence` or `open_kitti`
            fails.
    """
    route_name, own_variation = parse_drive(name)
    route = route_named(route_name, variation or own_variation)
    until = None if max_frames is None else start + every * max_frames
    root = render_sequence(
        route,
        variation or own_variation,
        cache_folder(),
        until=until,
        threads=threads,
        on_frame=on_frame,
    )
    source = open_kitti(
        root, route_name, start=start, every=every, max_frames=max_frames, monocular=monocular
    )
    imu = None
    if has_imu(name):
        imu = simulated_imu(route, (variation or own_variation).seed)
    # The path of a motion, and with it the first pose, depends on the seed.
    world = name if route_name in MOTIONS else route_name
    return replace(source, dataset="synthetic", name=name, world=world, imu=imu)
