"""Checks whether the map of a single camera can begin with the first images of a sequence."""

from __future__ import annotations

import numpy as np

from vslam.config import Config
from vslam.datasets.frames import Source
from vslam.doctor.findings import Finding
from vslam.frontend.extraction import checked_images
from vslam.frontend.initialization import angles_after_rotation, match_views
from vslam.method.starter import Starter
from vslam.support.errors import UnreadableImageError, counted
from vslam.types.context import Context
from vslam.types.track import Track

_FRAMES = 60  # number of the first frames that are examined
_STANDS_DEG = 0.2  # the median feature of a camera that hardly moves turns less, in degrees
_SIDEWAYS = "begin with a motion sideways, not with a turn; earlier frames get their poses then"


def examine_start(sequence: Source, config: Config) -> Finding:
    """Try to begin a monocular map with the first frames, as a run does. If none begins, the
    verdict is unknown, because later frames may begin one."""
    context = Context.create(sequence.camera, config)
    starter, seen = Starter(context), list[Track]()
    for frame in range(min(len(sequence), _FRAMES)):
        try:
            left, _ = sequence.read(frame)
        except UnreadableImageError:  # another check reports the image
            continue
        extracted = checked_images(left, None, None, context).extracted
        timestamp = float(sequence.timestamps[frame])
        seen.append(Track(frame, timestamp, np.eye(4)).with_features(extracted))
        if (start := starter.offer(seen[-1], None)) is not None:
            seconds = start.second.timestamp - float(sequence.timestamps[0])
            one, two = start.first.index, start.second.index
            measured = f"the map can begin with frames {one} and {two}, after {seconds:.2f} s"
            return Finding("start", "good", measured)
    measured = f"no map begins in the first {counted(len(seen), 'frame')}"
    return Finding("start", "unknown", f"{measured}{_reason(seen, context)}", _SIDEWAYS)


def _reason(seen: list[Track], context: Context) -> str:
    """Say why two frames that are as far apart as allowed begin no map."""
    if len(seen) < 2:
        return ""
    latest = seen[0].timestamp + context.config.initialization.max_seconds
    last = [track for track in seen if track.timestamp <= latest][-1]
    pair = match_views(seen[0].features, last.features, context)
    if len(pair[0]) < context.config.initialization.min_matches:
        return f": frames 0 and {last.index} have only {counted(len(pair[0]), 'common feature')}"
    xy_1, xy_2 = (
        track.features.xy[features].astype(np.float64)
        for track, features in zip((seen[0], last), pair, strict=True)
    )
    moved = np.degrees(np.median(np.linalg.norm(xy_2 - xy_1, axis=1)) / context.camera.fx)
    if moved < _STANDS_DEG:
        return ": the camera hardly moves"
    left = np.degrees(np.median(angles_after_rotation(xy_1, xy_2, context.camera)))
    if left < _STANDS_DEG:
        return ": the camera hardly moves except that it turns"
    return ": what it sees allows several motions"
