"""Data sets: each reader checks its input once and then hands out calibrated, timed frames."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Several
from pathlib import Path

from vslam import plugins
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import Stream
from vslam.errors import InputError, did_you_mean

_FIRST = "00"  # KITTI's, and the town rendered after it
DATASETS = ("kitti", "euroc", "tum", "synthetic")  # those that `open_sequence` knows


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
) -> Sequence:
    """Open a sequence and check the frames that ``start``, ``every``, ``max_frames`` select.

    Without a ``name`` it is 00 of KITTI and of the rendered towns, and of EuRoC and TUM the one at
    ``root``, which must be the only one.

    With ``monocular`` the left camera is read alone. ``calib`` names calibration files
    (docs/howto/cameras.md) to be used instead of the data set's own; images are rectified by them.
    ``depth_scale``, what depth images count in a metre, is for RGB-D data alone.

    A reader of another package (docs/howto/plugins.md) is named as a data set is.

    A synthetic sequence has no ``root``: it is rendered into the user's cache on first use, and
    ``on_render`` is told the frames done and in all.

    Raises:
        InputError: unknown data set, a broken package, or bad input as the reader says.
    """
    if dataset == "kitti":
        from vslam.datasets.kitti import open_kitti, open_kitti_images

        name = _FIRST if name is None else name
        if not calib:
            return open_kitti(
                root, name, start=start, every=every, max_frames=max_frames, monocular=monocular
            )
        from vslam.calibration.files import read_calibration
        from vslam.datasets.rectified import rectified

        images = open_kitti_images(
            root, name, start=start, every=every, max_frames=max_frames, monocular=monocular
        )
        return rectified(images, read_calibration(calib, images.size))
    if dataset == "euroc":
        from vslam.datasets.euroc import open_euroc

        return open_euroc(
            root,
            name,
            start=start,
            every=every,
            max_frames=max_frames,
            monocular=monocular,
            calib=calib,
        )
    if dataset == "tum":
        from vslam.datasets.tum import open_tum

        return open_tum(
            root,
            name,
            start=start,
            every=every,
            max_frames=max_frames,
            monocular=monocular,
            calib=calib,
            depth_scale=depth_scale,
        )
    if dataset == "synthetic" and calib:
        raise InputError("--calib: a rendered town has its own cameras; leave it out.")
    if dataset == "synthetic":
        from vslam.datasets.synthetic import open_synthetic

        return open_synthetic(
            _FIRST if name is None else name,
            start=start,
            every=every,
            max_frames=max_frames,
            monocular=monocular,
            on_frame=on_render,
        )
    source = open_plugin_source(
        dataset, root, name, start=start, every=every, max_frames=max_frames, monocular=monocular,
        calib=calib,
    )  # fmt: skip
    if isinstance(source, Stream):
        raise InputError(
            f"--dataset {dataset}: a stream, whose length nobody knows, which only 'vslam run', "
            "'vslam doctor' and 'vslam bench' read."
        )
    return source


def open_plugin_source(
    dataset: str,
    root: Path | str,
    name: str | None,
    *,
    start: int,
    every: int,
    max_frames: int | None,
    monocular: bool,
    calib: Several[Path | str],
) -> Sequence | Stream:
    """What a reader of another package opens.

    Raises:
        InputError: unknown data set, a broken package, or bad input as the reader says.
    """
    others = plugins.find_plugins(plugins.READERS)
    if dataset not in others:
        known = (*DATASETS, *others)
        raise InputError(
            f"--dataset {dataset}: unknown data set{did_you_mean(dataset, known)}; this version "
            f"reads {', '.join(known)}."
        )
    if calib:
        raise InputError(f"--calib: {others[dataset]} brings its own; leave it out.")
    from vslam.datasets.plugin_reader import open_plugin

    return open_plugin(
        others[dataset],
        Path(root),
        name,
        start=start,
        every=every,
        max_frames=max_frames,
        monocular=monocular,
    )


def known_datasets() -> tuple[str, ...]:
    """All that `open_sequence` knows: vslam's own and those of other packages."""
    return (*DATASETS, *plugins.find_plugins(plugins.READERS))
