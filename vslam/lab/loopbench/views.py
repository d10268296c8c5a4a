"""Render the left images of some frames of a drive, for tests of loop detectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vslam.datasets.synthetic.files import check_disk, frame_files, write, writing
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.store import OnFrame, render_frames
from vslam.trajectory import write_kitti


def render_views(
    route: Route,
    variation: Variation,
    root: Path,
    frames: Sequence[int],
    *,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> None:
    """Render the left images of some frames into a tree in KITTI's layout, unless they exist.

    The images are identical to those of `render_sequence`. Poses and times of the whole drive are
    written, too. The file of poses is written last, so that it exists only if all images do.

    Args:
        route: the drive.
        variation: appearance of the town.
        root: root of the tree, which must not be used for other routes or variations.
        frames: frame numbers, ascending.
        threads: number of threads of the renderer.
        on_frame: called with the number of finished frames and the number of all frames.

    Raises:
        InputError: the folder cannot be written, or the disk is too small.
    """
    folder = root / "sequences" / route.name
    files = {k: frame_files(folder, k, depth=False)[0] for k in frames}
    missing = [k for k in frames if not files[k].exists()]
    check_disk(root, len(missing), depth=False)
    with writing(root):
        (folder / "image_0").mkdir(parents=True, exist_ok=True)
        (root / "poses").mkdir(exist_ok=True)
        if missing:
            render_frames(
                route, variation, folder, missing, False, threads, on_frame,
                total=len(files), monocular=True,
            )  # fmt: skip
        write(folder / "times.txt", "".join(f"{t:.6e}\n" for t in route.timestamps).encode())
        write_kitti(root / "poses" / f"{route.name}.txt", route.ground_truth)
