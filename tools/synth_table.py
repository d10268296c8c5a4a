"""Write docs/results.md: vslam with and without loop closing, and a peer, on rendered drives.

    python tools/synth_table.py --routes demo,05 --lights clean,brightness:1.0 \
        [--kitti KITTI --along 00,07] [--aliased demo:10] [--sensor mono] \
        [--peer-python PY --peer-script run_orbslam3.py --vocabulary voc.txt]

A drive is a built-in route; with ``--along`` the poses of a KITTI sequence (KITTI/poses/NN.txt) in
a rendered town; with ``--aliased ROUTE:N`` a built-in route through N towns of few facades. What is
missing is rendered first. A light is ``clean``, a perturbation as of ``vslam run --perturb``, or
a kidnapping: ``cut:300`` takes 300 frames out, ``black:20`` blackens 20. What is changed is written
to a folder, and every system reads the same images. Each finished row is kept in a JSON file beside
the table and not measured again unless the bytes of the drives changed or ``--again`` names its
system. The table is always written whole. For what a peer's script takes and prints see
compare_peer.py.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import compare_peer

OURS = {"vslam": "bow", "vslam without loops": "none"}
PEER = "ORB-SLAM3"
GAPS = ("cut", "black")
HEAD = """# Results on rendered drives

Written by `python tools/synth_table.py`, one run each on the images of one folder, one at a time.
Lost: frames. ATE: of every frame, after SE3 alignment. Loops: closed / missed / wrong by the ground
truth; a revisit counts where the camera passes a place again for 20 m in the same direction. Of
ORB-SLAM3 only the loops it closes are known. fps: frames a second of the frame loop. Load: of the
machine (mean of five minutes); above 2, on two cores, the fps are too low. Brightness: seed 0.
"""
COLUMNS = """
| drive | frames | path m | light | system | lost | ATE m | ATE % | t_rel % | loops | fps | load |
|---|---|---|---|---|---|---|---|---|---|---|---|
"""
MONOCULAR = """
## Monocular: the left eye alone

