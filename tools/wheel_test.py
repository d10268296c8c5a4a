"""Build the wheel, install it into a clean environment and run it from another folder.

This finds errors that the tests cannot find: files that are missing in the wheel, dependencies that
only the development environment has, and imports that work only in the checkout. vslam is run on
the first frames of a rendered drive, whose ground truth is exact.

Each Python of ``--python`` gets its own environment. With ``--runners``, the wheel is also started
using pipx and uvx, if they are installed.

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

ROOT = Path(__file__).resolve().parent.parent
FRAMES = 12
MAX_ATE_M = 0.02


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command and return its output. If the command fails, print the output and exit."""
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


def check_run(folder: Path) -> None:
    """Check a run: all files exist, no frame is lost, and the ATE is small."""
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
    run(python, "-m", "venv", scratch / "env", cwd=scratch)
    binaries = scratch / "env" / "bin"
    pip = binaries / "pip"
    constraints = ("-c", ROOT / "constraints.txt")
    run(pip, "install", "--quiet", wheel, *constraints, cwd=scratch)
    if "torch" in run(pip, "list", cwd=scratch):
        sys.exit("wheel test: failed; a plain installation has torch, which only training needs")

    vslam = binaries / "vslam"
    if "run" not in run(vslam, "--help", cwd=scratch):
        sys.exit("wheel test: failed; vslam --help does not list its commands")
    print(run(vslam, "info", cwd=scratch))
    if "100000" not in run(vslam, "vocabulary", "info", cwd=scratch):
        sys.exit("wheel test: failed; the vocabulary of 100000 words is not in the wheel")
    run(
        vslam, "run", "--dataset", "synthetic", "--seq", "block", "--max-frames", str(FRAMES),
        "--perturb", "brightness:0.5", cwd=scratch, VSLAM_CACHE=str(scratch / "towns"),
    )  # fmt: skip
    check_run(scratch / "runs" / "latest")


def try_runners(wheel: Path, scratch: Path) -> None:
    """Start vslam using ``pipx run`` and ``uvx``. They install the wheel into their own folders."""
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
        version = run(
            command, *words, cwd=scratch, PIP_CONSTRAINT=constraints, UV_CONSTRAINT=constraints,
            PIPX_HOME=str(scratch / "pipx"), UV_CACHE_DIR=str(scratch / "uv"),
            PIPX_DEFAULT_PYTHON=sys.executable, UV_PYTHON=sys.executable,
        )  # fmt: skip
        print(f"wheel test: {name} starts vslam {version.strip()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters to try")
    parser.add_argument("--runners", action="store_true", help="also try pipx and uvx")
    options = parser.parse_args()
    if missing := [python for python in options.python if shutil.which(python) is None]:
        sys.exit(f"wheel test: {', '.join(missing)}: not installed; install it or leave it out")
    os.environ.pop("PYTHONPATH", None)
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # it would be packed into the wheel
    with tempfile.TemporaryDirectory(prefix="vslam-wheel-") as name:
        scratch = Path(name)
        pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
        run(*pip, "wheel", "--no-deps", "--wheel-dir", scratch, ROOT, cwd=scratch)
        (wheel,) = scratch.glob("vslam-*.whl")
        for number, python in enumerate(options.python):
            (scratch / str(number)).mkdir()
            print(f"wheel test: {run(python, '--version', cwd=scratch).strip()}", flush=True)
            try_environment(python, wheel, scratch / str(number))
            shutil.rmtree(scratch / str(number))  # each environment takes a gigabyte
        if options.runners:
            try_runners(wheel, scratch)
    print("wheel test: ok")


if __name__ == "__main__":
    main()
