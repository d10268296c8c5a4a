"""Which observations make a finished stereo map too small or too large.

    vslam run --dataset synthetic --seq 01 --max-frames 200 --detector none
    python tools/experiments/motorway/scale_probe.py runs/latest

Global bundle adjustment of the map of a run, again with a part of its stereo observations taken
for monocular ones. Prints the scale that brings the keyframes onto the ground truth (above 1: the
map is too small) and, by depth, how the errors of the disparities are distributed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import GlobalSnapshot, take_snapshot
from vslam.geometry import inverses
from vslam.maps.storage import load_map
from vslam.trajectory import read_kitti_poses

FAR_M = 25.0
DEPTHS_M = (10.0, 20.0, 40.0, 80.0, 200.0)


def scale_of(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """Scale of Umeyama's alignment of ``(N, 3)`` positions, and the RMSE that is left, m."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    turned = a @ (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    scale = float((b * turned).sum() / (a * a).sum())
    return scale, float(np.sqrt(((b - scale * turned) ** 2).sum(axis=1).mean()))


def in_cameras(problem: BundleProblem) -> NDArray[np.float64]:
    """``(O, 3)`` the point of each observation in its camera."""
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    T = problem.T_cw[problem.camera]
    return np.einsum("nij,nj->ni", T[:, :3, :3], problem.points[point]) + T[:, :3, 3]


def true_positions(folder: Path, timestamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of keyframes, by their times."""
    times = np.loadtxt(folder / "trajectory.tum")[:, 0]
    frames = np.abs(times[None] - timestamps[:, None]).argmin(axis=1)
    return read_kitti_poses(folder / "ground_truth_kitti.txt")[frames, :3, 3]


def probe(snapshot: GlobalSnapshot, truth: NDArray[np.float64]) -> None:
    """Print all of it."""
    problem = snapshot.problem
    print("| observations | scale | ATE, Sim3, m |\n|---|---|---|")

    def row(title: str, T_cw: NDArray[np.float64]) -> None:
        scale, rmse = scale_of(inverses(T_cw)[:, :3, 3], truth)
        print(f"| {title} | {scale:.5f} | {rmse:.3f} |")

    row("the map as it is", problem.T_cw)
    first = adjust_globally(problem, iterations=20)
    problem = replace(problem, T_cw=first.T_cw, points=first.points)
    solved = adjust_globally(problem, iterations=20, use=first.inlier)
    row("all, global bundle adjustment", solved.T_cw)
    problem = replace(problem, T_cw=solved.T_cw, points=solved.points)
    depth = in_cameras(problem)[:, 2]
    for title, dropped in (
        (f"stereo within {FAR_M:.0f} m only", depth > FAR_M),
        (f"stereo beyond {FAR_M:.0f} m only", depth < FAR_M),
    ):
        uvr = problem.uvr.copy()
        uvr[dropped, 2] = np.nan
        part = adjust_globally(replace(problem, uvr=uvr), iterations=25, use=solved.inlier)
        row(title, part.T_cw)
    tails(problem, solved.inlier)


def tails(problem: BundleProblem, inlier: NDArray[np.bool_]) -> None:
    """Print how many disparities are off by more than a pixel of their octave, by depth."""
    p = in_cameras(problem)
    expected = problem.intrinsics[4] / p[:, 2]
    u = problem.uvr[:, 0]
    error = (u - problem.uvr[:, 2] - expected) * np.sqrt(problem.inverse_sigma2)
    stereo = np.isfinite(error) & inlier
    print("\n| depth, m | disparities | too large | too small |\n|---|---|---|---|")
    for low, high in zip((0.0, *DEPTHS_M[:-1]), DEPTHS_M, strict=True):
        here = error[stereo & (p[:, 2] >= low) & (p[:, 2] < high)]
        large, small = np.mean(here > 1.0), np.mean(here < -1.0)
        print(f"| {low:.0f} to {high:.0f} | {len(here)} | {large:.1%} | {small:.1%} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a run with ground truth")
    folder = parser.parse_args().run
    stored = load_map(folder / "map.npz")
    map_ = stored.map
    snapshot = take_snapshot(map_, stored.camera)
    times = np.array([map_.timestamps[k] for k in snapshot.keyframes])
    probe(snapshot, true_positions(folder, times))


if __name__ == "__main__":
    main()
