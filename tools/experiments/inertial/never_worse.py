"""Compare ordinary drives with and without the IMU: it must not make them worse.

    python tools/experiments/inertial/never_worse.py --seeds 60 61 --out sensors.csv

Errors are those of the frames since the first one that was tracked, after a rigid alignment, also
of one camera. ``scale_percent`` is by how much a similarity would scale the poses. ``lost`` counts
lost frames after the first one that was tracked, whose time is ``first_s``. ``rpe_m`` and
``rpe_deg`` are errors of the motion over one second. ``gravity_2s_deg`` is the error of gravity two
seconds after it was found, and ``gravity_deg`` the largest one from then on.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from drives import SYSTEMS, Drive, Run, ate, built_in, drive_of, rpe, scale_error, write_rows

from vslam_lab.towns import Route, cache_folder

ROUTES = "room", "hall", "walk", "drone", "demo"
SENSORS = "stereo", "mono", "rgbd"
SECONDS = 14.0


def gravity_errors(run: Run, route: Route) -> tuple[float, float, float]:
    """Return when gravity was found, its error two seconds later, and the largest later error."""
    down = route.T_wc[0, 1, :3]
    known = np.flatnonzero(~np.isnan(run.gravity[:, 0]))
    if not len(known):
        return np.nan, np.nan, np.nan
    cosine = run.gravity @ down / np.linalg.norm(run.gravity, axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    later = min(known[0] + round(2.0 * route.rate), len(angle) - 1)
    return known[0] / route.rate, float(angle[later]), float(np.nanmax(angle[later:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=["vslam"])
    parser.add_argument("--first", type=int, default=None, help="only the first drives")
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=SENSORS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[60])
    parser.add_argument("--repeats", type=int, default=1, help="runs of each drive")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    for seed, name in list(product(options.seeds, ROUTES))[: options.first]:
        route = built_in(name, seed)
        frames = slice(0, round(SECONDS * route.rate))
        images = drive_of(route, seed, options.towns, frames=frames, sensor="rgbd")
        for sensor in options.sensors:
            drive = replace(images, sensor=sensor)
            settings = product(options.systems, (True, False), range(options.repeats))
            for system, imu, _ in settings:
                run = SYSTEMS[system](drive, imu=imu)
                rows.append({
                    "route": name, "seed": seed, "drive": f"{name}, seed {seed}",
                    "sensor": sensor, "system": system, "imu": "yes" if imu else "no",
                    **measured(run, drive, route),
                })  # fmt: skip
                print(rows[-1], flush=True)
    write_rows(options.out, rows)


def measured(run: Run, drive: Drive, route: Route) -> dict[str, object]:
    """Return the errors of a run."""
    tracked = ~run.lost
    first = int(np.argmax(tracked)) if tracked.any() else 0
    final, truth = run.final[first:], drive.T_wc[first:]
    metres, degrees = rpe(final, truth, round(route.rate))
    since, soon, later = gravity_errors(run, route)
    return {
        "frames": len(drive.times), "lost": int(run.lost[first:].sum()),
        "first_s": first / route.rate, "ate_m": ate(final, truth),
        "scale_percent": 100.0 * abs(scale_error(final, truth)),
        "rpe_m": metres, "rpe_deg": degrees,
        "gravity_since_s": since, "gravity_2s_deg": soon, "gravity_deg": later,
    }  # fmt: skip


if __name__ == "__main__":
    main()
