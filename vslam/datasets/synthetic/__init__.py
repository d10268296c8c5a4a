"""Rendered towns in KITTI format: long drives with exact ground truth, and nothing to download."""

from __future__ import annotations

from dataclasses import replace

from vslam.datasets.kitti import KittiSequence, open_kitti
from vslam.datasets.synthetic.routes import ROUTES, Route, built_in_route, route_of_poses
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.store import OnFrame, cache_folder, render_sequence

__all__ = [
    "ROUTES",
    "Route",
    "SyntheticSequence",
    "Variation",
    "built_in_route",
    "cache_folder",
    "open_synthetic",
    "render_sequence",
    "route_of_poses",
]


class SyntheticSequence(KittiSequence):
    """A rendered sequence, read from its KITTI tree."""

    @property
    def dataset(self) -> str:
        return "synthetic"


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
) -> SyntheticSequence:
    """Open a built-in route, rendered first where the cache lacks it.

    Raises:
        InputError: unknown route, or as `render_sequence` and `open_kitti`.
    """
    route = built_in_route(name)
    until = None if max_frames is None else start + every * max_frames
    root = render_sequence(
        route,
        variation or Variation(),
        cache_folder(),
        until=until,
        threads=threads,
        on_frame=on_frame,
    )
    found = open_kitti(
        root, name, start=start, every=every, max_frames=max_frames, monocular=monocular
    )
    return SyntheticSequence(**vars(replace(found)))
