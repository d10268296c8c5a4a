"""Camera models: pinhole with radial-tangential distortion, and equidistant (Kannala-Brandt).

In the camera frame, x points right, y down and z forward. The centre of the upper left pixel is (0,
0). The formulas are the ones in OpenCV's documentation: ``calib3d`` for radial-tangential
distortion, and ``fisheye`` for equidistant distortion (Kannala and Brandt, PAMI 2006, equation 6).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera
from vslam.types.imu import ImuCalibration, ImuNoise

Array = NDArray[np.float64]
Lens = Literal["pinhole", "fisheye"]

N_COEFFICIENTS: dict[Lens, tuple[int, ...]] = {"pinhole": (0, 4, 5, 8), "fisheye": (4,)}
_NEWTON_STEPS = 30
_OUTWARD = np.linspace(0.0, 1.0, 17)  # fractions of the way from the optical axis to a ray
_SOLVED_PX = 1e-3  # largest distance between a pixel and the projection of its unprojected ray


@dataclass(frozen=True)
class CameraModel:
    """The intrinsic parameters of one camera.

    Attributes:
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        width, height: image size in pixels.
        lens: ``pinhole`` or ``fisheye`` (equidistant).
        distortion: coefficients in OpenCV's order. A pinhole camera has no coefficients, or ``k1 k2
            p1 p2``, or ``k1 k2 p1 p2 k3``, or ``k1 k2 p1 p2 k3 k4 k5 k6``. A fisheye camera has
            ``k1 k2 k3 k4``.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    lens: Lens = "pinhole"
    distortion: tuple[float, ...] = ()

    @property
    def undistorted(self) -> bool:
        """Whether the camera is a pinhole camera without distortion."""
        return self.lens == "pinhole" and not any(self.distortion)


@dataclass(frozen=True)
class Calibration:
    """One camera or a stereo pair, as described by a calibration file.

    Attributes:
        left: the left camera, or the only camera.
        T_left_right: ``(4, 4)`` float64. It maps points from the frame of the right camera to the
            frame of the left camera.
        depth_scale: depth image units per metre; None if the file has none.
        virtual_baseline: baseline in metres that is used to convert depth to disparity; None if the
            file has none.
        right_delay: delay of the right image after the left image, in seconds.
        imu: where the IMU is on the left camera before rectification, and how noisy it is; None if
            the file does not tell where it is.
        imu_noise: noise of the IMU; None if the file does not contain it.
        source: the file or files from which the calibration was read, for error messages.
    """

    left: CameraModel
    right: CameraModel | None = None
    T_left_right: Array | None = None
    depth_scale: float | None = None
    virtual_baseline: float | None = None
    right_delay: float = 0.0
    imu: ImuCalibration | None = field(default=None, compare=False)
    imu_noise: ImuNoise | None = None
    source: str = field(default="the calibration", compare=False)

    @classmethod
    def of_rectified(cls, camera: Camera) -> Calibration:
        """Return the calibration of images that are rectified already."""
        one = CameraModel(
            camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, "pinhole"
        )
        if camera.sensor != "stereo":
            return cls(one, virtual_baseline=camera.baseline if camera.depth else None)
        T_left_right = np.eye(4)
        T_left_right[0, 3] = camera.baseline
        return cls(one, one, T_left_right, right_delay=camera.right_delay)

    def left_alone(self) -> Calibration:
        return replace(self, right=None, T_left_right=None, right_delay=0.0)


