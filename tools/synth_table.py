"""Write docs/results.md: vslam, and a peer if given, on rendered routes, clean and perturbed.

    python tools/synth_table.py --out docs/results.md [--routes 05,00] [--again vslam] \
        [--peer PYTHON,RUN_ORBSLAM3.py,VOCABULARY]

Renders what is missing first. Finished rows are kept in a JSON file beside the table and not
measured again unless the bytes of the routes changed or ``--again`` names their system; the table
is always written whole. The peer's script takes VOCABULARY SEQUENCE OUT [--brightness SEED] and
prints one JSON object with ``lost`` and ``fps``; its brightness law is its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from vslam.datasets.synthetic import (
    ROUTES,
    Variation,
    built_in_route,
    cache_folder,
    render_sequence,
    store,
)
from vslam.evaluate import evaluate, read_pair

LIGHTS, PEER = ("clean", "brightness"), "ORB-SLAM3"
HEAD = """# Results on rendered routes

Written by `python tools/synth_table.py`; one run each, ATE after SE3 alignment. vslam ran without
loop closing, ORB-SLAM3 with it. The two systems have each their own brightness law. Load: of the
machine (mean of five minutes) at the end of the run; above the number of cores the fps are low.

| route | frames | path m | light | system | lost | ATE m | ATE % of path | t_rel % | fps | load |
|---|---|---|---|---|---|---|---|---|---|---|
"""
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--routes", default="demo,00,01,02,03,04,05")
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"))
    parser.add_argument("--peer", default="")
    parser.add_argument("--again", default="", help="systems to measure again")
    options = parser.parse_args()
    kept = _read(options.out)
    rows = {key: row for key, row in kept.items() if row["system"] not in options.again.split(",")}
    for name in options.routes.split(","):
        route = built_in_route(name)
        root = render_sequence(route, Variation(), cache_folder())
        for light in LIGHTS:
            if f"{name} {light} vslam" not in rows:
                row = _row(name, root, light, "vslam", _run_vslam(root, name, light))
                rows[f"{name} {light} vslam"] = row
                _write(options.out, rows)
            if options.peer and f"{name} {light} {PEER}" not in rows:
                row = _row(
                    name, root, light, PEER, _run_peer(root, name, light, options.peer.split(","))
                )
                rows[f"{name} {light} {PEER}"] = row
                _write(options.out, rows)
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


def _row(name: str, root: Path, light: str, system: str, run: tuple[Path, int, float]) -> Row:
    estimate, lost, fps = run
    trajectory, truth = read_pair(estimate, root / "poses" / f"{name}.txt", None)
    found = evaluate(trajectory, truth, "se3")
    steps = truth.T_wc[1:, :3, 3] - truth.T_wc[:-1, :3, 3]
    return {
        "route": name,
        "frames": len(truth),
        "path": float(np.linalg.norm(steps, axis=1).sum()),
        "light": light,
        "system": system,
        "lost": lost,
        "ate": float(found.ate_rmse_m),
        "t_rel": found.t_rel_percent,
        "fps": fps,
        "bytes": store.VERSION,
        "load": os.getloadavg()[1],
    }


def _line(row: Row) -> str:
    drift = "-" if row["t_rel"] is None else f"{row['t_rel']:.3f}"
    return (
        f"| {row['route']} | {row['frames']} | {row['path']:.0f} | {row['light']} "
        f"| {row['system']} | {row['lost']} | {row['ate']:.3f} "
        f"| {100 * row['ate'] / row['path']:.3f} | {drift} | {row['fps']:.1f} "
        f"| {row['load']:.0f} |\n"
    )


def _read(out: Path) -> dict[str, Row]:
    """Finished rows that belong to the bytes that are rendered now."""
    try:
        rows = json.loads(out.with_suffix(".json").read_text())
    except FileNotFoundError:
        return {}
    return {key: row for key, row in rows.items() if row["bytes"] == store.VERSION}


def _write(out: Path, rows: dict[str, Row]) -> None:
    wanted = [f"{n} {light} {s}" for n in ROUTES for light in LIGHTS for s in ("vslam", PEER)]
    missing = sorted({key.split()[0] for key in wanted if key not in rows})
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    out.write_text(
        HEAD
        + "".join(_line(rows[key]) for key in wanted if key in rows)
        + (f"\nNot complete yet: {', '.join(missing)}.\n" if missing else "")
    )


if __name__ == "__main__":
    main()
