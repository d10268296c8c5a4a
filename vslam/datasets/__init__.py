"""Data sets: each reader checks its input once and then hands out calibrated, timed frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from vslam.datasets.sequence import Sequence
from vslam.errors import InputError


def open_sequence(
    dataset: str,
    root: Path,
    name: str,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    on_render: Callable[[int, int], None] | None = None,
) -> Sequence:
    """Open a sequence and check the frames that ``start``, ``every``, ``max_frames`` select.

    With ``monocular`` the left camera is read alone.

    A synthetic sequence has no ``root``: it is rendered into the user's cache on first use, and
    ``on_render`` is told the frames done and in all.

    Raises:
        InputError: unknown data set, or bad input as the reader of the data set says.
    """
    if dataset == "kitti":
        from vslam.datasets.kitti import open_kitti

        return open_kitti(
            root, name, start=start, every=every, max_frames=max_frames, monocular=monocular
        )
    if dataset == "synthetic":
        from vslam.datasets.synthetic import open_synthetic

        return open_synthetic(
            name,
            start=start,
            every=every,
            max_frames=max_frames,
            monocular=monocular,
            on_frame=on_render,
        )
    raise InputError(
        f"--dataset {dataset}: unknown data set; this version reads kitti and synthetic."
    )
