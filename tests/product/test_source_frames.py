"""Frames of stored sources and of streams: selection, first frames, and frames by index."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vslam.datasets.frames import (
    Source,
    TimedFrame,
    first_frames,
    frames_at,
    selected,
    stored_frames,
)
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.camera import Camera

N = 9
CAMERA = Camera(10.0, 10.0, 4.0, 3.0, 0.0, 8, 6)


def image(index: int) -> np.ndarray:
    return np.full((6, 8), index, np.uint8)


def stored() -> Source:
    frames = stored_frames(0.1 * np.arange(N), lambda k, image_map: (image(k), None))
    truth = np.tile(np.eye(4), (N, 1, 1))
    truth[:, 2, 3] = np.arange(N)
    return Source(dataset="drawn", name="x", camera=CAMERA, stored=frames, ground_truth=truth)


def streamed(n_expected: int | None = N) -> Source:
    files = stored()
    return replace(files, stored=(), play=files.frames, n_expected=n_expected, ground_truth=None)


def numbers(source: Source) -> list[int]:
    return [int(frame.read(map)[0][0, 0]) for frame in source.frames()]


@pytest.mark.parametrize("source", [stored(), streamed()])
def test_frames_are_selected_alike(source):
    part = selected(source, start=2, every=3, max_frames=2)
    assert numbers(part) == numbers(part) == [2, 5]
    assert part.n_expected == 2
    assert selected(source, start=2, every=3).n_expected == 3
    with pytest.raises(InputError, match=f"--start {N}: x has (about )?{N} frames"):
        selected(source, start=N)
    with pytest.raises(InputError, match="--every and --max-frames at least 1"):
        selected(source, every=0)


def test_the_ground_truth_is_selected_with_the_frames():
    part = selected(stored(), start=2, every=3)
    assert part.ground_truth[:, 2, 3].tolist() == [2, 5, 8]
    assert part.timestamps.tolist() == pytest.approx([0.2, 0.5, 0.8])


def test_the_length_of_a_stream_may_be_unknown():
    endless = streamed(n_expected=None)
    assert selected(endless, start=1).n_expected is None
    assert selected(endless, max_frames=4).n_expected == 4
    with pytest.raises(InputError, match="x has no such frame"):
        numbers(selected(endless, start=N))


def test_only_stored_frames_can_be_read_in_any_order():
    source = stored()
    assert source.seekable
    assert (len(source), int(source.read(7)[0][0, 0])) == (N, 7)
    stream = streamed()
    assert not stream.seekable
    for use in (len, lambda s: s.read(0), lambda s: s.timestamps):
        with pytest.raises(TypeError, match="only be read in order"):
            use(stream)


@pytest.mark.parametrize("source", [stored(), streamed()])
def test_frames_by_number(source):
    found = [int(frame.read(map)[0][0, 0]) for frame in frames_at(source, [1, 4, 7, N + 3])]
    assert found == [1, 4, 7]


def test_the_first_frames_of_a_stream_stay_in_memory():
    def play():
        for k, frame in enumerate(stored().frames()):
            if k == 4:
                raise BrokenSourceError("x: unplugged.")
            yield replace(frame, read=damaged) if k == 2 else frame

    def damaged(image_map):
        raise UnreadableImageError("x", "damaged.")

    kept = first_frames(replace(streamed(), play=play, live=True))
    assert (kept.seekable, kept.live, len(kept)) == (True, False, 4)
    assert int(kept.read(3)[0][0, 0]) == 3
    with pytest.raises(UnreadableImageError, match="damaged"):
        kept.read(2)
    assert first_frames(stored()).timestamps.tolist() == stored().timestamps.tolist()
    with pytest.raises(InputError, match="x: it has no frames"):
        first_frames(replace(streamed(), play=lambda: iter(())))


@pytest.mark.parametrize("times", [[0.0, 0.0], [0.1, 0.0], [0.0, np.nan]])
def test_stored_times_increase(times):
    frames = tuple(TimedFrame(time, lambda image_map: (image(0), None)) for time in times)
    with pytest.raises(InputError, match="x: the times of the frames do not increase"):
        Source(dataset="drawn", name="x", camera=CAMERA, stored=frames)
