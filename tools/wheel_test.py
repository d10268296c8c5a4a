"""Build the wheel, install it into a clean environment and run it from another folder.

This finds errors that the tests cannot see: files missing in the wheel, dependencies that only the
development environment has, and imports that work only in the checkout. A stereo camera passes a
textured wall; the image moves by whole pixels, so that the true trajectory is exact.

Each additional Python gets its own environment. With ``--runners``, the wheel is also started by
pipx and uvx, if installed.

usage: python tools/wheel_test.py [--python python3.12 ...] [--runners]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, FOCAL, BASELINE = 480, 240, 240.0, 0.5
DISPARITY = 12  # pixels: the wall is 10 m away
FRAMES, STEP = 12, 4  # pixels per frame to the right, and alternately up and down
MAX_ATE_M = 0.02


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command and return its output; if it fails, print its output and exit."""
    start = time.perf_counter()
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True,
        env=os.environ | environment,
    )  # fmt: skip
    shown = " ".join([Path(command[0]).name, *map(str, command[1:4])])
    print(f"wheel test: {time.perf_counter() - start:5.1f} s  {shown}", flush=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}wheel test: failed (exit code {done.returncode})")
    return done.stdout


def write_sequence(root: Path) -> None:
    """Write sequence 00 in KITTI's layout, with ground truth."""
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
    """Check that all files exist and that the figures are right."""
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


def try_environment(python: str, wheel: Path, scratch: Path) -> None:
    """Install the wheel for a Python, and run it where nothing else of the checkout is."""
    run(python, "-m", "venv", scratch / "env", cwd=scratch)
    binaries = scratch / "env" / "bin"
    pip = binaries / "pip"
    constraints = ("-c", ROOT / "constraints.txt")
    run(pip, "install", "--quiet", wheel, *constraints, cwd=scratch)
    if "torch" in run(pip, "list", cwd=scratch):
        sys.exit("wheel test: failed; a plain installation brings torch, which only training needs")
    write_sequence(scratch / "kitti")

    vslam = binaries / "vslam"
    if "run" not in run(vslam, "--help", cwd=scratch):
        sys.exit("wheel test: failed; vslam --help does not name its commands")
    print(run(vslam, "info", "--data", scratch / "kitti", cwd=scratch))
    if "100000" not in run(vslam, "vocabulary", "info", cwd=scratch):
        sys.exit("wheel test: failed; the vocabulary of 100000 words is not in the wheel")
    run(vslam, "run", "--data", scratch / "kitti", "--perturb", "brightness:0.5", cwd=scratch)
    check_run(scratch / "runs" / "latest")


def try_runners(wheel: Path, scratch: Path) -> None:
    """``pipx run`` and ``uvx``, with folders of their own; both install the wheel by themselves."""
    constraints = str(ROOT / "constraints.txt")
    commands = {
        "uvx": ["--no-python-downloads", "--from", wheel, "vslam", "--version"],
        "pipx": ["run", "--no-cache", "--spec", wheel, "vslam", "--version"],
    }
    for name, words in commands.items():
        beside = Path(sys.executable).with_name(name)
        command = str(beside) if beside.exists() else shutil.which(name)
        if command is None:
            print(f"wheel test: {name} is not installed: not tried")
            continue
        said = run(
            command, *words, cwd=scratch, PIP_CONSTRAINT=constraints, UV_CONSTRAINT=constraints,
            PIPX_HOME=str(scratch / "pipx"), UV_CACHE_DIR=str(scratch / "uv"),
            PIPX_DEFAULT_PYTHON=sys.executable, UV_PYTHON=sys.executable,
        )  # fmt: skip
        print(f"wheel test: {name} starts vslam {said.strip()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="each is tried")
    parser.add_argument("--runners", action="store_true", help="try pipx and uvx, too")
    given = parser.parse_args()
    os.environ.pop("PYTHONPATH", None)
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # old builds' files would be packed
    with tempfile.TemporaryDirectory(prefix="vslam-wheel-") as name:
        scratch = Path(name)
        pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
        run(*pip, "wheel", "--no-deps", "--wheel-dir", scratch, ROOT, cwd=scratch)
        (wheel,) = scratch.glob("vslam-*.whl")
        for number, python in enumerate(given.python):
            (scratch / str(number)).mkdir()
            print(f"wheel test: {run(python, '--version', cwd=scratch).strip()}", flush=True)
            try_environment(python, wheel, scratch / str(number))
            shutil.rmtree(scratch / str(number))  # a gigabyte each
        if given.runners:
            try_runners(wheel, scratch)
    print("wheel test: ok")


if __name__ == "__main__":
    main()
