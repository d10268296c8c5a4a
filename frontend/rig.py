"""Corrects the measurements of a stereo rig for errors that remain after rectification.

The first error is a common offset of all disparities. It is estimated while the map grows
(``backend/disparity_offset.py``). The second error is the delay of the right image, which the
calibration file gives (``Camera.right_delay``).
"""

from __future__ import annotations

from dataclasses import replace

from vslam.frontend.sides import with_pair
from vslam.types.camera import Camera
from vslam.types.features import Extracted, shifted_columns
from vslam.types.geometry import Matrix
from vslam.types.image_motion import columns_without_delay
from vslam.types.states import ComparedSides
from vslam.types.track import Track


def corrected(
    extracted: Extracted, offset: float, twist: Matrix | None, camera: Camera
) -> Extracted:
    """Correct the columns of new features in the right image (``u_right``).

    They are corrected for the disparity offset and, if the motion is known, for the delay of the
    right image.

    Args:
        offset: offset that is added to every measured disparity, in pixels
            (``MapView.disparity_offset``).
        twist: ``(6,)`` velocity of the camera, see ``Track.twist``; None if unknown.
    """
    extracted = with_offset(extracted, offset)
    if twist is None or camera.right_delay == 0.0:
        return extracted
    xy, u_right = extracted.features.xy, extracted.features.u_right
    u_right = columns_without_delay(xy, u_right, twist, camera.right_delay, camera)
    return replace(extracted, features=replace(extracted.features, u_right=u_right))


def with_offset(extracted: Extracted, offset: float) -> Extracted:
    """Replace the disparity offset that was applied earlier with another one, in pixels."""
    change = offset - extracted.disparity_offset
    if change == 0.0:
        return extracted
    u_right = shifted_columns(extracted.features.u_right, extracted.features.xy[:, 0], change)
    features = replace(extracted.features, u_right=u_right)
    return replace(extracted, features=features, disparity_offset=offset)


class RigMonitor:
    """Watches a stereo rig: the exposure and the failures of its right camera.

    Attributes:
        sides: a summary of how the exposures of the left and the right images differed.
        problems: one message for each frame whose right image could not be read.
    """

    def __init__(self, sides: ComparedSides | None = None) -> None:
        self.sides = ComparedSides() if sides is None else sides
        self.problems: list[str] = []

    def observe(self, track: Track) -> None:
        """Record what a frame tells about the rig, if its features were extracted."""
        sides, problem = track.extracted.sides, track.extracted.problem
        if sides is not None:
            self.sides = with_pair(self.sides, sides)
        if problem is not None:
            self.problems.append(
                f"Frame {track.index} has only its left image: {problem.rstrip('.')}."
            )
