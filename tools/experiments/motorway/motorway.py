r"""Measure why the scale of a stereo drive is wrong: errors of disparity and matching, offset.

    python tools/experiments/motorway/motorway.py errors 01 --frames 10:200:8 \
        --csv docs/research/motorway.csv
    python tools/experiments/motorway/motorway.py offset runs/latest

``errors`` extracts features of a rendered route with exact depth and poses. It measures the error
of each disparity, and that of the best match in the next frame along the motion (positive away from
the principal point) and across it, in pixels of the feature's octave. ``offset`` adjusts the
finished map of a run with all disparities shifted and prints the shift that fits best, which needs
no ground truth, and the scale of the keyframes if there is ground truth.
"""

from __future__ import annotations

import argparse
import csv
import itertools
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import take_snapshot
from vslam.camera import Camera
from vslam.config import Config
from vslam.datasets.synthetic.camera_effects import sensor_image
from vslam.datasets.synthetic.passes import Passes
from vslam.datasets.synthetic.render import Renderer
from vslam.datasets.synthetic.routes import Route, built_in_route
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.town import build_town
from vslam.frontend.orb import extract
from vslam.frontend.stereo import match_stereo
from vslam.geometry import inverse, inverses
from vslam.maps.storage import load_map
from vslam.trajectory import read_kitti_poses

ZOOMS = (1.0, 1.07, 1.14, 1.22, 1.35)  # depth before over depth after
WINDOW = 4.0  # half width, in px of the octave, of the window in which a match is searched
MOST_BITS = 50
FLAT = 0.15  # largest relative range of depth around a feature with a clear depth
OFFSETS = (-0.2, -0.1, 0.0, 0.1, 0.2)
SIGMA = 1.4826  # ratio of the standard deviation of Gaussian noise to its median absolute error
SET_BITS = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)


class Seen(NamedTuple):
    """Features of a rendered pair: ``xy``, ``octave``, ``disparity`` (NaN without a match),
    ``descriptors``, true ``depth`` (0: sky), and whether that is ``clear`` around the feature."""

    xy: NDArray[np.float64]
    octave: NDArray[np.uint8]
    disparity: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    depth: NDArray[np.float64]
    clear: NDArray[np.bool_]


class Drive:
    """A route that is rendered with its depth."""

    def __init__(self, route: Route) -> None:
        town = build_town(route, Variation())
        self.route = route
        self._passes = Passes(route, town, Variation())
        self._renderer = Renderer(route.camera, town.atlas, town.sky, 2)

    def see(self, frame: int) -> Seen:
        route, moment = self.route, self._passes.at(frame)
        views = self._renderer.stereo(
            moment.surfaces, moment.shadows, moment.light, route.T_wc[frame], moment.pools
        )
        yaw_rate = float(route.yaw_rate[frame])
        left, right = (
            extract(
                sensor_image(
                    view.image, route.camera, yaw_rate=yaw_rate, night=moment.night,
                    key=(0, frame, side),
                ),
                Config().orb,
            )
            for side, view in enumerate(views)
        )  # fmt: skip
        u_right = match_stereo(left, right, route.camera, Config().stereo)
        near = np.where(views[0].depth > 0, 1.0 / np.maximum(views[0].depth, 1e-3), 0.0)
        around = np.ones((7, 7), np.uint8)
        spread = (cv2.dilate(near, around) - cv2.erode(near, around)) / np.maximum(near, 1e-9)
        column, row = np.rint(left.xy).astype(int).T
        return Seen(
            left.xy.astype(np.float64),
            left.octave,
            left.xy[:, 0].astype(np.float64) - u_right,
            left.descriptors,
            views[0].depth[row, column].astype(np.float64),
            (spread[row, column] < FLAT) & (views[0].depth[row, column] > 0),
        )


def disparity_errors(seen: Seen, camera: Camera) -> NDArray[np.float64]:
    """``(N, 2)`` octave, and error in pixels of the octave, of features with a clear depth."""
    known = seen.clear & np.isfinite(seen.disparity)
    error = seen.disparity[known] - camera.bf / seen.depth[known]
    return np.column_stack([seen.octave[known], error / 1.2 ** seen.octave[known]])


