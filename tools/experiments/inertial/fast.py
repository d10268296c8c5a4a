"""Count the frames that fast drives lose, with and without the IMU.

    python tools/experiments/inertial/fast.py --out fast.csv

A camera in a room looks left and right at up to 200 degrees/s. A car drives through towns, of which
every second to fifth frame is used. ``rpe_m`` and ``rpe_deg`` are errors of the motion over one
second.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from drives import SYSTEMS, ate, built_in, drive_of, rpe, spinning, write_rows

from vslam_lab.towns import cache_folder

RATES = (100.0, 150.0, 200.0)  # degrees/s
SWING = 60.0  # degrees to each side
SECONDS = 10.0
EVERY = (2, 3, 4, 5)
FRAMES = 350  # of each town


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--routes", nargs="*", default=["demo", "05"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[21, 22])
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=["vslam"])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    drives = []
    for seed in options.seeds:
        room = built_in("room", seed)
        part = slice(0, round(SECONDS * room.rate))
        for rate in RATES:
            fast = spinning(room, rate, SWING)
            drives.append(("room", f"{rate:.0f} degrees/s", seed, fast, part, 1))
        for name in options.routes:
            route = built_in(name, seed)
            frames = slice(0, FRAMES)
            drives += [(name, f"every {k}", seed, route, frames, k) for k in EVERY]
    rows: list[dict[str, object]] = []
    for name, kind, seed, route, part, every in drives:
        drive = drive_of(route, seed, options.towns, frames=part, every=every)
        for system in options.systems:
            for imu in (True, False):
                run = SYSTEMS[system](drive, imu=imu)
                metres, degrees = rpe(run.final, drive.T_wc, round(route.rate / every))
                rows.append({
                    "route": name, "drive": kind, "seed": seed, "system": system,
                    "imu": "yes" if imu else "no",
                    "frames": len(drive.times), "lost": int(run.lost.sum()),
                    "inertial": int(run.inertial.sum()), "parts": run.parts,
                    "ate_m": ate(run.final, drive.T_wc), "rpe_m": metres, "rpe_deg": degrees,
                })  # fmt: skip
                print(rows[-1], flush=True)
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
