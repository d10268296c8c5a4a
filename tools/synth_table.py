"""Write docs/research/results/drives.csv: vslam, with and without loop closing, and ORB-SLAM3 on
rendered drives.

    python tools/synth_table.py --routes demo,05 --lights "clean;brightness:1.0" \
        [--kitti KITTI --along 00,07] [--aliased demo:10] [--sensor mono] \
        [--orbslam3-python PY --vocabulary voc.txt]

A drive is a built-in route; ``01/4`` is one with a quarter of its baseline, so that nearly all
points are far. With ``--along`` it has the poses of a KITTI sequence (KITTI/poses/NN.txt) in a
rendered town; with ``--aliased ROUTE:N`` it is a built-in route through N towns of few facades.
What is missing is rendered first. A light is ``clean`` or a perturbation as of ``vslam run
--perturb``. In its place, ``cut:300`` takes 300 frames out, ``black:20`` blackens 20, and
``every:3`` keeps every third frame, so that the camera is three times as fast. Changed images are
written to a folder, and every system reads the same ones. Each finished row is kept in a JSON file
beside the table and is not measured again unless the bytes of the drives changed or ``--again``
names its system. The table is always written whole.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from systems import OrbSlam3, add_orbslam3_options, orbslam3_of, run_over

if TYPE_CHECKING:
    from vslam.datasets.frames import TimedFrame

OURS = {"vslam": "bow", "vslam without loops": "none"}
ORBSLAM3 = "ORB-SLAM3"
GAPS = ("cut", "black")
COLUMNS = {  # of the table: of a row
    "sensor": "sensor",
    "drive": "drive",
    "frames": "frames",
    "path_m": "path_m",
    "lighting": "light",
    "system": "system",
    "lost_frames": "lost",
    "ate_m": "ate_m",
    "ate_percent": "ate_percent",
    "rpe_m": "rpe_m",
    "t_rel_percent": "t_rel",
    "loops_closed": "loops_closed",
    "loops_missed": "loops_missed",
    "loops_wrong": "loops_wrong",
    "keyframes": "keyframes",
    "cpu_ms": "process_cpu_ms",
    "fps": "process_fps",
}
DECIMALS = {"ate_m": 3, "ate_percent": 3, "rpe_m": 4, "t_rel": 3, "process_fps": 1}
Row = dict[str, Any]


class Drive(NamedTuple):
    """A rendered sequence: its title, its KITTI tree, and its name in the tree."""

    title: str
    root: Path
    name: str


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--routes", default="", help="built-in routes, with commas")
    parser.add_argument("--kitti", type=Path, help="KITTI root, for its poses")
    parser.add_argument("--along", default="", help="KITTI sequences whose poses to drive")
    parser.add_argument("--aliased", default="", metavar="ROUTE:N", help="towns of few facades")
    parser.add_argument(
        "--lights", default="clean", help="clean, perturbations, kidnappings; with semicolons"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/research/results/drives.csv"))
    parser.add_argument("--sensor", default="stereo", choices=("stereo", "mono"))
    parser.add_argument("--again", default="", help="systems to measure again, with commas")
    add_orbslam3_options(parser)
    options = parser.parse_args()
    again, orbslam3 = options.again.split(","), orbslam3_of(options)
    kept = {key: row for key, row in _read(options.out).items() if row["system"] not in again}
    for drive in _drives(options):
        for light in options.lights.split(";"):
            # Without loop closing vslam runs once for each drive.
            systems = [*OURS] if light == "clean" and "aliased" not in drive.title else ["vslam"]
            systems += [ORBSLAM3] if orbslam3 else []
            sensor = ", mono" if options.sensor == "mono" else ""
            wanted = {f"{drive.title}, {light}, {system}{sensor}": system for system in systems}
            missing = {key: system for key, system in wanted.items() if key not in kept}
            if not missing:
                continue
            with _in_light(drive, light) as data:
                for key, system in missing.items():
                    kept[key] = _row(
                        drive, light, system, data, options.sensor,
                        orbslam3 if system == ORBSLAM3 else None,
                    )  # fmt: skip
                    _write(options.out, kept)
    _write(options.out, kept)


def _drives(options: argparse.Namespace) -> Iterator[Drive]:
    from vslam.datasets.kitti import read_kitti_poses
    from vslam.datasets.synthetic import Variation, built_in_route, cache_folder, render_sequence
    from vslam.datasets.synthetic.routes import route_of_poses

    cache = cache_folder()
    for name in filter(None, options.routes.split(",")):
        name, _, part = name.partition("/")
        route, title = built_in_route(name), name
        if part:
            camera = replace(route.camera, baseline=route.camera.baseline / int(part))
            route = replace(route, name=f"{name}-short", camera=camera)
            title = f"{name}, 1/{part} of the baseline"
        yield Drive(title, render_sequence(route, Variation(), cache), route.name)
    for name in filter(None, options.along.split(",")):
        calibration = "00-02" if name < "03" else "03" if name == "03" else "04-12"
        poses = read_kitti_poses(options.kitti / "poses" / f"{name}.txt")
        route = route_of_poses(poses, f"kitti{name}", calibration)
        yield Drive(f"along KITTI {name}", render_sequence(route, Variation(), cache), route.name)
    if options.aliased:
        name, count = options.aliased.split(":")
        for seed in range(int(count)):
            variation = Variation(seed, aliased=True)
            root = render_sequence(built_in_route(name), variation, cache)
            yield Drive(f"{name}, aliased town {seed}", root, name)


@contextmanager
def _in_light(drive: Drive, light: str) -> Iterator[Path]:
    """A KITTI tree with the drive's images: unchanged, or changed in a temporary folder.

    ``cut:N`` takes N frames out, a third of the way; ``black:N`` blackens N frames there;
    ``every:N`` keeps every N-th. Anything else is a perturbation of ``vslam run``, with seed 0.
    """
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.datasets.perturbation import parse_perturbation, perturbed
    from vslam.lab.stress.external import write_kitti_frames
    from vslam.trajectory import write_kitti

    if light == "clean":
        yield drive.root
        return
    kind, _, length = light.partition(":")
    every = int(length) if kind == "every" else 1
    sequence = open_sequence("kitti", drive.root, drive.name, every=every)
    gap = range(len(sequence) // 3, len(sequence) // 3 + int(length)) if kind in GAPS else range(0)
    law = "none" if kind in (*GAPS, "every") else light
    frames = list(perturbed(sequence.frames(), parse_perturbation(law, 0).bound_to(sequence)))
    kept = [k for k in range(len(sequence)) if kind != "cut" or k not in gap]

    def shown(k: int) -> TimedFrame:
        if k not in gap:
            return frames[k]
        return replace(frames[k], read=lambda each: [*map(np.zeros_like, frames[k].read(each))])

    with tempfile.TemporaryDirectory(prefix="vslam-drive-") as scratch:
        root = Path(scratch)
        write_kitti_frames(map(shown, kept), sequence.camera, root / "sequences" / drive.name)
        (root / "poses").mkdir()
        write_kitti(root / "poses" / f"{drive.name}.txt", sequence.ground_truth[kept])
        yield root


def _row(
    drive: Drive, light: str, system: str, data: Path, sensor: str, orbslam3: OrbSlam3 | None
) -> Row:
    import numpy as np

    from vslam.datasets.kitti import read_kitti_poses
    from vslam.datasets.synthetic import store
    from vslam.evaluation.trajectories import path_length

    truth = read_kitti_poses(data / "poses" / f"{drive.name}.txt")
    words = ("--no-report", "--detector", OURS[system]) if system in OURS else ()
    run, found = run_over(data, drive.name, orbslam3, *words, sensor=sensor)
    return {
        "drive": drive.title,
        "light": light,
        "system": system,
        "sensor": sensor,
        "frames": len(truth),
        "path_m": float(path_length(truth)[-1]),
        "keyframes": run.report.get("keyframes"),
        **{key: None if np.isnan(value) else value for key, value in found.items()},
        "load": os.getloadavg()[1],
        "bytes": store.VERSION,
    }


def _cells(row: Row) -> list[str]:
    ate = row["ate_m"]
    row = {"sensor": "stereo", **row}
    row["ate_percent"] = None if ate is None else 100 * ate / row["path_m"]

    def shown(key: str) -> str:
        value = row.get(key)
        if value is None or isinstance(value, str):
            return value or ""
        return f"{value:.{DECIMALS.get(key, 0)}f}"

    return [shown(key) for key in COLUMNS.values()]


def _read(out: Path) -> dict[str, Row]:
    """Finished rows that belong to the bytes that are rendered now."""
    from vslam.datasets.synthetic import store

    try:
        rows = json.loads(out.with_suffix(".json").read_text())
    except FileNotFoundError:
        return {}
    return {key: row for key, row in rows.items() if row["bytes"] == store.VERSION}


def _write(out: Path, rows: dict[str, Row]) -> None:
    order = [*OURS, ORBSLAM3]
    lines = sorted(
        rows.values(),
        key=lambda row: (
            row.get("sensor", "stereo") == "mono",
            row["drive"],
            row["light"],
            order.index(row["system"]),
        ),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    with out.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *map(_cells, lines)])


if __name__ == "__main__":
    main()