ATE after Sim3 alignment, of vslam for every frame, of ORB-SLAM3 for the keyframes that it keeps; it
is given 20 images a second, vslam as many as it takes.
"""
Row = dict[str, Any]


class Drive(NamedTuple):
    """A rendered sequence: its title, the KITTI tree it lies in, its name there."""

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
    parser.add_argument("--out", type=Path, default=Path("docs/results.md"))
    parser.add_argument("--sensor", default="stereo", choices=("stereo", "mono"))
    parser.add_argument("--again", default="", help="systems to measure again, with commas")
    parser.add_argument("--peer-python", type=Path)
    parser.add_argument("--peer-script", type=Path)
    parser.add_argument("--vocabulary", type=Path)
    options = parser.parse_args()
    again = options.again.split(",")
    kept = {key: row for key, row in _read(options.out).items() if row["system"] not in again}
    for drive in _drives(options):
        for light in options.lights.split(";"):
            # What loop closing is worth is asked once for each drive.
            systems = [*OURS] if light == "clean" and "aliased" not in drive.title else ["vslam"]
            systems += [PEER] if options.peer_python else []
            eye = ", mono" if options.sensor == "mono" else ""
            wanted = {f"{drive.title}, {light}, {system}{eye}": system for system in systems}
            missing = {key: system for key, system in wanted.items() if key not in kept}
            if not missing:
                continue
            with _in_light(drive, light) as data:
                for key, system in missing.items():
                    kept[key] = _row(drive, light, system, data, options)
                    _write(options.out, kept)
    _write(options.out, kept)


def _drives(options: argparse.Namespace) -> Iterator[Drive]:
    from vslam.datasets.kitti import read_kitti_poses
    from vslam.datasets.synthetic import Variation, built_in_route, cache_folder, render_sequence
    from vslam.datasets.synthetic.routes import route_of_poses

    cache = cache_folder()
    for name in filter(None, options.routes.split(",")):
        yield Drive(name, render_sequence(built_in_route(name), Variation(), cache), name)
    for name in filter(None, options.along.split(",")):
        calibration = "00-02" if name < "03" else "03" if name == "03" else "04-12"
        poses = read_kitti_poses(options.kitti / "poses" / f"{name}.txt")
        route = route_of_poses(poses, f"kitti{name}", calibration)
        yield Drive(f"KITTI {name}", render_sequence(route, Variation(), cache), route.name)
    if options.aliased:
        name, count = options.aliased.split(":")
        for seed in range(int(count)):
            variation = Variation(seed, aliased=True)
            root = render_sequence(built_in_route(name), variation, cache)
            yield Drive(f"{name}, aliased town {seed}", root, name)


@contextmanager
def _in_light(drive: Drive, light: str) -> Iterator[Path]:
    """A KITTI tree with the drive's images as they are or, in a temporary folder, changed.

    ``cut:N`` takes N frames out, a third of the way; ``black:N`` blackens N frames there. Anything
    else is a perturbation of ``vslam run``.
    """
    import cv2
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.perturb import parse_perturbation

    if light == "clean":
        yield drive.root
        return
    sequence = open_sequence("kitti", drive.root, drive.name)
    kind, _, count = light.partition(":")
    gap = range(len(sequence) // 3, len(sequence) // 3 + int(count)) if kind in GAPS else range(0)
    law = parse_perturbation("none" if gap else light, 0, sequence.timestamps)
    frames = [k for k in range(len(sequence)) if kind != "cut" or k not in gap]
    with tempfile.TemporaryDirectory(prefix="vslam-light-") as scratch:
        root = Path(scratch)
        folder = root / "sequences" / drive.name
        eyes = [folder / "image_0", folder / "image_1"]
        for made in (*eyes, root / "poses"):
            made.mkdir(parents=True)
        source = drive.root / "sequences" / drive.name
        (folder / "calib.txt").write_bytes((source / "calib.txt").read_bytes())
        for file in (Path("sequences", drive.name, "times.txt"), Path(f"poses/{drive.name}.txt")):
            lines = (drive.root / file).read_text().splitlines()
            (root / file).write_text("".join(f"{lines[k]}\n" for k in frames))

        def write(number: int) -> None:
            k = frames[number]
            images = law.apply(k, *sequence.read(k))
            for eye, image in zip(eyes, images, strict=True):
                image = np.zeros_like(image) if kind == "black" and k in gap else image
                path = eye / f"{number:06d}.png"
                cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(write, range(len(frames))))
        yield root


def _row(drive: Drive, light: str, system: str, data: Path, options: argparse.Namespace) -> Row:
    import numpy as np

    from vslam.datasets.kitti import read_kitti_poses
    from vslam.datasets.synthetic import store
    from vslam.evaluate import path_length

    truth = read_kitti_poses(data / "poses" / f"{drive.name}.txt")
    run_options = argparse.Namespace(
        data=data,
        seq=drive.name,
        frames=len(truth),
        threads=None,
        detector=OURS.get(system),
        sensor=options.sensor,
        vslam=str(Path(sys.executable).with_name("vslam")),
        peer_python=options.peer_python and options.peer_python.absolute(),
        peer_script=options.peer_script and options.peer_script.absolute(),
        vocabulary=options.vocabulary and options.vocabulary.absolute(),
    )
    start = compare_peer.run_vslam if system in OURS else compare_peer.run_peer
    with tempfile.TemporaryDirectory(prefix="vslam-table-") as scratch:
        found = compare_peer.figures(start(run_options, Path(scratch)), run_options)
    return {
        "drive": drive.title,
        "light": light,
        "system": system,
        "sensor": options.sensor,
        "frames": len(truth),
        "path_m": float(path_length(truth)[-1]),
        **{key: None if np.isnan(value) else value for key, value in found.items()},
        "load": os.getloadavg()[1],
        "bytes": store.VERSION,
    }


def _line(row: Row) -> str:
    def shown(key: str, form: str) -> str:
        return "-" if row[key] is None else format(row[key], form)

    loops = [shown(f"loops_{what}", ".0f") for what in ("closed", "missed", "wrong")]
    percent = "-" if row["ate_m"] is None else f"{100 * row['ate_m'] / row['path_m']:.3f}"
    cells = [row["drive"], f"{row['frames']}", f"{row['path_m']:.0f}", row["light"], row["system"]]
    cells += [shown("lost", ".0f"), shown("ate_m", ".3f"), percent, shown("t_rel", ".3f")]
    cells += [" / ".join(loops), shown("loop_fps", ".1f"), shown("load", ".1f")]
    return f"| {' | '.join(cells)} |\n"


def _read(out: Path) -> dict[str, Row]:
    """Finished rows that belong to the bytes that are rendered now."""
    from vslam.datasets.synthetic import store

    try:
        rows = json.loads(out.with_suffix(".json").read_text())
    except FileNotFoundError:
        return {}
    return {key: row for key, row in rows.items() if row["bytes"] == store.VERSION}


def _write(out: Path, rows: dict[str, Row]) -> None:
    order = [*OURS, PEER]
    lines = sorted(
        rows.values(), key=lambda row: (row["drive"], row["light"], order.index(row["system"]))
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    parts = {
        sensor: "".join(_line(row) for row in lines if row.get("sensor", "stereo") == sensor)
        for sensor in ("stereo", "mono")
    }
    text = HEAD + COLUMNS + parts["stereo"]
    out.write_text(text + (MONOCULAR + COLUMNS + parts["mono"] if parts["mono"] else ""))


if __name__ == "__main__":
    main()
