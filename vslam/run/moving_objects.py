"""Warns of frames in which a large part of the image moved against the rest."""

from __future__ import annotations

from collections.abc import Sequence

from vslam.types.features import TrackResult

# In ordinary drives, at most 5 frames in a row have so little support (hand-held walk; KITTI 1).
_LITTLE, _FRAMES = 0.4, 10


def moving_object_warnings(tracks: Sequence[TrackResult]) -> list[str]:
    """Return a warning if most of the landmarks at rest disappeared for some time, because
    something moved in front of the camera or covered it."""
    runs: list[list[TrackResult]] = [[]]
    for track in tracks:
        if track.support is not None and track.support < _LITTLE:
            runs[-1].append(track)
        elif runs[-1]:
            runs.append([])
    long = [run for run in runs if len(run) >= _FRAMES]
    if not long:
        return []
    first, last = long[0][0].index, long[0][-1].index
    more = f" and {len(long) - 1} more times" if len(long) > 1 else ""
    least = min(track.support or 0.0 for run in long for track in run)
    return [
        f"In frames {first} to {last}{more}, a large part of the image moved against the rest or "
        f"was covered: the poses rely on as little as {100 * least:.0f} % of the landmarks that "
        "should be visible."
    ]
