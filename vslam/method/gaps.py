"""Gaps: stretches of a drive whose poses relative to the world frame were not measured.

When the camera is lost and no place is recognised, a sub-map begins at a predicted pose. Until a
loop joins the sub-map to the rest of the map, nothing has confirmed this prediction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from vslam.backend.similarity_graph import GAP_SCALE
from vslam.method.hypotheses import joined_submaps
from vslam.types.context import Context
from vslam.types.frame_poses import FramePoses
from vslam.types.geometry import inverse, orthonormalised
from vslam.types.loops import LoopEdge
from vslam.types.map import PREDICTED, Map
from vslam.types.odometry import predicted_covariance

_MOST_SENTENCES = 3  # of the same kind


class GapKind(StrEnum):
    """Why the poses of a stretch of frames were not measured relative to the world frame.

    PREDICTED: the camera was lost before the stretch, and its motion was predicted from its
    velocity. UNKNOWN: the camera was lost before the stretch, and its velocity was unknown.
    START: the frames were lost before the camera was tracked for the first time. END: the frames
    were lost or dropped, and the camera was not tracked again.
    """

    PREDICTED = "predicted"
    UNKNOWN = "unknown"
    START = "start"
    END = "end"


@dataclass(frozen=True)
class Gap:
    """A stretch of frames of a drive whose poses relative to the world frame were not measured.

    Attributes:
        kind: why they were not measured.
        first, last: indices of the first and the last frame of the stretch.
        seconds: for how long the camera was not tracked. It is 0 if this is unknown, because the
            camera was lost before the drive.
        sigma_m, sigma_deg: standard deviations of the error of the prediction, in metres (in map
            units for a monocular camera) and degrees. They belong to the first frame after the
            loss, or to the last frame if the camera was not tracked again. None if the motion is
            unknown.
        scale: factor by which the unit of length in the stretch may be wrong relative to the
            earlier frames (one standard deviation). It is 1 if the camera measures the scale.
    """

    kind: GapKind
    first: int
    last: int
    seconds: float
    sigma_m: float | None = None
    sigma_deg: float | None = None
    scale: float = 1.0


def find_gaps(
    map_: Map, closed: Sequence[LoopEdge], frames: FramePoses, context: Context
) -> list[Gap]:
    """Find the gaps of the current drive that no closed loop has bridged, in the order of frames.

    Lost frames between two frames of the same part of the map are not gaps, because the poses
    before and after them were measured in the same map. A drive without any tracked frame has no
    gaps.

    Args:
        frames: poses of the frames of the drive.
    """
    scale = math.exp(GAP_SCALE) if context.camera.monocular else 1.0
    table = frames.table()
    tracked, times = np.flatnonzero(table.tracked), table.timestamp
    if not len(tracked) or not map_.n_keyframes:
        return []
    first, last, newest = int(tracked[0]), int(tracked[-1]), len(times) - 1
    part = joined_submaps(map_, closed)[table.reference[tracked]]  # 0 contains the world frame
    begins = np.flatnonzero(np.diff(part, prepend=-1))
    ends = np.append(begins[1:], len(tracked)) - 1
    gaps: list[Gap] = []
    causes: dict[int, Gap] = {}  # the first gap of each part
    if first > 0:
        gaps.append(Gap(GapKind.START, 0, first - 1, float(times[first] - times[0])))
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        name, stretch = int(part[begin]), (int(tracked[begin]), int(tracked[end]))
        if name == 0:
            continue
        cause = causes.get(name)
        if cause is None:
            keyframe = int(table.reference[stretch[0]])
            before = int(tracked[begin - 1]) if begin else -1
            cause = causes[name] = _gap(map_, keyframe, frames, before, *stretch, scale)
        gaps.append(replace(cause, first=stretch[0], last=stretch[1]))
    if last < newest:
        seconds = float(times[newest] - times[last])
        gaps.append(Gap(GapKind.END, last + 1, newest, seconds, *_deviations(frames, last, newest)))
    return gaps


def _gap(
    map_: Map, keyframe: int, frames: FramePoses, before: int, first: int, last: int, scale: float
) -> Gap:
    """Create the gap before the frame ``first``, which begins a part of the map at a keyframe.

    ``before`` is the last tracked frame before it, or -1.
    """
    restart = map_.keyframes.restart[keyframe]
    if before < 0 or not restart or map_.sessions[keyframe] != map_.scalars.session:
        return Gap(GapKind.UNKNOWN, first, last, 0.0, scale=scale)
    seconds = frames.timestamp(first) - frames.timestamp(before)
    if restart != PREDICTED:
        return Gap(GapKind.UNKNOWN, first, last, seconds, scale=scale)
    deviations = _deviations(frames, before, first)
    return Gap(GapKind.PREDICTED, first, last, seconds, *deviations, scale)


def _deviations(frames: FramePoses, before: int, after: int) -> tuple[float, float]:
    """Return the deviations in metres and degrees of a motion between two frames."""
    T = orthonormalised(frames.pose(after) @ inverse(frames.pose(before)))
    seconds = frames.timestamp(after) - frames.timestamp(before)
    variances = np.diag(predicted_covariance(T, seconds))
    return float(np.sqrt(variances[:3].sum())), float(np.degrees(np.sqrt(variances[3:].sum())))


def sentences(gaps: Sequence[Gap], n_frames: int, unit: str = "m") -> list[str]:
    """Describe gaps in sentences for the user. Only a few gaps are described one by one.

    Args:
        n_frames: number of frames of the drive.
        unit: the unit of length, "m" or "map units".
    """
    inner = [gap for gap in gaps if gap.kind in (GapKind.PREDICTED, GapKind.UNKNOWN)]
    told = [gap for gap in gaps if gap not in inner or len(inner) <= _MOST_SENTENCES]
    lines = [_sentence(gap, n_frames, unit) for gap in told]
    if len(inner) > _MOST_SENTENCES:
        n = sum(gap.last - gap.first + 1 for gap in inner)
        far = [gap.sigma_m for gap in inner if gap.sigma_m is not None]
        most = f" up to {_short(max(far))} {unit} (standard deviation)" if far else ""
        lines.append(
            f"{n} frames in {len(inner)} stretches, the first from frame {inner[0].first} on, hang "
            f"together with the rest by prediction only{most}: the camera was lost before each of "
            "them, and no loop has joined them since; gaps.csv lists them."
        )
    return lines


def _sentence(gap: Gap, n_frames: int, unit: str) -> str:
    one = gap.first == gap.last
    frames = f"Frame {gap.first}" if one else f"Frames {gap.first} to {gap.last}"
    were, their = ("was", "its pose is") if one else ("were", "their poses are")
    if gap.kind == GapKind.START:
        return (
            f"{frames} {were} lost before the camera was tracked for the first time: {their} not "
            f"measured, but copied from frame {gap.last + 1}."
        )
    off = ""
    if gap.sigma_m is not None and gap.sigma_deg is not None:
        off = f"{_short(gap.sigma_m)} {unit} and {gap.sigma_deg:.0f} degrees (standard deviations)"
    if gap.kind == GapKind.END:
        return (
            f"{frames} at the end {were} not tracked: {their} predicted from the last velocity, "
            f"and after {gap.seconds:.1f} s may be off by {off}."
        )
    if gap.last == n_frames - 1 and not one:
        frames = f"All frames from frame {gap.first} on"
    hang = "hangs" if one else "hang"
    scaled = f", and the scale by a factor of {gap.scale:.2f}" if gap.scale != 1.0 else ""
    if gap.kind == GapKind.PREDICTED:
        return (
            f"{frames} {hang} together with the earlier ones by prediction only: the camera was "
            f"lost for {gap.seconds:.1f} s, and no loop has joined the parts since. The prediction "
            f"may be off by {off}{scaled}."
        )
    lost = f"the camera was lost for {gap.seconds:.1f} s, its velocity before was unknown"
    if not gap.seconds:
        lost = "the camera did not recognise a place of the first part of the map"
    return (
        f"{frames} {hang} together with the rest by nothing that was measured: {lost}, and no loop "
        "has joined the parts since. Their relative pose is unknown."
    )


def _short(metres: float) -> str:
    return (
        f"{metres:.0f}" if metres >= 10.0 else f"{metres:.1f}" if metres >= 1 else f"{metres:.2f}"
    )
