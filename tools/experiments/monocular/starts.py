"""Start monocular maps on rendered drives, and compare the rotation errors with those of stereo.

    python tools/experiments/monocular/starts.py --seeds 81 82 83 --out starts.csv
    python tools/experiments/monocular/starts.py --orbslam3 PYTHON VOCABULARY --out orbslam3.csv

``rpe_deg`` is the RMSE of the rotation from frame to frame, in degrees, over all frames whose pose
the monocular run has found, and ``rpe_deg_stereo`` that of stereo over the same frames. ``ratio``
is the first divided by the second. ``first_s`` is the time of the first keyframe pair, and
``untracked`` the number of frames without a pose at the end. Nothing but these numbers is known of
a drive in which no map begins.

With ``--orbslam3``, the drives are tracked by ORB-SLAM3 with one camera.
"""

from __future__ import annotations

import argparse
import csv
import shlex
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.datasets.frames import Source
from vslam.datasets.kitti import open_kitti
from vslam.datasets.perturbation import Perturbation
from vslam.evaluation.trajectories import ate_rmse
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.geometry import inverses
from vslam.types.trajectory import Trajectory
from vslam_lab.stress import orbslam3
from vslam_lab.stress.external import Poses, call, export_kitti, read_poses
from vslam_lab.towns import Route, Variation, cache_folder, render_sequence, route_named

Float = NDArray[np.float64]

FRAMES = 80
PAN_S = 1.5  # before the camera moves


def part(name: str, seed: int, first_s: float) -> Route:
    """Return FRAMES frames of a built-in route from a time on."""
    route = route_named(name, Variation(seed=seed))
    first = round(first_s * route.rate)
    T_wc = np.ascontiguousarray(route.T_wc[first : first + FRAMES])
    return replace(route, name=f"{name}-{first}-{FRAMES}", T_wc=T_wc)


def hand_held(seed: int) -> Route:
    return part("room" if seed % 2 else "walk", seed, 0.5 * (seed % 7))


def flying(seed: int) -> Route:
    return part("hall" if seed % 2 else "drone", seed, 1.5)


def turning(seed: int, seconds: float) -> Float:
    """Return the ``(N, 3, 3)`` rotations of a camera that looks around."""
    rng = np.random.default_rng([seed, 7])
    t = np.arange(round(20.0 * seconds)) / 20.0
    rate = rng.uniform(0.3, 0.9) * rng.choice([-1.0, 1.0])  # rad/s
    nod = rng.uniform(0.05, 0.15) * np.sin(2.0 * np.pi * t / rng.uniform(1.0, 3.0))
    return Rotation.from_euler("YX", np.column_stack([rate * t, nod])).as_matrix()


def only_panning(seed: int) -> Route:
    """Turn the camera about its optical centre."""
    route = part("room" if seed % 2 else "walk", seed, 0.0)
    T_wc = np.tile(route.T_wc[0], (FRAMES, 1, 1))
    T_wc[:, :3, :3] = T_wc[:, :3, :3] @ turning(seed, FRAMES / route.rate)
    return replace(route, name=f"pan-{route.name}", T_wc=T_wc)


def panning(seed: int) -> Route:
    """Turn the camera about its optical centre, and then move it."""
    route = part("room" if seed % 2 else "walk", seed, 0.0)
    turns = turning(seed, PAN_S)
    n = len(turns)
    T_wc = route.T_wc.copy()
    T_wc[n:] = route.T_wc[: FRAMES - n]
    T_wc[:n] = route.T_wc[0]
    back = turns[-1].T @ turns  # ends at the first pose of the route
    T_wc[:n, :3, :3] = T_wc[:n, :3, :3] @ back
    return replace(route, name=f"pan-then-{route.name}", T_wc=T_wc)


