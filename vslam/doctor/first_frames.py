"""The first frames of a stream, kept in memory for access in any order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, ImageMap
from vslam.datasets.sequence import DepthImage, Image
from vslam.datasets.stream import Stream
from vslam.errors import BrokenSourceError, InputError, UnreadableImageError

_FRAMES = 120  # several seconds; a pair of 752x480 images takes 0.7 MB


@dataclass(frozen=True)
class FirstFrames:
    """A :class:`vslam.datasets.sequence.Sequence` of frames in memory; a frame that could not be
    decoded is kept as its error."""

    dataset: str
    name: str
    camera: Camera
    timestamps: NDArray[np.float64]
    frames: tuple[tuple[Image, Image | DepthImage | None] | UnreadableImageError, ...]
    ground_truth: None = None

    def __len__(self) -> int:
        return len(self.frames)

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        """See :meth:`vslam.datasets.sequence.Sequence.read`."""
        frame = self.frames[index]
        if isinstance(frame, UnreadableImageError):
            raise frame
        return frame


def first_frames(stream: Stream) -> FirstFrames:
    """Read frames until there are enough or the stream ends.

    Raises:
        InputError: there is no frame.
    """
    times: list[float] = []
    frames: list[tuple[Image, Image | DepthImage | None] | UnreadableImageError] = []
    problem = "it has no frames"
    try:
        for frame in islice(stream.frames(), _FRAMES):
            times.append(frame.timestamp)
            try:
                frames.append(frame.read(map))
            except UnreadableImageError as error:
                frames.append(error)
    except BrokenSourceError as error:
        problem = str(error).rstrip(".")
    if not frames:
        raise InputError(f"{stream.name}: {problem}; name another source.")
    return FirstFrames(stream.dataset, stream.name, stream.camera, np.array(times), tuple(frames))
