"""Opens sources using plug-ins, which are readers in other Python packages.

The frames of a plug-in are checked in the same way as the frames of vslam's own sources.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vslam.datasets.frames import Images, Source, TimedFrame, selected
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.support.plugins import PlugIn, reason
from vslam.types.camera import Camera, DepthImage, Image, ImageMap


def open_plugin(
    plugin: PlugIn,
    root: Path,
    name: str | None,
    *,
    start: int,
    every: int,
    max_frames: int | None,
    monocular: bool,
) -> Source:
    """Let a plug-in open a source, and select frames of the source.

    A plug-in may also fail later, when a frame is read. If the frames are stored, only this frame
    is skipped. If the source is a stream, the stream ends at this frame.

    Raises:
        InputError: the plug-in rejects its input, fails, or returns no valid `Source`.
        UnreadableImageError: the first frame cannot be read. This is not checked for a stream.
    """
    raw = plugin.call(root, name)
    wrong = _wrong_source(raw)
    if wrong:
        raise InputError(f"{plugin}: {wrong}; repair or uninstall the package.")
    camera = raw.camera.left_camera() if monocular else raw.camera
    checked = partial(_checked, plugin, root, camera)
    source = replace(
        raw,
        dataset=plugin.name,
        camera=camera,
        stored=tuple(checked(frame, f"frame {k}") for k, frame in enumerate(raw.stored)),
        play=None if raw.seekable else partial(_play, plugin, raw, checked),
    )
    source = selected(source, start=start, every=every, max_frames=max_frames)
    if source.seekable:
        source.read(0)
    return source


def _wrong_source(raw: object) -> str:
    """Say why an object that a plug-in returned is not a valid source; empty if it is valid."""
    if not isinstance(raw, Source):
        return f"returned {type(raw).__name__}, not vslam.datasets.frames.Source"
    if not isinstance(raw.camera, Camera):
        return f"camera is {type(raw.camera).__name__}, not vslam.types.camera.Camera"
    if wrong := [frame for frame in raw.stored if not isinstance(frame, TimedFrame)]:
        return f"stored has a {type(wrong[0]).__name__}, not vslam.datasets.frames.TimedFrame"
    n = raw.n_expected
    if n is None or (isinstance(n, int) and n > 0):
        return ""
    return f"n_expected is {n!r}, neither None nor a number of frames"


def _play(plugin: PlugIn, raw: Source, checked: partial[TimedFrame]) -> Iterator[TimedFrame]:
    frames = plugin.guarded(raw.frames)
    while True:
        try:
            frame = next(frames)
            timestamp = float(frame.timestamp)
            found = checked(frame, f"{timestamp:.3f} s")
        except StopIteration:
            return
        except (InputError, BrokenSourceError):
            raise
        except Exception as error:  # other people's packages may raise anything
            raise BrokenSourceError(f"{plugin} failed ({reason(error)}).") from error
        if not np.isfinite(timestamp):
            raise BrokenSourceError(f"{plugin} returned a frame with the time stamp {timestamp} s.")
        yield found


def _checked(plugin: PlugIn, root: Path, camera: Camera, frame: TimedFrame, at: str) -> TimedFrame:
    """Make a frame that checks the images of ``frame`` whenever they are read."""

    def read(image_map: ImageMap) -> Images:
        try:
            left, second = frame.read(image_map)
        except UnreadableImageError:
            raise
        except Exception as error:  # other people's packages may raise anything
            why = f"{plugin} failed at {at} ({reason(error)})."
            raise UnreadableImageError(root, why) from error
        second = None if camera.monocular else second
        if wrong := _wrong_images(left, second, camera):
            raise UnreadableImageError(root, f"{plugin} returned {wrong} at {at}.")
        return left, second

    return replace(frame, read=read, sides=None)


def _wrong_images(left: Image, second: Image | DepthImage | None, camera: Camera) -> str:
    """Describe images whose types or sizes do not match the calibration; empty if they match."""
    kinds: list[np.dtype[Any]] = [np.dtype(np.uint8)]
    if not camera.monocular:
        kinds.append(np.dtype(np.float32 if camera.depth else np.uint8))
    images = [left] if second is None else [left, second]
    found = [(getattr(x, "dtype", None), getattr(x, "shape", None)) for x in images]
    if found == [(kind, (camera.height, camera.width)) for kind in kinds]:
        return ""
    return " and ".join(f"{kind} {shape}" for kind, shape in found)
