"""Rendered towns in KITTI's format: long drives with exact ground truth, without a download."""

from __future__ import annotations

from dataclasses import replace

from vslam.datasets.frames import Source
from vslam.datasets.kitti import open_kitti
from vslam.datasets.synthetic.routes import (
    DRIVES,
    ROUTES,
    Route,
    built_in_route,
    route_of_poses,
)
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.store import OnFrame, cache_folder, render_sequence
from vslam.errors import InputError

__all__ = [
    "DRIVES",
    "ROUTES",
    "Route",
    "Variation",
    "built_in_route",
    "cache_folder",
    "open_synthetic",
    "parse_drive",
    "render_sequence",
    "route_of_poses",
]


def parse_drive(name: str) -> tuple[str, Variation]:
    """Split ``05+change:0.5+moving:6+aliased+seed:1`` into the route's name and the variation.

    A name in `DRIVES` stands for its route and variation, to which further parts may be added.

    Raises:
        InputError: a part of the name is not understood.
    """
    first, plus, further = name.partition("+")
    route, *parts = (DRIVES.get(first, first) + plus + further).split("+")
    town = Variation()
    try:
        for part in parts:
            what, _, value = part.partition(":")
            if what == "change" and 0.0 <= float(value) <= 1.0:
                town = replace(town, change=float(value))
            elif what == "moving" and int(value) >= 0:
                town = replace(town, moving=int(value))
            elif what == "seed" and int(value) >= 0:
                town = replace(town, seed=int(value))
            elif part == "aliased":
                town = replace(town, aliased=True)
            else:
                raise ValueError
    except ValueError:
        raise InputError(
            f"--seq {name}: '{part}' is not understood; after the route only +change:0 to 1, "
            "+moving:CARS, +seed:N and +aliased are allowed."
        ) from None
    return route, town


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
    """Open a built-in route; frames that are not in the cache are rendered first.

    Args:
        name: the route and variation, as for `parse_drive`.
        variation: replaces the variation in the name.
        start, every, max_frames, monocular: as for `open_kitti`.
        threads, on_frame: as for `render_sequence`.

    Raises:
        InputError: the route or the variation is unknown, or as `render_sequence` and `open_kitti`.
    """
    route_name, town = parse_drive(name)
    route = built_in_route(route_name)
    until = None if max_frames is None else start + every * max_frames
    root = render_sequence(
        route,
        variation or town,
        cache_folder(),
        until=until,
        threads=threads,
        on_frame=on_frame,
    )
    found = open_kitti(
        root, route_name, start=start, every=every, max_frames=max_frames, monocular=monocular
    )
    return replace(found, dataset="synthetic", name=name)
