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
    """The corrections of a stereo pair. After stereo matching, only ``prepare`` writes the
    ``u_right`` of a frame.

    Attributes:
        disparity_offset: pixels to be added to every measured disparity. Whoever owns the map sets
            it to ``Map.disparity_offset`` when it merges the map.
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

    def prepare(self, frame: Frame, twist: Matrix | None = None) -> None:
        """Correct the columns of a frame's features in the right image.

        The first call for a frame removes the delay of the right image; a frame whose motion is
        unknown then keeps it. Each call corrects the disparities by the present offset, whatever
        they were corrected by before.

        Args:
            twist: ``(6,)`` motion of the points past the camera, per second; None if unknown. Only
                the first call for a frame uses it.
        """
        xy, u_right = frame.features.xy, frame.features.u_right
        is_new = frame.disparity_offset is None
        change = self.disparity_offset - (frame.disparity_offset or 0.0)
        if change != 0.0:
            u_right = shifted_columns(u_right, xy[:, 0], change)
        late = self._camera.right_delay
        if is_new and twist is not None and late != 0.0:
            u_right = columns_without_delay(xy, u_right, twist, late, self._camera)
        if u_right is not frame.features.u_right:
            frame.features = replace(frame.features, u_right=u_right)
        frame.disparity_offset = self.disparity_offset

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
