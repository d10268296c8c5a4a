"""Run ORB-SLAM3 (``pip install pyorbslam3``) on a folder in KITTI's format.

usage: PYTHON orbslam3.py VOCABULARY FOLDER OUT [--frames N] [--paced]

The folder contains the left images in ``image_0``. It may also contain the right images in
``image_1``, or 16-bit depth images in millimetres in ``depth``. With ``--paced``, images are
tracked no faster than the camera took them. Images of a single camera always are.

The costs of the frame loop are written into ``OUT/costs.json``. Waiting is not counted. The script
imports nothing from vslam, because pyorbslam3 may be installed in another Python environment. The
process ends when its standard input is closed.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
from itertools import pairwise
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
Camera.fps: {fps}
Camera.bf: {bf}
Camera.RGB: 1
ThDepth: 40.0
DepthMapFactor: 1.0
ORBextractor.nFeatures: {features}
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: {contrast}
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


# Number of features and first threshold of FAST, from the settings of ORB-SLAM3 for KITTI and for
# TUM's RGB-D data.
_FEATURES = {"stereo": (2000, 12), "mono": (2000, 12), "rgbd": (1000, 20)}
_SECOND = {"stereo": "image_1", "rgbd": "depth"}  # folder of the second image of a frame


def main(vocabulary: str, folder: Path, out: Path, frames: int | None, paced: bool) -> None:
    """Track the frames of a folder. Write the files that ``vslam_lab.stress.external`` reads.

    Args:
        vocabulary: vocabulary file of ORB-SLAM3.
        folder: folder in KITTI's format.
        out: output folder.
        frames: number of frames, counted from the first frame; None for all frames.
        paced: whether images are tracked no faster than the camera took them.
    """
    import pyorbslam3

    out.mkdir(exist_ok=True)
    sensor = next((s for s, name in _SECOND.items() if (folder / name).is_dir()), "mono")
    names = ["image_0"] if sensor == "mono" else ["image_0", _SECOND[sensor]]
    left, *second = (sorted((folder / name).iterdir())[:frames] for name in names)
    times = np.loadtxt(folder / "times.txt", ndmin=1)[:frames].tolist()
    settings = out / "settings.yaml"
    settings.write_text(_settings(folder, left[0], times, sensor))
    kind = {
        "stereo": pyorbslam3.Sensor.STEREO,
        "mono": pyorbslam3.Sensor.MONOCULAR,
        "rgbd": pyorbslam3.Sensor.RGBD,
    }[sensor]
    slam = pyorbslam3.Slam(vocabulary, str(settings), kind, use_viewer=False)
    track = {
        "stereo": slam.track_stereo,
        "mono": slam.track_monocular,
        "rgbd": slam.track_rgbd,
    }[sensor]
    causal, states, track_ms, waited_s = [], [], [], 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    for *paths, t in zip(left, *second, times, strict=True):
        images = [_read(path) for path in paths]
        if paced or sensor == "mono":
            # Tracking does not wait for mapping. If images arrive faster than from the camera,
            # mapping falls behind, and a monocular run loses track.
            early_s = max(0.0, t - times[0] - (time.perf_counter() - wall))
            time.sleep(early_s)
            waited_s += early_s
        began = time.perf_counter()
        found = track(*images, t)
        track_ms.append(1e3 * (time.perf_counter() - began))
        states.append("OK" if found.state == pyorbslam3.TrackingState.OK else "LOST")
        pose = found.pose_wc if found.pose_valid else None
        if pose is not None:
            causal.append((t, np.asarray(pose, float)))
    wall_s, cpu_s = time.perf_counter() - wall - waited_s, time.process_time() - cpu
    costs = {
        "frames": len(left),
        "fps": len(left) / wall_s,
        "cpu_ms_per_frame": 1e3 * cpu_s / len(left),
        "track_ms_median": float(np.median(track_ms)),
        "track_ms_p95": float(np.percentile(track_ms, 95)),
        "lost": states.count("LOST"),
        "wall_s": wall_s,
        "waited_s": waited_s,
        "cpu_s": cpu_s,
    }
    slam.shutdown()
    tum = out / "trajectory.txt"
    if sensor == "mono":  # ORB-SLAM3 saves only the keyframes of a monocular run
        slam.save_keyframe_trajectory_tum(str(tum))
        tum.write_text("".join(_tum(t, T) for t, T in _moved_with_keyframes(tum, causal)))
    else:
        slam.save_trajectory_tum(str(tum))
    _keep_first_of_each_time(tum)
    (out / "causal.txt").write_text("".join(_tum(t, T) for t, T in causal))
    (out / "states.txt").write_text("\n".join(states))
    (out / "costs.json").write_text(f"{json.dumps(costs)}\n")


def _settings(folder: Path, image: Path, times: list[float], sensor: str) -> str:
    rows = (folder / "calib.txt").read_text().splitlines()
    P0, P1 = (np.array(row.split()[1:], float).reshape(3, 4) for row in rows[:2])
    height, width = _read(image).shape
    features, contrast = _FEATURES[sensor]
    return _SETTINGS.format(
        fx=P0[0, 0], fy=P0[1, 1], cx=P0[0, 2], cy=P0[1, 2], width=width, height=height,
        bf=-P1[0, 3], fps=max(1, round(1 / np.median(np.diff(times)))) if times[1:] else 10,
        features=features, contrast=contrast,
    )  # fmt: skip


def _read(path: Path) -> np.ndarray:
    """Read a grey image, or a depth image as float32 in metres."""
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_ANYDEPTH))
    return image.astype(np.float32) / 1000 if image.dtype == np.uint16 else image


def _moved_with_keyframes(
    keyframes: Path, causal: list[tuple[float, np.ndarray]]
) -> list[tuple[float, np.ndarray]]:
    """Return the poses of all frames, moved with the keyframes that were corrected later.

    A frame keeps its pose relative to the last keyframe before it. Distances are scaled like the
    distance from this keyframe to the next one, because corrections change the scale.
    """
    final = {round(row[0], 3): _pose(row) for row in np.loadtxt(keyframes, ndmin=2)}
    pairs = [(T_wc, final[round(t, 3)]) for t, T_wc in causal if round(t, 3) in final]
    moves = [np.subtract(b, a)[:, :3, 3] for a, b in pairwise(pairs)]
    lengths = [(np.linalg.norm(before), np.linalg.norm(after)) for before, after in moves]
    scales = [after / before if before else 1.0 for before, after in lengths]
    scales += scales[-1:] or [1.0]  # no keyframe follows the last one
    found: list[tuple[float, np.ndarray]] = []
    k = -1
    for t, T_wc in causal:
        k += round(t, 3) in final
        if k >= 0:
            T_kf = np.linalg.inv(pairs[k][0]) @ T_wc
            T_kf[:3, 3] *= scales[k]
            found.append((t, pairs[k][1] @ T_kf))
    return found


def _pose(row: np.ndarray) -> np.ndarray:
    """Return the pose of a row in TUM's format."""
    xyz, w = row[4:7], row[7]
    T_wc = np.eye(4)
    angle = 2 * np.arctan2(np.linalg.norm(xyz), w)
    axis = xyz / (np.linalg.norm(xyz) or 1)
    T_wc[:3, :3], T_wc[:3, 3] = cv2.Rodrigues(angle * axis)[0], row[1:4]
    return T_wc


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
    parser.add_argument("--paced", action="store_true")
    main(**vars(parser.parse_args()))
