"""Run ORB-SLAM3 (pyorbslam3) on a job that drives.py has written.

    python orbslam3.py VOCABULARY JOB.npz OUT.npz

This script runs in the interpreter of ORB-SLAM3, and imports nothing of vslam. Images are passed at
the pace of the camera. ``IMU.fastInit`` is on: without it, a smooth motion never starts the IMU.
"""

import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pyorbslam3

SETTINGS = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: {camera[0]}
Camera.fy: {camera[1]}
Camera.cx: {camera[2]}
Camera.cy: {camera[3]}
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: {camera[4]:.0f}
Camera.height: {camera[5]:.0f}
Camera.fps: {fps:.0f}
Camera.bf: {camera[6]}
Camera.RGB: 1
ThDepth: {far}
IMU.NoiseGyro: {noise[0]}
IMU.NoiseAcc: {noise[1]}
IMU.GyroWalk: {noise[2]}
IMU.AccWalk: {noise[3]}
IMU.Frequency: 200
IMU.fastInit: 1
DepthMapFactor: 1.0
Tbc: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [{Tbc}]
ORBextractor.nFeatures: 1200
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -3.5
Viewer.ViewpointF: 500.0
"""


CENTIMETRES = 100.0  # of depth images, in a metre


def main(vocabulary: str, job_file: str, out: str) -> None:
    job = np.load(job_file)
    times, samples, imu = job["times"], job["samples"], bool(job["imu"])
    T_imu_camera = job["T_imu_camera"]
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", delete=False) as file:
        file.write(
            SETTINGS.format(
                camera=job["camera"], noise=job["noise"], fps=1.0 / np.median(np.diff(times)),
                far=40.0 if job["camera"][3] < 130 else 60.0,
                Tbc=", ".join(f"{x:.9f}" for x in T_imu_camera.ravel()),
            )
        )  # fmt: skip
    sensor = str(job["sensor"])
    kind = {"stereo": "STEREO", "mono": "MONOCULAR", "rgbd": "RGBD"}[sensor]
    kind = getattr(pyorbslam3.Sensor, f"IMU_{kind}" if imu else kind)
    slam = pyorbslam3.Slam(vocabulary, file.name, kind, use_viewer=False)
    live = np.full((len(times), 4, 4), np.nan)
    began, before = time.time(), times[0] - 1.0
    for k, t in enumerate(times):
        left, right = (cv2.imread(str(job[side][k]), -1) for side in ("left", "right"))
        if job["dark"][k]:
            left, right = np.zeros_like(left), np.zeros_like(right)
        time.sleep(max(0.0, began + t - times[0] - time.time()))
        new = samples[(samples[:, 0] > before + 1e-6) & (samples[:, 0] <= t + 1e-6)]
        before = t
        rows = shifted(new) if imu else None
        if sensor == "mono":
            result = slam.track_monocular(left, t + 1.0, rows)
        elif sensor == "rgbd":
            metres = (right / CENTIMETRES).astype(np.float32)
            result = slam.track_rgbd(left, metres, t + 1.0, rows)
        else:
            result = slam.track_stereo(left, right, t + 1.0, rows)
        if result.pose_valid:
            live[k] = result.pose_wc
    slam.shutdown()
    final = np.full_like(live, np.nan)
    trajectory = Path(tempfile.mkdtemp()) / "trajectory.csv"
    try:
        slam.save_trajectory_euroc(str(trajectory))
        rows = [line.replace(",", " ").split() for line in trajectory.read_text().splitlines()]
    except (OSError, RuntimeError):
        rows = []  # nothing was tracked
    for row in rows:
        values = [float(x) for x in row]
        k = int(np.abs(times + 1.0 - values[0] * 1e-9).argmin())
        final[k] = pose(values[1:]) @ (T_imu_camera if imu else np.eye(4))
    np.savez(out, live=live, final=final)


def shifted(samples: np.ndarray) -> np.ndarray:
    """Return the samples one second later, because ORB-SLAM3 takes no times of zero."""
    later = samples.copy()
    later[:, 0] += 1.0
    return later


def pose(values: list) -> np.ndarray:
    """Return the pose of a position and a quaternion x, y, z, w."""
    x, y, z, w = np.array(values[3:]) / np.linalg.norm(values[3:])
    T = np.eye(4)
    T[:3, 3] = values[:3]
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return T


if __name__ == "__main__":
    main(*sys.argv[1:])
