"""Compare drives whose IMU becomes wrong half-way with drives without an IMU.

    python tools/experiments/inertial/guard.py --out guard.csv

``rpe_m`` and ``rpe_deg`` are errors of the motion over one second.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from drives import Float, ate, built_in, drive_of, rpe, run_vslam, write_rows
from scipy.spatial.transform import Rotation

from vslam_lab.towns import cache_folder

DRIVES = (("room", 64, 160), ("hall", 65, 160), ("walk", 66, 200), ("demo", 68, 140))  # and frames


def faults(sound: Float, since: float, rng: np.random.Generator) -> Iterator[tuple[str, Float]]:
    """Yield the names and the samples of an IMU with a fault from a time on."""
    late = np.flatnonzero(sound[:, 0] >= since)

    def changed(columns: slice, values: Float | float) -> Float:
        samples = sound.copy()
        samples[late, columns] = values
        return samples

    yield "none", sound
    yield "gyroscope is dead", changed(slice(1, 4), 0.0)
    yield "frozen", changed(slice(1, 7), sound[late[0], 1:])
    noise = rng.normal(size=(len(late), 6)) * np.repeat([0.1, 1.0], 3)
    yield "shaken", changed(slice(1, 7), sound[late, 1:] + noise)
    for degrees in (1, 3, 10):
        axis = rng.normal(size=3)
        R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
        turned = np.hstack([R.apply(sound[late, 1:4]), R.apply(sound[late, 4:])])
        yield f"turned by {degrees} degrees", changed(slice(1, 7), turned)
    for ms in (5, 15, 50):
        yield f"{ms} ms late", changed(slice(0, 1), sound[late, :1] + 1e-3 * ms)
    bias = sound[late, 1:4] + np.radians([0.6, -0.6, 0.5])
    yield "bias of 1 degree/s", changed(slice(1, 4), bias)
    yield "bias of 0.5 m/s^2", changed(slice(4, 7), sound[late, 4:] + [0.3, -0.3, 0.3])
    yield "5 % too large", changed(slice(1, 7), 1.05 * sound[late, 1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--towns", type=Path, default=cache_folder())
    parser.add_argument("--drives", nargs="+", default=[name for name, *_ in DRIVES])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows: list[dict[str, object]] = []
    for name, seed, n in DRIVES:
        if name not in options.drives:
            continue
        route, rng = built_in(name, seed), np.random.default_rng(seed)
        drive = drive_of(route, seed, options.towns, frames=slice(0, n))
        half = float(drive.times[-1]) / 2.0
        for fault, samples in [("no IMU", drive.samples), *faults(drive.samples, half, rng)]:
            run = run_vslam(replace(drive, samples=samples), imu=fault != "no IMU")
            metres, degrees = rpe(run.final, drive.T_wc, round(route.rate))
            rows.append({
                "drive": f"{name}, seed {seed}", "fault": fault, "lost": int(run.lost.sum()),
                "ate_m": ate(run.final, drive.T_wc), "rpe_m": metres, "rpe_deg": degrees,
            })  # fmt: skip
            print(rows[-1], flush=True)
    write_rows(options.out, rows)


if __name__ == "__main__":
    main()
