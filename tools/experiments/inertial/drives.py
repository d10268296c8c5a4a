"""Rendered drives with an IMU, and runs of vslam and ORB-SLAM3 on them.

A drive may have dark frames, whose images are black. Seeds from 21 on were not used for tuning.
"""

from __future__ import annotations

import csv
import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.kitti import open_kitti
from vslam.slam import Slam
from vslam.types.camera import Camera, Sensor
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse
from vslam.types.imu import ImuCalibration
from vslam_lab.towns import Route, Variation, render_sequence, route_named
from vslam_lab.towns.inertial import imu_on_camera, simulated_imu
from vslam_lab.towns.store import DEPTH_SCALE

Float = NDArray[np.float64]
_CHILD = Path(__file__).with_name("orbslam3.py")


@dataclass(frozen=True, eq=False)
class Drive:
    """N frames of a rendered drive, and its IMU.

    Attributes:
        name: route and seed.
        source: the frames.
        T_wc: ``(N, 4, 4)`` true poses of the left camera.
        samples: ``(M, 7)`` samples of the IMU.
        imu: where the IMU is.
        dark: ``(N,)`` bool, whether the images of a frame are black.
        sensor: which images of the rendered frames are used.
    """

    name: str
    source: Source
    T_wc: Float
    samples: Float
    imu: ImuCalibration
    dark: NDArray[np.bool_]
    sensor: Sensor = "stereo"

    @property
    def times(self) -> Float:
        return self.source.timestamps

    @property
    def camera(self) -> Camera:
        camera = self.source.camera
        if self.sensor == "mono":
            return camera.left_camera()
        return replace(camera, depth=self.sensor == "rgbd")

    def images(self, k: int, frame: TimedFrame) -> tuple[Any, Any]:
        """Return the images of the k-th frame as ``Slam.step`` takes them."""
        left, second = frame.read(map)
        if self.sensor == "mono":
            second = None
        elif self.sensor == "rgbd":
            file = str(frame.file).replace("image_0", "depth_0")
            second = (cv2.imread(file, cv2.IMREAD_UNCHANGED) / DEPTH_SCALE).astype(np.float32)
        if self.dark[k]:
            return np.zeros_like(left), None if second is None else np.zeros_like(second)
        return left, second

    def with_dark(self, frames: NDArray[np.bool_]) -> Drive:
        return replace(self, dark=frames)


@dataclass(frozen=True, eq=False)
class Run:
    """The poses of a run.

    Attributes:
        live: ``(N, 4, 4)`` poses at the time of tracking, in a frame that never jumps. NaN if the
            system gave none.
        final: ``(N, 4, 4)`` poses at the end of the run. NaN for frames without a pose.
        lost: ``(N,)`` bool, whether the system says that the frame has no measured pose.
        gravity: ``(N, 3)`` gravity in the world frame, NaN where it is unknown.
        inertial: ``(N,)`` bool, whether the IMU alone carried the camera.
        gaps: number of places at which the parts of the map are not connected; None if the system
            does not tell.
    """

    live: Float
    final: Float
    lost: NDArray[np.bool_]
    gravity: Float
    inertial: NDArray[np.bool_]
    gaps: int | None = None

    @property
    def parts(self) -> object:
        """The number of parts of the map, empty if it is unknown."""
        return "" if self.gaps is None else self.gaps + 1


def half_size(camera: Camera) -> Camera:
    """Return the camera with half as many pixels in each direction."""
    centre = {"cx": (camera.cx - 0.5) / 2, "cy": (camera.cy - 0.5) / 2}
    size = {"width": camera.width // 2, "height": camera.height // 2}
    return replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, **centre, **size)


def spinning(route: Route, degrees_per_s: float, swing: float) -> Route:
    """Let the camera of a route look left and right by ``swing`` degrees, with a largest rate."""
    angle, rate = np.radians(swing), np.radians(degrees_per_s)
    yaw = angle * np.sin(rate / angle * route.timestamps)
    turns = Rotation.from_euler("Y", yaw[:, None]).as_matrix()
    T_wc = route.T_wc.copy()
    T_wc[:, :3, :3] = T_wc[:, :3, :3] @ turns
    return replace(route, name=f"{route.name}-{degrees_per_s:.0f}", T_wc=T_wc)


def drive_of(
    route: Route,
    seed: int,
    cache: Path,
    *,
    frames: slice = slice(None),
    every: int = 1,
    sensor: Sensor = "stereo",
) -> Drive:
    """Render what is missing of a route, and open some of its frames.

    Args:
        frames: the frames of the route that belong to the drive. Its other frames are not rendered.
        every: use every k-th of them.
    """
    first, last, _ = frames.indices(len(route.T_wc))
    part = replace(
        route, name=f"{route.name}-{first}-{last}", T_wc=np.ascontiguousarray(route.T_wc[frames])
    )
    # The spline through the whole route tells the samples, so that they have no end within it.
    samples = simulated_imu(route, seed).read()
    shift = first / route.rate
    kept = (samples[:, 0] >= shift - 1e-9) & (samples[:, 0] <= shift + part.timestamps[-1] + 1e-9)
    samples = samples[kept]
    samples[:, 0] -= shift
    depth = sensor == "rgbd"
    cache = cache / "depth" if depth else cache
    root = render_sequence(part, Variation(seed=seed), cache, depth=depth)
    source = open_kitti(root, part.name, every=every)
    name = f"{route.name}+seed:{seed}"
    dark = np.zeros(len(source), np.bool_)
    return Drive(name, source, part.ground_truth[::every], samples, imu_on_camera(), dark, sensor)


