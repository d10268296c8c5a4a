"""Run ORB-SLAM3 (``pip install pyorbslam3``) on a folder in KITTI's format.

usage: PYTHON orbslam3.py VOCABULARY FOLDER OUT [--frames N]

The script prints the costs of its frame loop as a JSON object. It imports nothing from vslam,
because pyorbslam3 may be installed in another Python environment. The process ends when its
standard input is closed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np

_SETTINGS = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: {fx}
Camera.fy: {fy}
Camera.cx: {cx}
Camera.cy: {cy}
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 10
Camera.bf: {bf}
Camera.RGB: 1
ThDepth: 40.0
ORBextractor.nFeatures: 2000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 12
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.6
Viewer.KeyFrameLineWidth: 2.0
Viewer.GraphLineWidth: 1.0
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.7
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -100.0
Viewer.ViewpointZ: -0.1
Viewer.ViewpointF: 2000.0
"""


def main(vocabulary: str, folder: Path, out: Path, frames: int | None) -> None:
    """Track stereo frames. Write ``trajectory.txt``, ``causal.txt`` and ``states.txt``.

    Args:
        vocabulary: vocabulary file of ORB-SLAM3.
        folder: folder in KITTI's format.
        out: output folder.
        frames: number of frames, counted from the first frame; None for all frames.
    """
    import pyorbslam3

    out.mkdir(exist_ok=True)
    left, right = (sorted((folder / f"image_{side}").iterdir())[:frames] for side in (0, 1))
    times = np.loadtxt(folder / "times.txt", ndmin=1)[:frames].tolist()
    rows = (folder / "calib.txt").read_text().splitlines()
    P0, P1 = (np.array(row.split()[1:], float).reshape(3, 4) for row in rows[:2])
    height, width = np.asarray(cv2.imread(str(left[0]), 0)).shape
    settings = out / "settings.yaml"
    settings.write_text(
        _SETTINGS.format(
            fx=P0[0, 0], fy=P0[1, 1], cx=P0[0, 2], cy=P0[1, 2], width=width, height=height,
            bf=-P1[0, 3],
        )
    )  # fmt: skip
    slam = pyorbslam3.Slam(vocabulary, str(settings), pyorbslam3.Sensor.STEREO, use_viewer=False)
    causal, states, track_ms = [], [], []
    wall, cpu = time.perf_counter(), time.process_time()
    for *paths, t in zip(left, right, times, strict=True):
        images = [cv2.imread(str(path), 0) for path in paths]
        began = time.perf_counter()
        found = slam.track_stereo(*images, t)
        track_ms.append(1e3 * (time.perf_counter() - began))
        states.append("OK" if found.state == pyorbslam3.TrackingState.OK else "LOST")
        pose = found.pose_wc if found.pose_valid else None
        if pose is not None:
            causal.append((t, np.asarray(pose, float)))
    costs = {
        "frames": len(left),
        "fps": len(left) / (time.perf_counter() - wall),
        "cpu_ms_per_frame": 1e3 * (time.process_time() - cpu) / len(left),
        "track_ms_median": float(np.median(track_ms)),
        "track_ms_p95": float(np.percentile(track_ms, 95)),
        "lost": states.count("LOST"),
    }
    slam.shutdown()
    tum = out / "trajectory.txt"
    slam.save_trajectory_tum(str(tum))
    _keep_first_of_each_time(tum)
    (out / "causal.txt").write_text("".join(_tum(t, T) for t, T in causal))
    (out / "states.txt").write_text("\n".join(states))
    sys.stdout.write(f"{json.dumps(costs)}\n")


def _keep_first_of_each_time(path: Path) -> None:
    """Remove repeated poses, which ORB-SLAM3 writes for some frames after tracking was lost."""
    by_time: dict[float, str] = {}
    for line in path.read_text().splitlines():
        by_time.setdefault(float(line.split()[0]), line)
    path.write_text("".join(f"{by_time[t]}\n" for t in sorted(by_time)))


def _tum(t: float, T_wc: np.ndarray) -> str:
    rotation = cv2.Rodrigues(T_wc[:3, :3])[0].ravel()
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle else np.zeros(3)
    q = [*(np.sin(angle / 2) * axis), np.cos(angle / 2)]
    return " ".join(f"{x:.9f}" for x in (t, *T_wc[:3, 3], *q)) + "\n"


def _end_with_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("vocabulary")
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int)
    main(**vars(parser.parse_args()))
