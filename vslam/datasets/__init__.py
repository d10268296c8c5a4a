"""Readers of data sets. Each reader provides calibrated frames with time stamps.

Each reader checks its input once, before it provides the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from pathlib import Path
from typing import Any

from vslam.datasets.frames import Source
from vslam.support import plugins
from vslam.support.errors import InputError, did_you_mean
from vslam.types.source_options import DATASETS

_DEFAULT_NAME = "00"  # of KITTI and of the rendered towns


def open_sequence(
    dataset: str,
    root: Path | str,
    name: str | None = None,
    *,
    start: int = 0,
    every: int = 1,
    max_frames: int | None = None,
    monocular: bool = False,
    calib: Several[Path | str] = (),
    depth_scale: float | None = None,
    on_render: Callable[[int, int], None] | None = None,
) -> Source:
    """Open a sequence and check the selected frames.

    Args:
        dataset: one of `DATASETS`, or the name of a data set that a plug-in reads.
        root: folder of the data set. It is ignored for rendered towns, which are rendered into the
            user's cache when they are first used.
        name: name of the sequence. None opens sequence 00 of KITTI or of the rendered towns. For
            KITTI raw, EuRoC and TUM, None opens the only sequence in ``root``.
        start, every, max_frames: read the frames ``start``, ``start + every`` and so on, at most
            ``max_frames`` frames.
        monocular: read only the left camera.
        calib: calibration files (docs/howto/cameras.md), which are used instead of the calibration
            in the data set.
        depth_scale: depth image units per metre, for RGB-D data only.
        on_render: called after each rendered frame, with the number of frames rendered so far and
            the total number.

    Raises:
        InputError: the data set is unknown, its plug-in is broken, or the reader rejects the data.
    """
    chosen: dict[str, Any] = {
        "start": start, "every": every, "max_frames": max_frames, "monocular": monocular
    }  # fmt: skip
    if dataset == "kitti":
        from vslam.datasets.kitti import open_kitti

        return open_kitti(root, _DEFAULT_NAME if name is None else name, calib=calib, **chosen)
    if dataset == "kitti_raw":
        from vslam.datasets.kitti_raw import open_kitti_raw

        return open_kitti_raw(root, name, calib=calib, **chosen)
    if dataset == "euroc":
        from vslam.datasets.euroc import open_euroc

        return open_euroc(root, name, calib=calib, **chosen)
    if dataset == "tum":
        from vslam.datasets.tum import open_tum

        return open_tum(root, name, calib=calib, depth_scale=depth_scale, **chosen)
    if dataset == "synthetic":
        if calib:
            raise InputError(
                "--calib: rendered towns have their own calibration; leave the option out."
            )
        open_towns = plugins.laboratory(plugins.TOWNS)["synthetic"]
        return open_towns(_DEFAULT_NAME if name is None else name, on_frame=on_render, **chosen)
    others = plugins.find_plugins(plugins.READERS)
    if dataset not in others:
        known = (*DATASETS, *others)
        raise InputError(
            f"--dataset {dataset}: unknown data set{did_you_mean(dataset, known)}; this version "
            f"reads {', '.join(known)}."
        )
    if calib:
        raise InputError(
            f"--calib: {others[dataset]} has its own calibration; leave the option out."
        )
    from vslam.datasets.plugin_reader import open_plugin

    return open_plugin(others[dataset], Path(root), name, **chosen)
