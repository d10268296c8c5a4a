"""A map in the form that other programs use: images with poses, points, and observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera
from vslam.types.geometry import inverses
from vslam.types.map import Map

# Coordinates of the centre of the upper left pixel in formats whose pixel coordinates begin at the
# corner of the image. In vslam this centre is (0, 0).
PIXEL_CENTRE = 0.5


@dataclass(frozen=True)
class Reconstruction:
    """The K keyframes, L landmarks and N observations of a map, without culled entries. Keyframes
    and landmarks are numbered without gaps. All observations are features of left images.

    Attributes:
        camera: camera of all keyframes. The centre of the upper left pixel is (0, 0), as in OpenCV.
        frames: ``(K,)`` int64, index of the frame that became each keyframe.
        timestamps: ``(K,)`` float64 seconds.
        T_cw: ``(K, 4, 4)`` float64 poses (world to camera).
        xyz: ``(L, 3)`` float64 positions in the world frame. Each landmark is observed at least
            once.
        keyframe, landmark: ``(N,)`` int64, the index of the keyframe and the index of the landmark
            of each observation. Observations are sorted by keyframe.
        xy: ``(N, 2)`` float64 position of each observation in the image, in pixels.
    """

    camera: Camera
    frames: NDArray[np.int64]
    timestamps: NDArray[np.float64]
    T_cw: NDArray[np.float64]
    xyz: NDArray[np.float64]
    keyframe: NDArray[np.int64]
    landmark: NDArray[np.int64]
    xy: NDArray[np.float64]

    @property
    def T_wc(self) -> NDArray[np.float64]:
        """``(K, 4, 4)`` float64 poses of the keyframes (camera to world)."""
        return inverses(self.T_cw)

    def observations_of(self, keyframe: int) -> slice:
        first, last = np.searchsorted(self.keyframe, [keyframe, keyframe + 1])
        return slice(int(first), int(last))

    def reprojection_errors(self) -> NDArray[np.float64]:
        """Return the ``(N,)`` reprojection errors of the observations, in pixels."""
        T_cw = self.T_cw[self.keyframe]
        p_c = np.einsum("nij,nj->ni", T_cw[:, :3, :3], self.xyz[self.landmark]) + T_cw[:, :3, 3]
        return np.linalg.norm(self.camera.project(p_c)[:, :2] - self.xy, axis=1)


def reconstruction_of(map_: Map, camera: Camera) -> Reconstruction:
    """Extract the keyframes of a map that were not culled, and the landmarks that they observe."""
    a = map_.arrays
    keyframes = map_.living_keyframes()
    rows = np.flatnonzero(a.landmark[: map_.n_rows] >= 0)
    landmarks, landmark = np.unique(a.landmark[rows], return_inverse=True)
    return Reconstruction(
        camera=camera,
        frames=map_.frames[keyframes],
        timestamps=map_.timestamps[keyframes],
        T_cw=a.T_cw[keyframes],
        xyz=a.xyz[landmarks],
        keyframe=np.searchsorted(keyframes, a.keyframe[rows]).astype(np.int64),
        landmark=landmark.astype(np.int64),
        xy=a.xy[rows].astype(np.float64),
    )