def motion_errors(
    one: Seen, two: Seen, T_2_1: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
    """``(N, 4)`` change of octave, zoom, and errors along and across the motion, in pixels of the
    second octave."""
    points = camera.backproject(one.xy, one.depth) @ T_2_1[:3, :3].T + T_2_1[:3, 3]
    depth = np.maximum(points[:, 2], 0.1)
    expected = camera.project(np.column_stack([points[:, :2], depth]))[:, :2]
    scale = 1.2 ** two.octave.astype(np.float64)
    bits = SET_BITS[one.descriptors[:, None] ^ two.descriptors[None]].sum(axis=2, dtype=np.int64)
    away = np.linalg.norm(expected[:, None] - two.xy[None], axis=2)
    bits[away > WINDOW * scale] = 300
    best = bits.argmin(axis=1)
    hit = np.flatnonzero(one.clear & (depth > 1.0) & (bits.min(axis=1) < MOST_BITS))
    best = best[hit]
    ray = expected[hit] - [camera.cx, camera.cy]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    error = (two.xy[best] - expected[hit]) / scale[best, None]
    along = (error * ray).sum(axis=1)
    across = error[:, 1] * ray[:, 0] - error[:, 0] * ray[:, 1]
    rise = two.octave[best].astype(int) - one.octave[hit]
    return np.column_stack([rise, one.depth[hit] / depth[hit], along, across])


def errors(name: str, frames: range, path: Path) -> None:
    """Write the table of both kinds of errors."""
    drive = Drive(built_in_route(name))
    camera, stereo, motion = drive.route.camera, [], []
    for frame in frames:
        one, two = drive.see(frame), drive.see(frame + 1)
        T_2_1 = inverse(drive.route.T_wc[frame + 1]) @ drive.route.T_wc[frame]
        stereo.append(disparity_errors(one, camera))
        motion.append(motion_errors(one, two, T_2_1, camera))
    by_octave, by_zoom = np.concatenate(stereo), np.concatenate(motion)
    rows: list[tuple[str, str, int, float, float]] = []
    for octave in range(8):
        rows.append(_row("disparity", f"octave {octave}", by_octave[by_octave[:, 0] == octave, 1]))
    for rise in (0, 1, 2):
        for low, high in itertools.pairwise(ZOOMS):
            here = by_zoom[
                (by_zoom[:, 0] == rise) & (by_zoom[:, 1] >= low) & (by_zoom[:, 1] < high)
            ]
            where = f"octave +{rise} zoom {low} to {high}"
            rows.append(_row("along the motion", where, here[:, 2]))
            rows.append(_row("across the motion", where, here[:, 3]))
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("error of", "where", "features", "mean_px", "sigma_px"))
        writer.writerows(
            (*row[:3], f"{row[3]:+.3f}", f"{row[4]:.3f}") for row in rows if row[2] >= 20
        )


def _row(what: str, where: str, error: NDArray[np.float64]) -> tuple[str, str, int, float, float]:
    error = error[np.abs(error) < 2.5]
    if not len(error):
        return what, where, 0, 0.0, 0.0
    sigma = SIGMA * float(np.median(np.abs(error - np.median(error))))
    return what, where, len(error), float(error.mean()), sigma


def offset(folder: Path) -> None:
    """Print the cost and the scale of the map of a run for each offset, and the best one."""
    stored = load_map(folder / "map.npz")
    snapshot = take_snapshot(stored.map, stored.camera)
    times = np.array([stored.map.timestamps[k] for k in snapshot.keyframes])
    known = (folder / "ground_truth_kitti.txt").exists()
    first = adjust_globally(snapshot.problem, iterations=15)
    start = replace(snapshot.problem, T_cw=first.T_cw, points=first.points)
    print("| offset, px | cost | scale |\n|---|---|---|")
    costs = []
    for shift in OFFSETS:
        uvr = start.uvr.copy()
        uvr[:, 2] -= shift
        solved = adjust_globally(replace(start, uvr=uvr), iterations=25, use=first.inlier)
        scale = "-"
        if known:
            centres = inverses(solved.T_cw)[:, :3, 3]
            scale = f"{scale_of(centres, true_positions(folder, times)):.4f}"
        print(f"| {shift:+.2f} | {solved.cost:.1f} | {scale} |", flush=True)
        costs.append(solved.cost)
    bend, slope, _ = np.polyfit(OFFSETS, costs, 2)
    print(f"\nbest {-0.5 * slope / bend:+.3f} px, sigma {1.0 / np.sqrt(2.0 * bend):.3f} px")


def scale_of(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Scale of Umeyama's alignment of ``(N, 3)`` positions."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    turned = a @ (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return float((b * turned).sum() / (a * a).sum())


def true_positions(folder: Path, timestamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """True positions of keyframes, by their times."""
    times = np.loadtxt(folder / "trajectory.tum")[:, 0]
    frames = np.abs(times[None] - timestamps[:, None]).argmin(axis=1)
    return read_kitti_poses(folder / "ground_truth_kitti.txt")[frames, :3, 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    asked = commands.add_parser("errors")
    asked.add_argument("route")
    asked.add_argument("--frames", default="10:200:8", help="first:end:step")
    asked.add_argument("--csv", type=Path, required=True)
    asked = commands.add_parser("offset")
    asked.add_argument("run", type=Path, help="folder of a stereo run")
    options = parser.parse_args()
    if options.command == "errors":
        errors(options.route, range(*map(int, options.frames.split(":"))), options.csv)
    else:
        offset(options.run)


if __name__ == "__main__":
    main()
