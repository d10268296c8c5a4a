"""Measure how level loops leave a map, with and without the gravity that an IMU measured.

    python tools/experiments/inertial/level.py demo 00:850 05:1330 --out level.csv

``ROUTE:N`` are the first N frames of a route. Both runs use the IMU, and close loops with the bag
of words. Without gravity, pose graph and global bundle adjustment see only images.

``tilt_deg`` is the RMS angle between the estimated and the true direction of gravity at the
keyframes, after the first one was put in its place, and ``height_m`` the RMS error of their height.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import numpy as np
from drives import Drive, ate, built_in, drive_of, write_rows

from vslam.datasets.imu import Imu, ImuFeed
from vslam.slam import Slam
from vslam.types.geometry import inverses
from vslam_lab.towns import cache_folder

USERS = ("vslam.backend.pose_graph.gravity_at", "vslam.backend.global_mapping.gravity_at")


def unknown(map_: object, keyframes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what is known of gravity at N keyframes without an IMU."""
    return np.zeros((len(keyframes), 3)), np.zeros(len(keyframes))


def run(drive: Drive) -> Slam:
    slam = Slam(drive.source.camera, detector="bow", imu=drive.imu)
    feed = ImuFeed(Imu("simulated", lambda: drive.samples, drive.imu))
    for frame in drive.source.frames():
        slam.step(*frame.read(map), frame.timestamp, imu=feed.until(frame.timestamp))
    slam.finish()
    return slam


def row_of(name: str, slam: Slam, T_wc_true: np.ndarray, *, level: bool) -> dict[str, object]:
    """Compare a map with true poses, in a world whose y axis points down."""
    keyframes, down = slam.map.living_keyframes(), np.array([0.0, 1.0, 0.0])
    T_wc = T_wc_true[0] @ inverses(slam.map.arrays.T_cw[keyframes])
    true = T_wc_true[slam.map.frames[keyframes]]
    felt = [T[:, :3, :3].transpose(0, 2, 1) @ down for T in (T_wc, true)]
    tilt = np.degrees(np.arccos((felt[0] * felt[1]).sum(axis=1).clip(-1.0, 1.0)))
    height = (T_wc - true)[:, 1, 3]
    return {
        "drive": name,
        "gravity": "yes" if level else "no",
        "loops": len(slam.corrections),
        "tilt_deg": float(np.sqrt(np.mean(tilt**2))),
        "height_m": float(np.sqrt(np.mean(height**2))),
        "ate_m": ate(slam.trajectory().T_wc, T_wc_true),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("routes", nargs="+", metavar="ROUTE[:N]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[31])
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    for one in options.routes:
        name, _, frames = one.partition(":")
        for seed in options.seeds:
            first = slice(int(frames) if frames else None)
            route = built_in(name, seed)
            drive = drive_of(route, seed, options.towns, frames=first)
            for level in (False, True):
                with ExitStack() as stack:
                    if not level:
                        for user in USERS:
                            stack.enter_context(patch(user, unknown))
                    rows.append(row_of(drive.name, run(drive), route.T_wc[first], level=level))
                write_rows(options.out, rows)


if __name__ == "__main__":
    main()
