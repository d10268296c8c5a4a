"""Opens drives for tests of loop detectors.

The images of a drive are in the order in which they were taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vslam.support.errors import InputError
from vslam.types.trajectory import write_kitti
from vslam_lab.loopbench.sets import ProgressBar, rendered_route
from vslam_lab.sources.image_source import ImageSource
from vslam_lab.sources.kitti_source import read_kitti
from vslam_lab.sources.source_registry import open_source, split_spec

if TYPE_CHECKING:
    from vslam_lab.towns import Route, Variation
    from vslam_lab.towns.store import OnFrame

_ORDERED = ("kitti", "fabmap")  # kinds of sources whose images are in driving order


def open_drives(
    spec: str, cache: Path, *, threads: int, progress_bar: ProgressBar
) -> list[ImageSource]:
    """Open a drive for tests of loop detectors.

    The left images of a built-in route are rendered on first use. With ``every=10``, only every
    tenth frame is rendered.

    Args:
        spec: ``drive:ROUTE[seed=101,aliased=1,change=0.5,every=10]`` for a built-in route,
            ``kitti:DIR``, or ``fabmap:DIR``.
        cache: folder of rendered towns.

    Raises:
        InputError: ``spec`` does not name a drive, the route or an option is unknown, or the data
            is missing or malformed.
    """
    kind = split_spec(spec)[0]
    if kind in _ORDERED:
        return open_source(spec)
    if kind != "drive":
        raise InputError(
            f"--data {spec}: --protocol online needs drives; give drive:ROUTE, kitti:DIR or "
            "fabmap:DIR."
        )
    from vslam_lab.towns import Variation

    route, given = rendered_route(spec, {"seed": 101, "aliased": 0, "change": 0.0, "every": 10})
    seed, aliased, change, every = given.values()
    if seed < 0 or every < 1 or not 0.0 <= change <= 1.0:
        raise InputError(
            f"--data {spec}: seed must be at least 0, every at least 1 and change from 0 to 1."
        )
    town = Variation(seed, bool(aliased), change)
    return [_rendered(route, town, every, cache, threads=threads, progress_bar=progress_bar)]


def _rendered(
    name: str,
    town: Variation,
    every: int,
    cache: Path,
    *,
    threads: int,
    progress_bar: ProgressBar,
) -> ImageSource:
    from vslam_lab.towns import built_in_route, store

    route = built_in_route(name)
    frames = range(0, len(route.T_wc), every)
    root = store.place_folder(cache) / f"drive-{store.folder_name(town)}-every{every}"
    if not (root / "poses" / f"{name}.txt").exists():
        with progress_bar(f"rendering {root.name} {name}", len(frames)) as advance:
            render_views(
                route, town, root, frames, threads=threads, on_frame=lambda done, of: advance()
            )
    (source,) = read_kitti(root, name, every=str(every))
    kind = "aliased town" if town.aliased else "town"
    changed = f", change {town.change:g}" if town.change else ""
    return replace(source, name=f"{name} in {kind} {town.seed}{changed}")


def render_views(
    route: Route,
    variation: Variation,
    root: Path,
    frames: Sequence[int],
    *,
    threads: int,
    on_frame: OnFrame,
) -> None:
    """Render the left images of some frames into a folder in KITTI's layout.

    Images that already exist are not rendered again. The poses and times of the whole drive are
    also written. The file with the poses is written last. Therefore, this file exists only if all
    images exist.

    Args:
        root: output folder, which must not be used for other routes or variations.
        frames: indices of the frames to render, in ascending order.
        on_frame: called with the number of finished frames and the number of all frames.

    Raises:
        InputError: the folder cannot be written, or the disk is too small.
    """
    from vslam_lab.towns.files import check_disk, frame_files, write, writing
    from vslam_lab.towns.store import render_frames

    folder = root / "sequences" / route.name
    missing = [k for k in frames if not frame_files(folder, k, depth=False)[0].exists()]
    check_disk(root, len(missing), depth=False)
    with writing(root):
        (folder / "image_0").mkdir(parents=True, exist_ok=True)
        (root / "poses").mkdir(exist_ok=True)
        if missing:
            render_frames(
                route, variation, folder, missing, False, threads, on_frame,
                total=len(frames), monocular=True,
            )  # fmt: skip
        write(folder / "times.txt", "".join(f"{t:.6e}\n" for t in route.timestamps).encode())
        write_kitti(root / "poses" / f"{route.name}.txt", route.ground_truth)