def project(model: CameraModel, rays: Array) -> Array:
    """Project ``(N, 3)`` points in the camera frame to ``(N, 2)`` float64 pixels.

    The result is NaN for points that have no projection: points behind a pinhole camera, and points
    on the negative z axis of a fisheye camera.
    """
    x, y, z = rays.T
    if model.lens == "fisheye":
        across = np.hypot(x, y)
        angle = np.arctan2(across, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(across > 0.0, _bent(model.distortion, angle) / across, 1.0)
        scale[(across == 0.0) & (z <= 0.0)] = np.nan
        plane = np.stack([x * scale, y * scale], axis=1)
    else:
        depth = np.where(z > 0.0, z, np.nan)
        plane = _distorted(model.distortion, np.stack([x / depth, y / depth], axis=1))
    return plane * (model.fx, model.fy) + (model.cx, model.cy)


def unproject(model: CameraModel, xy: Array) -> Array:
    """Compute the viewing rays of ``(N, 2)`` pixels, as ``(N, 3)`` float64 unit vectors in the
    camera frame.

    The ray of a pixel is NaN if the distortion cannot be inverted there. This happens if Newton's
    method does not converge. It also happens if the distortion is not monotonic between the
    principal point and the pixel.
    """
    plane = (xy - (model.cx, model.cy)) / (model.fx, model.fy)
    if model.lens == "fisheye":
        radius = np.hypot(*plane.T)
        angle = _unbent(model.distortion, radius)
        with np.errstate(invalid="ignore"):
            along = np.where(radius[:, None] > 0.0, plane / radius[:, None], 0.0)
        rays = np.column_stack([np.sin(angle)[:, None] * along, np.cos(angle)])
    else:
        rays = np.column_stack([_undistorted(model.distortion, plane), np.ones(len(plane))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    off = np.linalg.norm(project(model, rays) - xy, axis=1)
    rays[~(off < _SOLVED_PX)] = np.nan
    return rays


def without_zeros(lens: Lens, distortion: tuple[float, ...]) -> tuple[float, ...]:
    """Remove trailing zeros from distortion coefficients, as far as the lens model allows it."""
    for n in N_COEFFICIENTS[lens]:
        if n <= len(distortion) and not any(distortion[n:]):
            return distortion[:n]
    return distortion


def _distorted(distortion: tuple[float, ...], plane: Array) -> Array:
    if not distortion:
        return plane
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *(0.0,) * (8 - len(distortion)))
    x, y = plane.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def _undistorted(distortion: tuple[float, ...], wanted: Array) -> Array:
    """Invert ``_distorted`` by Newton's method, with a Jacobian from central differences."""
    if not distortion:
        return wanted
    plane = wanted.copy()
    h = 1e-6
    for _ in range(_NEWTON_STEPS):
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            (ax, ay), (bx, by) = (
                (_distorted(distortion, plane + d) - _distorted(distortion, plane - d)).T / (2 * h)
                for d in (np.array([h, 0.0]), np.array([0.0, h]))
            )
            ex, ey = (wanted - _distorted(distortion, plane)).T
            step = np.stack([ex * by - ey * bx, ax * ey - ay * ex], axis=1)
            plane = plane + step / (ax * by - ay * bx)[:, None]
        reach = [np.linalg.norm(_distorted(distortion, k * plane), axis=1) for k in _OUTWARD]
    plane[_folds(reach)] = np.nan
    return plane


def _bent(distortion: tuple[float, ...], angle: Array) -> Array:
    """Return the distance from the principal point to the projection of a ray, in focal lengths.
    ``angle`` is the angle between the ray and the optical axis, in radians."""
    k1, k2, k3, k4 = distortion
    a2 = angle * angle
    return angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))


def _unbent(distortion: tuple[float, ...], radius: Array) -> Array:
    k1, k2, k3, k4 = distortion
    angle = np.minimum(radius, np.pi)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            a2 = angle * angle
            slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
            angle = angle + (radius - _bent(distortion, angle)) / slope
        reach = [_bent(distortion, k * angle) for k in _OUTWARD]
    return np.where(_folds(reach), np.nan, angle)


def _folds(reach: list[Array]) -> NDArray[np.bool_]:
    """Return whether a ray with a larger angle to the optical axis is projected closer to the
    principal point than a ray with a smaller angle.

    Args:
        reach: distances from the principal point to the projections of rays, which are sorted by
            increasing angle to the optical axis.
    """
    return np.any(~(np.diff(reach, axis=0) >= 0.0), axis=0)
