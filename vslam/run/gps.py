"""Georeferences a finished run using GPS fixes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.backend.gps import Anchored, Positions, anchor
from vslam.backend.pose_graph import essential_graph
from vslam.config import PoseGraphConfig
from vslam.datasets.fixes import Fixes, to_enu, to_geodetic
from vslam.maps.stored_map import StoredMap
from vslam.support.errors import InputError
from vslam.types.frame_poses import FrameTable
from vslam.types.geometry import inverses
from vslam.types.trajectory import Trajectory, bridge_gaps

_LONGEST_S = 0.5  # no position is interpolated between two frames with a longer interval


@dataclass(frozen=True)
class GpsTrack:
    """A georeferenced drive, in a local east-north-up frame (ENU).

    Attributes:
        trajectory: poses of the frames (camera to ENU), in metres.
        geodetic: ``(N, 3)`` latitude and longitude (degrees) and altitude (m) of the frames.
        datum: ``(3,)`` latitude, longitude and altitude of the origin of the ENU frame. The origin
            is the first GPS fix.
        visual: ``(N, 3)`` positions of the frames in ENU without GPS, aligned as a whole.
        fixes: ``(M, 3)`` positions of the antenna in ENU. Only fixes that were measured between two
            tracked frames are included.
        antenna: ``(3,)`` position of the antenna in the frame of the camera, in metres.
        anchored: the poses of the keyframes in ENU, and the fixes that were used.
    """

    trajectory: Trajectory
    geodetic: NDArray[np.float64]
    datum: NDArray[np.float64]
    visual: NDArray[np.float64]
    fixes: NDArray[np.float64]
    antenna: NDArray[np.float64]
    anchored: Anchored


def locate(stored: StoredMap, fixes: Fixes, config: PoseGraphConfig) -> GpsTrack:
    """Georeference a finished drive using GPS fixes. The map is not changed.

    Args:
        stored: the map, which contains the poses of the frames of its last drive.

    Raises:
        InputError: fewer than three fixes were measured between tracked frames, or the drive is too
            short.
    """
    stored = stored.compact(copy=False)
    map_, table = stored.map, stored.frames
    if table is None or not map_.n_keyframes:
        raise InputError("the run has no map.")
    growth = map_.keyframes.unit_scale[table.reference] / table.unit_scale
    # The frames of the table are those of the camera as mounted, as in the trajectory.
    T_c_reference = stored.camera.T_mounted_camera @ table.T_c_reference
    T_c_reference[:, :3, 3] *= growth[:, None]
    table = table._replace(T_c_reference=T_c_reference)
    graph = essential_graph(map_, stored.loops, config, driven=True)
    positions, datum = _positions(table, map_.arrays.T_cw[: map_.n_keyframes], fixes)
    metric = not stored.camera.monocular or map_.scalars.metric
    found = anchor(graph, map_.timestamps[: map_.n_keyframes], positions, config, metric=metric)
    trajectory = _in_map(table, inverses(found.T_enu_k), found.scale)
    S, visual = found.S_enu_w, _in_map(table, graph.T_cw).T_wc[:, :3, 3]
    return GpsTrack(
        trajectory=trajectory,
        geodetic=to_geodetic(trajectory.T_wc[:, :3, 3], datum),
        datum=datum,
        visual=visual @ S[:3, :3].T + S[:3, 3],
        fixes=positions.enu,
        antenna=fixes.antenna,
        anchored=found,
    )


def _in_map(
    table: FrameTable, T_kw: NDArray[np.float64], scale: NDArray[np.float64] | None = None
) -> Trajectory:
    """Compute the poses of all frames from the poses of their keyframes.

    The poses of lost frames are interpolated.

    Args:
        T_kw: ``(K, 4, 4)`` poses of the keyframes.
        scale: ``(K,)`` factors by which the translations from a keyframe to its frames are scaled.
    """
    T_ck = table.T_c_reference.copy()
    if scale is not None:
        T_ck[:, :3, 3] *= scale[table.reference, None]
    T_wc = inverses(T_ck @ T_kw[table.reference])
    return bridge_gaps(Trajectory(table.timestamp, T_wc), table.known)


def _positions(
    table: FrameTable, T_kw: NDArray[np.float64], fixes: Fixes
) -> tuple[Positions, NDArray[np.float64]]:
    """Return the GPS fixes that were measured between two tracked frames, and the datum.

    The positions of camera and antenna at the time of a fix are interpolated. They are given in the
    frame of the reference keyframe of the last frame before the fix.
    """
    at = np.searchsorted(table.timestamp, fixes.times, "right") - 1
    at[fixes.times == table.timestamp[-1]] -= 1
    inside = (at >= 0) & (at + 1 < len(table.timestamp))
    before = at.clip(0, max(len(table.timestamp) - 2, 0))
    after = np.minimum(before + 1, len(table.timestamp) - 1)
    elapsed = table.timestamp[after] - table.timestamp[before]
    inside &= table.tracked[before] & table.tracked[after] & (elapsed <= _LONGEST_S)
    if inside.sum() < 3:
        raise InputError(
            f"only {inside.sum()} of the {len(fixes)} GPS fixes lie within the time of tracked "
            "frames; at least three are needed."
        )
    before, after, elapsed = before[inside], after[inside], elapsed[inside]
    share = ((fixes.times[inside] - table.timestamp[before]) / elapsed)[:, None]
    T_wc = _in_map(table, T_kw).T_wc
    centres, levers = (
        (1.0 - share) * at_frames[before] + share * at_frames[after]
        for at_frames in (T_wc[:, :3, 3], T_wc[:, :3, :3] @ fixes.antenna)
    )
    keyframe = table.reference[before]
    R, t = T_kw[keyframe, :3, :3], T_kw[keyframe, :3, 3]
    arm = np.einsum("mij,mj->mi", R, centres) + t
    lever = np.einsum("mij,mj->mi", R, levers)
    geodetic = fixes.geodetic[inside]
    enu, sigma = to_enu(geodetic, geodetic[0]), fixes.sigma[inside]
    return Positions(fixes.times[inside], keyframe, arm, lever, enu, sigma), geodetic[0]
