"""What is known of a stereo pair beyond its rectification, and how it corrects frames.

Two errors are corrected: the offset of all disparities, which the map learns while it grows
(``backend/disparity_offset.py``), and the delay of the right image that the calibration file gives
(``Camera.right_delay``). A delay is measured as well, but a measured one is only reported.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera
from vslam.config import StereoConfig
from vslam.features import shifted_columns
from vslam.frontend.frame import Frame
from vslam.frontend.side_delay import DelayState, SideDelay
from vslam.geometry import Matrix
from vslam.image_motion import columns_without_delay


class RigCalibration:
    """The corrections of a stereo pair. After stereo matching, nothing else writes the ``u_right``
    of a frame.

    Attributes:
        disparity_offset: pixels to be added to every measured disparity: ``Map.disparity_offset``
            as of the last merge, which the owner of the map sets.
        delay: the measured delay of the right side.
    """

    def __init__(self, camera: Camera, config: StereoConfig, scales: NDArray[np.float64]) -> None:
        """
        Args:
            scales: ``(levels,)`` pyramid scale factors.
        """
        self.disparity_offset = 0.0
        self.delay = SideDelay(camera, config)
        self._camera = camera
        self._scales = scales

    def prepare(self, frame: Frame, twist: Matrix | None) -> None:
        """Correct the columns of a frame's features in the right image for the disparity offset
        and, if the motion is known, for the delay of the right image. Calling it again changes
        nothing.

        Args:
            twist: ``(6,)`` motion of the points past the camera, per second; None if unknown.
        """
        self.correct_offset(frame)
        late = self._camera.right_delay
        if frame.delay_removed or twist is None or late == 0.0:
            return
        xy, u_right = frame.features.xy, frame.features.u_right
        u_right = columns_without_delay(xy, u_right, twist, late, self._camera)
        frame.features = replace(frame.features, u_right=u_right)
        frame.delay_removed = True

    def correct_offset(self, frame: Frame) -> None:
        """Correct the disparities of a frame by the present offset, whatever offset they were
        corrected by before."""
        change = self.disparity_offset - frame.disparity_offset
        if change == 0.0:
            return
        u_right = shifted_columns(frame.features.u_right, frame.features.xy[:, 0], change)
        frame.features = replace(frame.features, u_right=u_right)
        frame.disparity_offset = self.disparity_offset

    def mark_corrected(self, frame: Frame) -> None:
        """Mark the columns of a frame as corrected: it was prepared before it was saved."""
        frame.disparity_offset, frame.delay_removed = self.disparity_offset, True

    def observe(self, frame: Frame, twist: Matrix | None) -> None:
        """Measure the delay in a tracked frame.

        Args:
            twist: ``(6,)`` motion from the frame before to this one, per second; None if unknown.
        """
        self.delay.add(frame.features, frame.row_offset, twist, self._scales)

    def state(self) -> DelayState:
        """What was learned of the rig, except the disparity offset, which the map keeps."""
        return self.delay.state()

    def restore(self, state: DelayState) -> None:
        """Continue from what ``state`` gave."""
        self.delay.restore(state)
