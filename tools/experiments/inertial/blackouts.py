"""Measure how far a pose is off after a blackout, with and without the IMU.

    python tools/experiments/inertial/blackouts.py room walk --out blackouts.csv
    python tools/experiments/inertial/blackouts.py block demo 00 05 --corners --out corners.csv

In a drive of 24 s, the images are black four times, for 0.25 to 2 s. The lengths change places from
seed to seed, so each is tested within the first ten seconds, too. With ``--corners``, it is dark
for 2 s while a car turns into a street that it has not seen.

``dark_m`` and ``dark_deg`` are the errors of the motion from the last frame before to the last dark
frame, as the poses were at that time. ``after_m`` and ``after_deg`` are those of the final poses,
half a second after the light. Without an IMU, vslam continues at constant velocity.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from drives import SYSTEMS, Drive, ate, built_in, drive_of, motion_error, write_rows

from vslam_lab.towns import Route, cache_folder

SECONDS = (0.25, 0.5, 1.0, 2.0)
STARTS = (2.5, 6.0, 11.0, 17.0)  # s
LENGTH = 24.0  # s
BEFORE, CORNER, AFTER = 6.0, 2.0, 2.0  # s of a drive through a corner
SHARP = 50.0  # degrees in 2 s


def blackouts_of(drive: Drive, seed: int) -> list[tuple[int, int]]:
    """Return the first dark frame of each blackout, and the first frame after it."""
    lengths = np.roll(SECONDS, seed)
    firsts = np.searchsorted(drive.times, np.array(STARTS) - 1e-6)
    ends = np.searchsorted(drive.times, np.array(STARTS) + lengths - 1e-6)
    return list(zip(firsts.tolist(), ends.tolist(), strict=True))


def corner_of(route: Route) -> int:
    """Return the frame before the first sharp turn. The turn is in the middle of ``CORNER``."""
    heading = np.unwrap(np.arctan2(route.T_wc[:, 0, 2], route.T_wc[:, 2, 2]))
    wide, least = round(CORNER * route.rate), round(BEFORE * route.rate)
    turned = np.degrees(np.abs(heading[wide:] - heading[:-wide]))
    sharp = np.flatnonzero(turned[least:] > SHARP) + least
    first = int(sharp[0])
    return first + int(turned[first : first + wide].argmax())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("routes", nargs="+")
    parser.add_argument("--corners", action="store_true")
    parser.add_argument("--seeds", nargs="+", type=int, default=[21, 22, 23, 24])
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=["vslam"])
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    for name in options.routes:
        for seed in options.seeds:
            route = built_in(name, seed)
            if options.corners:
                dark = corner_of(route)
                begin, end = (round(s * route.rate) for s in (BEFORE, BEFORE + CORNER))
                first, last = dark - begin, dark - begin + round((BEFORE + CORNER + AFTER) * 10)
                drive = drive_of(route, seed, options.towns, frames=slice(first, last))
                blackouts = [(begin, end)]
            else:
                frames = slice(0, round(LENGTH * route.rate))
                drive = drive_of(route, seed, options.towns, frames=frames)
                blackouts = blackouts_of(drive, seed)
            is_dark = np.zeros(len(drive.times), np.bool_)
            for first, end in blackouts:
                is_dark[first:end] = True
            for system in options.systems:
                for imu in (True, False):
                    run = SYSTEMS[system](drive.with_dark(is_dark), imu=imu)
                    for first, end in blackouts:
                        at = min(end + round(0.5 * route.rate), len(is_dark) - 1)
                        dark_m, dark_deg = motion_error(run.live, drive.T_wc, first - 1, end - 1)
                        after_m, after_deg = motion_error(run.final, drive.T_wc, first - 1, at)
                        rows.append({
                            "route": name, "seed": seed, "system": system,
                            "imu": "yes" if imu else "no",
                            "seconds": (end - first) / route.rate,
                            "start_s": first / route.rate,
                            "dark_m": dark_m, "dark_deg": dark_deg,
                            "after_m": after_m, "after_deg": after_deg,
                            "lost": int(run.lost.sum()), "parts": run.parts,
                            "ate_m": ate(run.final, drive.T_wc),
                        })  # fmt: skip
                        print(rows[-1], flush=True)
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
