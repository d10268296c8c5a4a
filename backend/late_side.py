"""A map whose right images turned out to be late: its stereo matches corrected, and adjusted."""

from __future__ import annotations

from collections.abc import Mapping

from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import merge_solution, take_snapshot
from vslam.camera import Camera
from vslam.config import Config
from vslam.geometry import Matrix
from vslam.image_motion import columns_without_delay
from vslam.map import Map


def correct_delay(
    map_: Map, twists: Mapping[int, Matrix], delay: float, camera: Camera, config: Config
) -> None:
    """Take a delay out of the stereo matches of keyframes, and adjust the whole map to them.

    A delay is known after seconds, when the map is small: nothing need go on meanwhile.

    Args:
        twists: ``(6,)`` of each keyframe to be corrected: how points moved past it, per second.
        delay: seconds that the right images are later than the matches say by now.
    """
    a = map_.arrays
    for keyframe, twist in twists.items():
        rows = map_.rows(keyframe)
        a.u_right[rows] = columns_without_delay(a.xy[rows], a.u_right[rows], twist, delay, camera)
    snapshot = take_snapshot(map_, camera)
    iterations = config.loops.global_iterations
    solution = adjust_globally(snapshot.problem, iterations=iterations, tolerance=1e-4)
    merge_solution(map_, snapshot, solution)
