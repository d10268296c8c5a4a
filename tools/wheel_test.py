"""Build the wheel, install it into a clean environment and run it from another folder.

What the tests cannot see: files left out of the wheel, dependencies that only the development
environment has, imports that work only in the checkout. The sequence is a textured wall that a
stereo camera passes; shifts are whole pixels, so that its true trajectory is exact.

usage: python tools/wheel_test.py
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, FOCAL, BASELINE = 480, 240, 240.0, 0.5
DISPARITY = 12  # pixels: the wall is 10 m away
FRAMES, STEP = 12, 4  # pixels a frame to the right, and up and down in turn
MAX_ATE_M = 0.02


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command; ends the test with what it said if it fails."""
    start = time.perf_counter()
    done = subprocess.run(list(map(str, command)), cwd=cwd, capture_output=True, text=True)
    shown = " ".join([Path(command[0]).name, *map(str, command[1:4])])
    print(f"wheel test: {time.perf_counter() - start:5.1f} s  {shown}", flush=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}wheel test: failed (exit code {done.returncode})")
    return done.stdout


def write_sequence(root: Path) -> None:
    """KITTI's layout, sequence 00 with ground truth."""
    noise = np.random.default_rng(0).uniform(0, 255, (HEIGHT + 60, WIDTH + 120)).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.0, 3.0))
    wall = np.clip(128 + 2.0 * (fine - 128) + 4.0 * (coarse - 128), 0, 255).astype(np.uint8)
    depth = FOCAL * BASELINE / DISPARITY
    folder = root / "sequences" / "00"
    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True)
    poses = []
    for k in range(FRAMES):
        x, y = STEP * k, 20 + STEP * (k % 4)
        for side, shift in (("image_0", 0), ("image_1", DISPARITY)):
            view = wall[y : y + HEIGHT, x + shift : x + shift + WIDTH]
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), view)
        T_wc = np.eye(4)
        T_wc[:2, 3] = np.array([x, y - 20]) * depth / FOCAL
        poses.append(" ".join(map(str, T_wc[:3].ravel())))
    (root / "poses").mkdir()
    (root / "poses" / "00.txt").write_text("\n".join(poses) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(FRAMES)))
    rows = (
        f"P{side}: {FOCAL} 0 {WIDTH / 2} {offset} 0 {FOCAL} {HEIGHT / 2} 0 0 0 1 0\n"
        for side, offset in enumerate((0.0, -FOCAL * BASELINE))
    )
    (folder / "calib.txt").write_text("".join(rows))


def check_run(folder: Path) -> None:
    """The files are there and the figures right."""
    wanted = (
        "report.json report.md report.html config.json map.npz recording.rrd "
        "trajectory_kitti.txt trajectory.tum keyframes.tum"
    )
    files = [folder / name for name in wanted.split()]
    missing = [file.name for file in files if not (file.is_file() and file.stat().st_size)]
    report = json.loads((folder / "report.json").read_text())
    lost, ate = report["lost_frames"], report["ate_rmse_m"]
    print(f"wheel test: {report['frames']} frames, {lost} lost, ATE {ate:.4f} m, limit {MAX_ATE_M}")
    if missing or report["frames"] != FRAMES or lost or ate > MAX_ATE_M:
        sys.exit(f"wheel test: failed; missing or empty: {missing or 'nothing'}")


def main() -> None:
    os.environ.pop("PYTHONPATH", None)
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # old builds' files would be packed
    with tempfile.TemporaryDirectory(prefix="vslam-wheel-") as name:
        scratch = Path(name)
        pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
        run(*pip, "wheel", "--no-deps", "--wheel-dir", scratch, ROOT, cwd=scratch)
        (wheel,) = scratch.glob("vslam-*.whl")
        venv.create(scratch / "env", with_pip=True)
        binaries = scratch / "env" / "bin"
        constraints = ROOT / "constraints.txt"
        run(binaries / "pip", "install", "--quiet", wheel, "-c", constraints, cwd=scratch)
        write_sequence(scratch / "kitti")

        vslam = binaries / "vslam"
        if "run" not in run(vslam, "--help", cwd=scratch):
            sys.exit("wheel test: failed; vslam --help does not name its commands")
        print(run(vslam, "info", "--data", scratch / "kitti", cwd=scratch))
        if "100000" not in run(vslam, "vocabulary", "info", cwd=scratch):
            sys.exit("wheel test: failed; the vocabulary of 100000 words is not in the wheel")
        run(vslam, "run", "--data", scratch / "kitti", "--perturb", "brightness:0.5", cwd=scratch)
        check_run(scratch / "runs" / "latest")
    print("wheel test: ok")


if __name__ == "__main__":
    main()
