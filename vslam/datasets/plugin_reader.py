"""Sequences that a reader of another package opens, checked as vslam's own are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.datasets.image_files import select_frames
from vslam.datasets.sequence import Sequence
from vslam.errors import InputError, UnreadableImageError
from vslam.plugins import PlugIn, reason


@dataclass(frozen=True)
class PlugInSequence:
    """The selected frames of what a package has opened; see `Sequence`.

    Attributes:
        raw: as the package opened it.
        frames: ``(N,)`` int64, those selected.
        camera: its own, or the left one of it.
    """

    plugin: PlugIn
    root: Path
    raw: Sequence
    frames: NDArray[np.int64]
    camera: Camera

    @property
    def dataset(self) -> str:
        return self.plugin.name

    @property
    def name(self) -> str:
        return str(self.raw.name)

    @property
    def timestamps(self) -> NDArray[np.float64]:
        return np.asarray(self.raw.timestamps, np.float64)[self.frames]

    @property
    def ground_truth(self) -> NDArray[np.float64] | None:
        truth = self.raw.ground_truth
        return None if truth is None else np.asarray(truth, np.float64)[self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """See `Sequence.read`; whatever fails in the package costs this frame alone."""
        number = int(self.frames[index])
        try:
            left, second = self.raw.read(number, image_map)
        except UnreadableImageError:
            raise
        except Exception as error:  # a package of other people raises what it likes
            raise UnreadableImageError(
                self.root, f"{self.plugin} failed at frame {number} ({reason(error)})."
            ) from error
        second = None if self.camera.monocular else second
        wrong = _wrong_images(left, second, self.camera)
        if wrong:
            raise UnreadableImageError(self.root, f"{self.plugin} gave {wrong} at frame {number}.")
        return left, second


def open_plugin(
    plugin: PlugIn,
    root: Path,
    name: str | None,
    *,
    start: int,
    every: int,
    max_frames: int | None,
    monocular: bool,
) -> PlugInSequence:
    """Let the package open a sequence, and select frames of it.

    Raises:
        InputError: as the reader says; the package is broken, or what it gives is no sequence.
        UnreadableImageError: the first frame cannot be read.
    """
    raw = plugin.call(root, name)
    wrong = plugin.guarded(_wrong_sequence, raw)
    if wrong:
        raise InputError(f"{plugin}: {wrong}; repair or uninstall the package.")
    chosen = select_frames(root, len(raw), start, every, max_frames)
    camera = raw.camera.left_camera() if monocular else raw.camera
    sequence = PlugInSequence(plugin, root, raw, chosen, camera)
    sequence.read(0)
    return sequence


def _wrong_sequence(raw: Sequence) -> str:
    """What is wrong with a sequence; empty if nothing is."""
    for name in ("name", "camera", "timestamps", "ground_truth", "read", "__len__"):
        if not hasattr(raw, name):
            return f"{type(raw).__name__} has no {name}"
    n = len(raw)
    if not isinstance(raw.camera, Camera):
        return f"camera is {type(raw.camera).__name__}, no vslam.camera.Camera"
    times = np.asarray(raw.timestamps, np.float64)
    if times.shape != (n,) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return f"timestamps are not {n} increasing seconds"
    truth = raw.ground_truth
    if truth is not None and np.shape(truth) != (n, 4, 4):
        return f"ground_truth is of shape {np.shape(truth)}, not ({n}, 4, 4)"
    return "" if n else "the sequence has no frame"


def _wrong_images(left: Image, second: Image | DepthImage | None, camera: Camera) -> str:
    kinds: list[np.dtype[Any]] = [np.dtype(np.uint8)]
    if not camera.monocular:
        kinds.append(np.dtype(np.float32 if camera.depth else np.uint8))
    images = [left] if second is None else [left, second]
    found = [(getattr(x, "dtype", None), getattr(x, "shape", None)) for x in images]
    if found == [(kind, (camera.height, camera.width)) for kind in kinds]:
        return ""
    return f"{' and '.join(f'{kind} {shape}' for kind, shape in found)}"
