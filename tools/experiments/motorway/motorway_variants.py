"""Rendered motorways that are harder than `01`: vslam and ORB-SLAM3 on the same images, in a table.

    python tools/experiments/motorway/motorway_variants.py \
        --csv docs/research/results/motorway.csv --orbslam3-python PY \
        --orbslam3-script run_orbslam3.py --vocabulary voc.txt

More speed: every second or third frame, with its own time, so that the car drives 5 or 7.5 m a
frame. Less texture: fog, contrast, blur. Far points only: a quarter of the baseline, which leaves
next to nothing within 40 baselines; the route is rendered anew for it. The rails of `01` and their
posts repeat every four metres. Finished rows stay in the CSV file and are not run again, unless
``--again`` names their system. For what ORB-SLAM3's script takes and prints see
systems.py.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2]))  # tools/

from systems import OrbSlam3, add_orbslam3_options, changed_drive, orbslam3_of, run_over

ROUTE = "01"
SHORT = 4  # times as short is the baseline that leaves far points only
VSLAM, ORBSLAM3 = "vslam", "ORB-SLAM3"
COLUMNS = ("variant", "system", "frames", "lost", "keyframes", "cpu_ms", "fps", "ate_m", "rpe_m")


class Variant(NamedTuple):
    """One drive: every n-th frame, a perturbation of `vslam run`, seen by a shorter baseline."""

    title: str
    every: int = 1
    law: str = "none"
    short: bool = False


VARIANTS = (
    Variant("as it is"),
    Variant("brightness:1.0", law="brightness:1.0"),
    Variant("5 m a frame", every=2),
    Variant("7.5 m a frame", every=3),
    Variant("contrast 30 %", law="contrast:30"),
    Variant("blur:1.0", law="blur:1.0"),
    Variant("fog, 60 m", law="fog:60"),
    Variant("far points only", short=True),
    Variant("far points only, 5 m a frame", every=2, short=True),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--only", default="", help="titles of variants, with semicolons")
    parser.add_argument("--again", default="", help="systems to measure again, with commas")
    add_orbslam3_options(parser)
    options = parser.parse_args()
    orbslam3 = orbslam3_of(options)
    systems = [VSLAM, ORBSLAM3] if orbslam3 else [VSLAM]
    again, only = options.again.split(","), list(filter(None, options.only.split(";")))
    rows: dict[tuple[str, str], dict[str, str]] = {}
    if options.csv.exists():
        with options.csv.open(newline="") as file:
            rows = {(row["variant"], row["system"]): row for row in csv.DictReader(file)}
    for variant in VARIANTS:
        wanted = [
            system
            for system in systems
            if (not only or variant.title in only)
            and (system in again or (variant.title, system) not in rows)
        ]
        if not wanted:
            continue
        with drive_of(variant) as (data, name):
            for system in wanted:
                rows[variant.title, system] = row_of(
                    variant, system, data, name, orbslam3 if system == ORBSLAM3 else None
                )
                write(options.csv, rows)
    print(table(rows))


@contextmanager
def drive_of(variant: Variant) -> Iterator[tuple[Path, str]]:
    """A KITTI tree, in a temporary folder, with the drive, and the drive's name there."""
    from vslam.datasets import open_sequence
    from vslam.datasets.synthetic import (
        Variation,
        built_in_route,
        cache_folder,
        render_sequence,
    )

    route = built_in_route(ROUTE)
    if variant.short:
        camera = replace(route.camera, baseline=route.camera.baseline / SHORT)
        route = replace(route, name=f"{ROUTE}-short", camera=camera)
    source = render_sequence(route, Variation(), cache_folder())
    frames = range(0, len(open_sequence("kitti", source, route.name)), variant.every)
    with changed_drive(source, route.name, frames, variant.law) as root:
        yield root, route.name


def row_of(
    variant: Variant, system: str, data: Path, name: str, orbslam3: OrbSlam3 | None
) -> dict[str, str]:
    """Run one system over a drive."""
    words = ("--detector", "bow", "--no-report") if system == VSLAM else ()
    run, found = run_over(data, name, orbslam3, *words)
    return {
        "variant": variant.title,
        "system": system,
        "frames": str(run.report["frames"]),
        "lost": f"{found['lost']:.0f}",
        "keyframes": str(run.report.get("keyframes", "")),
        "cpu_ms": f"{found['process_cpu_ms']:.0f}",
        "fps": f"{found['process_fps']:.1f}",
        "ate_m": f"{found['ate_m']:.3f}".replace("nan", ""),
        "rpe_m": f"{found['rpe_m']:.4f}".replace("nan", ""),
    }


def write(path: Path, rows: dict[tuple[str, str], dict[str, str]]) -> None:
    """The rows of all variants that were run, in their order."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(in_order(rows))


def in_order(rows: dict[tuple[str, str], dict[str, str]]) -> list[dict[str, str]]:
    keys = [(variant.title, system) for variant in VARIANTS for system in (VSLAM, ORBSLAM3)]
    return [rows[key] for key in keys if key in rows]


def table(rows: dict[tuple[str, str], dict[str, str]]) -> str:
    """Markdown, one row a variant: figures of vslam, then of ORB-SLAM3."""
    measures = {
        "keyframes": "keyframes of frames",
        "lost": "lost",
        "ate_m": "ATE",
        "rpe_m": "RPE",
        "cpu_ms": "CPU ms a frame",
    }
    lines = ["| `01` | " + " | ".join(measures.values()) + " |", "|---" * 6 + "|"]
    for variant in VARIANTS:
        ours, theirs = (rows.get((variant.title, system)) for system in (VSLAM, ORBSLAM3))
        if ours is None:
            continue
        cells = [f"{ours['keyframes']} of {ours['frames']}"]
        for name in list(measures)[1:]:
            beside = f" / {theirs[name] or '-'}" if theirs else ""
            cells.append(f"{ours[name] or '-'}{beside}")
        lines.append(f"| {variant.title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