def built_in(name: str, seed: int) -> Route:
    """Return a built-in route. Towns are rendered at half the size."""
    route = route_named(name, Variation(seed=seed))
    return route if route.free else replace(route, camera=half_size(route.camera))


def run_vslam(drive: Drive, *, imu: bool) -> Run:
    """Run vslam without loop detection, one frame after the other."""
    slam = Slam(drive.camera, imu=drive.imu if imu else None, detector="none", threads=1)
    results, before = [], -np.inf
    for k, frame in enumerate(drive.source.frames()):
        times = drive.samples[:, 0]
        # The first sample at or after the frame is passed, too, as by a run.
        new = drive.samples[(times > before) & (times <= frame.timestamp + 1e-6)]
        before = frame.timestamp + 1e-6
        results.append(
            slam.step(*drive.images(k, frame), frame.timestamp, imu=new if imu else None)
        )
    slam.finish()
    unknown = np.full(3, np.nan)
    gravity = [unknown if one.gravity is None else one.gravity for one in results]
    states = np.array([one.state for one in results])
    lost, inertial = states == TrackingState.LOST, states == TrackingState.INERTIAL
    live = np.array([one.T_odom_camera for one in results])
    final = slam.trajectory().T_wc
    return Run(live, final, lost, np.array(gravity), inertial, len(slam.gaps()))


def run_orbslam3(drive: Drive, *, imu: bool) -> Run:
    """Run ORB-SLAM3 in another interpreter ($ORBSLAM3_PYTHON), at the pace of the camera."""
    camera = drive.source.camera
    root = [frame.file for frame in drive.source.frames()]
    second = "depth_0" if drive.sensor == "rgbd" else "image_1"
    with tempfile.TemporaryDirectory() as folder:
        job, out = Path(folder, "job.npz"), Path(folder, "out.npz")
        np.savez(
            job,
            left=[str(file) for file in root],
            right=[str(file).replace("image_0", second) for file in root],
            times=drive.times, samples=drive.samples, dark=drive.dark, imu=imu,
            sensor=drive.sensor,
            camera=[camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
                    camera.bf],
            T_imu_camera=drive.imu.T_imu_camera,
            noise=[drive.imu.noise.gyro, drive.imu.noise.accel, drive.imu.noise.gyro_walk,
                   drive.imu.noise.accel_walk],
        )  # fmt: skip
        command = [os.environ["ORBSLAM3_PYTHON"], _CHILD, os.environ["ORBSLAM3_VOCABULARY"]]
        subprocess.run([*map(str, command), str(job), str(out)], check=True, capture_output=True)
        found = np.load(out)
    live, final = found["live"], found["final"]
    missing, nothing = np.isnan(final[:, 0, 3]), np.full((len(live), 3), np.nan)
    return Run(live, final, missing, nothing, np.zeros(len(live), np.bool_))


SYSTEMS = {"vslam": run_vslam, "orbslam3": run_orbslam3}


def motion_error(estimate: Float, truth: Float, first: int, last: int) -> tuple[float, float]:
    """Return the error of the motion between two frames, in metres and degrees."""
    found = inverse(estimate[first]) @ estimate[last]
    error = inverse(inverse(truth[first]) @ truth[last]) @ found
    if np.isnan(error).any():
        return np.nan, np.nan
    angle = np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude())
    return float(np.linalg.norm(error[:3, 3])), float(angle)


def ate(estimate: Float, truth: Float) -> float:
    """Return the RMSE of the positions after the best rigid alignment, over frames with a pose."""
    known = ~np.isnan(estimate[:, 0, 3])
    if known.sum() < 3:
        return np.nan
    p, q = estimate[known, :3, 3], truth[known, :3, 3]
    turn, _ = Rotation.align_vectors(q - q.mean(0), p - p.mean(0))
    apart = turn.apply(p - p.mean(0)) - (q - q.mean(0))
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def scale_error(estimate: Float, truth: Float) -> float:
    """Return by how much the best scale of an estimate differs from 1 (Umeyama, 1991)."""
    known = ~np.isnan(estimate[:, 0, 3])
    if known.sum() < 3:
        return np.nan
    p, q = estimate[known, :3, 3], truth[known, :3, 3]
    p, q = p - p.mean(0), q - q.mean(0)
    return float(np.linalg.svd(q.T @ p)[1].sum() / np.sum(p**2) - 1.0)


def rpe(estimate: Float, truth: Float, frames: int) -> tuple[float, float]:
    """Return the RMSE of the motions over a number of frames, in metres and degrees. Both are NaN
    if there are not so many frames."""
    if len(truth) <= frames:
        return np.nan, np.nan
    pairs = [motion_error(estimate, truth, k, k + frames) for k in range(len(truth) - frames)]
    metres, degrees = np.sqrt(np.nanmean(np.square(pairs), axis=0))
    return float(metres), float(degrees)


def write_rows(out: Path, rows: Sequence[dict[str, object]]) -> None:
    """Write a table. Numbers are rounded to 4 significant digits."""

    def text(value: object) -> object:
        return ("" if np.isnan(value) else f"{value:.4g}") if isinstance(value, float) else value

    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: text(value) for key, value in row.items()} for row in rows)
