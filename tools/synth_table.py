"""Write docs/results.md: vslam, and a peer if given, on rendered routes, clean and perturbed.

    python tools/synth_table.py --routes demo,03,04 --out docs/results.md \
        [--peer PYTHON,RUN_ORBSLAM3.py,VOCABULARY]

Renders what is missing first. The peer's script takes VOCABULARY SEQUENCE OUT [--brightness SEED]
and prints one JSON object with ``lost`` and ``fps``; its brightness law is its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from vslam.datasets.synthetic import Variation, built_in_route, cache_folder, render_sequence
from vslam.evaluate import evaluate, read_pair

HEAD = (
    "| route | frames | path m | light | system | lost | ATE m | ATE % of path | t_rel % | fps |\n"
    "|---|---|---|---|---|---|---|---|---|---|\n"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--routes", default="demo,00,01,02,03,04,05")
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"))
    parser.add_argument("--peer", default="")
    options = parser.parse_args()
    rows = []
    for name in options.routes.split(","):
        route = built_in_route(name)
        root = render_sequence(route, Variation(), cache_folder())
        for light in ("clean", "brightness"):
            rows.append(_row(name, root, light, "vslam", _run_vslam(root, name, light)))
            if options.peer:
                peer = options.peer.split(",")
                rows.append(
                    _row(name, root, light, "ORB-SLAM3", _run_peer(root, name, light, peer))
                )
            _write(options.out, rows)


def _run_vslam(root: Path, name: str, light: str) -> tuple[Path, int, float]:
    out = Path(tempfile.mkdtemp())
    words = [sys.executable, "-m", "vslam", "run", "--data", str(root), "--seq", name]
    words += ["--out", str(out), "--quiet", "--no-record"]
    words += ["--perturb", "brightness"] if light == "brightness" else []
    subprocess.run(words, check=True)
    report = json.loads((out / "latest" / "report.json").read_text())
    return out / "latest" / "trajectory_kitti.txt", report["lost_frames"], report["fps"]


def _run_peer(root: Path, name: str, light: str, peer: list[str]) -> tuple[Path, int, float]:
    python, script, vocabulary = peer
    out = Path(tempfile.mkdtemp()) / "peer.kitti"
    words = [python, script, vocabulary, str(root / "sequences" / name), str(out)]
    words += ["--brightness", "5"] if light == "brightness" else []
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    figures = json.loads(said.strip().splitlines()[-1])
    return out, figures["lost"], figures["fps"]


def _row(name: str, root: Path, light: str, system: str, run: tuple[Path, int, float]) -> str:
    estimate, lost, fps = run
    trajectory, truth = read_pair(estimate, root / "poses" / f"{name}.txt", None)
    found = evaluate(trajectory, truth, "se3")
    steps = truth.T_wc[1:, :3, 3] - truth.T_wc[:-1, :3, 3]
    path = float((steps**2).sum(axis=1).__pow__(0.5).sum())
    drift = "-" if found.t_rel_percent is None else f"{found.t_rel_percent:.3f}"
    return (
        f"| {name} | {len(truth)} | {path:.0f} | {light} | {system} | {lost} | "
        f"{found.ate_rmse_m:.3f} | {100 * found.ate_rmse_m / path:.3f} | {drift} | {fps:.1f} |\n"
    )


def _write(out: Path, rows: list[str]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(
        "# Results on rendered routes\n\n"
        "Written by `python tools/synth_table.py`; one run each, ATE after SE3 alignment. "
        "The two systems have each their own brightness law.\n\n" + HEAD + "".join(rows)
    )


if __name__ == "__main__":
    main()