def planar(seed: int) -> Route:
    """Fly above a street and look straight down, or along the wall of a hall."""
    rng = np.random.default_rng([seed, 9])
    route = part("walk", seed, 0.0)
    t = np.arange(FRAMES) / route.rate
    T_wc = route.T_wc.copy()
    level = T_wc[:, :3, 3]
    along = np.linspace(0.0, 1.0, FRAMES)[:, None] * (level[-1] - level[0])
    T_wc[:, :3, 3] = level[0] + along
    heading = np.arctan2(along[-1, 0], along[-1, 2])
    sway = 0.05 * np.sin(2.0 * np.pi * t / rng.uniform(1.0, 2.0))
    angles = np.column_stack([np.full(FRAMES, heading), np.full(FRAMES, -1.35) + sway, 0.5 * sway])
    T_wc[:, :3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
    return replace(route, name=f"planar-{route.name}", T_wc=T_wc)


def forwards(seed: int) -> Route:
    route = route_named("04", Variation(seed=seed))
    camera = route.camera
    centre = {"cx": (camera.cx - 0.5) / 2, "cy": (camera.cy - 0.5) / 2}
    size = {"width": camera.width // 2, "height": camera.height // 2}
    half = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, **centre, **size)
    first = 15 * (seed % 5)
    T_wc = np.ascontiguousarray(route.T_wc[first : first + FRAMES // 2])
    return replace(route, name=f"04-{first}-{FRAMES // 2}", camera=half, T_wc=T_wc)


FAMILIES: dict[str, Callable[[int], Route]] = {
    "hand-held": hand_held, "flying": flying, "panning": panning, "planar": planar,
    "forwards": forwards, "only panning": only_panning,
}  # fmt: skip


def run(source: Source, *, mono: bool) -> Slam:
    camera = source.camera.left_camera() if mono else source.camera
    slam = Slam(camera, detector="none", threads=1)
    for frame in source.frames():
        left, right = frame.read(map)
        slam.step(left, None if mono else right, frame.timestamp)
    slam.finish()
    return slam


def rotation_errors(T_wc: Float, truth: Float) -> Float:
    """Return the ``(N - 1,)`` errors of the rotations from frame to frame, in degrees."""
    found, expected = (inverses(T[:-1]) @ T[1:] for T in (T_wc, truth))
    error = inverses(expected) @ found
    return np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())


def rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def rendered(family: str, seed: int, cache: Path, *, mono: bool) -> tuple[Route, Source]:
    route = FAMILIES[family](seed)
    root = render_sequence(route, Variation(seed=seed), cache)
    return route, open_kitti(root, route.name, monocular=mono)


def row(family: str, seed: int, cache: Path) -> dict[str, object]:
    route, source = rendered(family, seed, cache, mono=False)
    mono = run(source, mono=True)
    known, map_ = mono.tracked(), mono.map
    begun = map_.n_keyframes > 0
    poses = Poses(mono.trajectory().T_wc, known)
    rpe, ate = errors(poses, route) if begun else (np.nan, np.nan)
    stereo = np.nan
    if begun:
        stereo, _ = errors(Poses(run(source, mono=False).trajectory().T_wc, known), route)
    return {
        "family": family, "route": route.name, "seed": seed, "frames": len(route.T_wc),
        "first_s": float(route.timestamps[map_.frames[1]]) if begun else np.nan,
        "untracked": int((~known).sum()), "parts": len({0, *map_.restarts}) if begun else 0,
        "ate_m": ate, "rpe_deg": rpe, "rpe_deg_stereo": stereo, "ratio": rpe / stereo,
    }  # fmt: skip


def errors(poses: Poses, route: Route) -> tuple[float, float]:
    """Return the RMSE of the rotation from frame to frame in degrees, and the ATE in metres after
    a similarity, over the known poses."""
    known, ate = poses.known, np.nan
    both = known[1:] & known[:-1]
    rpe = rms(rotation_errors(poses.T_wc, route.ground_truth)[both])
    if known.sum() > 3:
        times = route.timestamps[known]
        found = Trajectory(times, poses.T_wc[known])
        with suppress(InputError):  # the true poses may all be at one place
            ate = ate_rmse(found, Trajectory(times, route.ground_truth[known]), "sim3")
    return rpe, ate


def orbslam3_row(
    family: str, seed: int, cache: Path, python: str, vocabulary: str
) -> dict[str, object]:
    route, source = rendered(family, seed, cache, mono=True)
    with tempfile.TemporaryDirectory(prefix="orbslam3-") as name:
        images, out = Path(name) / "images", Path(name) / "out"
        kept, _ = export_kitti(source, Perturbation("none"), images)
        words = shlex.join([python, str(orbslam3.__file__), vocabulary])
        call(f"{words} {{folder}} {{out}}", images, out)
        poses = read_poses(out / "trajectory.txt", source.timestamps, kept)
    rpe, ate = errors(poses, route)
    return {
        "family": family, "route": route.name, "seed": seed, "frames": len(route.T_wc),
        "untracked": int((~poses.known).sum()), "ate_m": ate, "rpe_deg": rpe,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(81, 86)))
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--orbslam3", nargs=2, metavar=("PYTHON", "VOCABULARY"))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows = []
    for family in options.families:
        for seed in options.seeds:
            if options.orbslam3:
                rows.append(orbslam3_row(family, seed, options.towns, *options.orbslam3))
            else:
                rows.append(row(family, seed, options.towns))
            print(
                {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in rows[-1].items()},
                flush=True,
            )
    with options.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        for one in rows:
            writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in one.items()})


if __name__ == "__main__":
    main()
