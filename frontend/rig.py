"""Corrects the measurements of a stereo rig for errors that remain after rectification.

The first error is a common offset of all disparities. It is estimated while the map grows
(``backend/disparity_offset.py``). The second error is the delay of the right image. The calibration
file gives this delay (``Camera.right_delay``). The delay is also measured, but the measured value
is only reported.
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
from vslam.frontend.sides import with_pair
from vslam.geometry import Matrix
from vslam.image_motion import columns_without_delay
from vslam.states import ComparedSides, RigState


class RigCalibration:
    """Corrects the measurements of a stereo rig for an offset of all disparities and for the delay
    of the right image.

    After stereo matching, only this class changes the columns of the features in the right image
    (``u_right``).

    Attributes:
        disparity_offset: offset that is added to every measured disparity, in pixels. The owner of
            the map sets it each time that a mapped keyframe is merged.
        offset_sigma: standard deviation of ``disparity_offset``, in pixels. The owner of the map
            sets both at the same time.
        delay: the measured delay of the right image.
        sides: a summary of how the exposures of the left and the right images differed.
        problems: one message for each frame whose right image could not be read.
    """

    def __init__(self, camera: Camera, config: StereoConfig, scales: NDArray[np.float64]) -> None:
        """Args:
        scales: ``(levels,)`` pyramid scale factors."""
        self.disparity_offset, self.offset_sigma = 0.0, 0.0
        self.delay = SideDelay(camera, config)
        self.sides = ComparedSides()
        self.problems: list[str] = []
        self._camera = camera
        self._scales = scales

    def extract(self, frame: Frame, twist: Matrix | None) -> None:
        """Extract the features of a frame, unless this has already been done, and correct them with
        ``prepare``. The difference in exposure between its two images is recorded."""
        source = frame.source
        frame.extract(self._camera)
        if source is not None and source.sides is not None:
            self.sides = with_pair(self.sides, source.sides)
        if source is not None and source.problem is not None:
            self.problems.append(
                f"Frame {frame.index} has only its left image: {source.problem.rstrip('.')}."
            )
        self.prepare(frame, twist)

    def prepare(self, frame: Frame, twist: Matrix | None) -> None:
        """Correct the columns of a frame's features in the right image (``u_right``) for the
        disparity offset and for the delay of the right image.

        The delay is corrected only if the motion is known. A second call does not apply a
        correction again.

        Args:
            twist: ``(6,)`` velocity of the camera, see ``Frame.twist``; None if unknown.
        """
        self.correct_offset(frame)
        delay = self._camera.right_delay
        if frame.delay_removed or twist is None or delay == 0.0:
            return
        xy, u_right = frame.features.xy, frame.features.u_right
        u_right = columns_without_delay(xy, u_right, twist, delay, self._camera)
        frame.features = replace(frame.features, u_right=u_right)
        frame.delay_removed = True

    def correct_offset(self, frame: Frame) -> None:
        """Replace the disparity offset that was applied to a frame earlier with the current
        offset."""
        change = self.disparity_offset - frame.disparity_offset
        if change == 0.0:
            return
        u_right = shifted_columns(frame.features.u_right, frame.features.xy[:, 0], change)
        frame.features = replace(frame.features, u_right=u_right)
        frame.disparity_offset = self.disparity_offset

    def mark_corrected(self, frame: Frame) -> None:
        """Mark a frame that was restored from a checkpoint as corrected. It was corrected before it
        was saved."""
        frame.disparity_offset, frame.delay_removed = self.disparity_offset, True

    def observe(self, frame: Frame, twist: Matrix | None) -> None:
        """Update the measured delay of the right image with a tracked frame.

        Args:
            twist: ``(6,)`` mean velocity since the previous frame, see ``Frame.twist``; None if
                unknown.
        """
        self.delay.add(frame.features, frame.row_offset, twist, self._scales)

    def state(self) -> RigState:
        """Return the measurements so far, for a map file or a checkpoint. The disparity offset is
        not included, because it is part of the map."""
        return RigState(self.delay.state().numbers(), self.sides)

    def restore(self, state: RigState) -> None:
        """Restore the measurements that ``state`` returned.

        Raises:
            ValueError: the stored state is damaged.
        """
        self.delay.restore(DelayState.of_numbers(state.delay))
        self.sides = state.sides
