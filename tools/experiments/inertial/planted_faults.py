"""Count the planted faults of an IMU that the doctor names, and how often it blames a sound IMU.

    python tools/experiments/inertial/planted_faults.py [--seed N] [--sensor mono] [--real EUROC]

Five rendered drives are tracked. Each of them gets each of ten faults, and ten sound IMUs, which
differ in mounting, clock, noise and biases. A fault counts as found only if the doctor names it
together with the line to change. The rotation and the clock of the sound IMUs are measured, as
vslam calibrate --imu does. The limits of the doctor were set on other motions
(tests/product/test_imu_checks.py). With --real, the faults are also planted into the IMU of a real
sequence. Where its camera hardly turns, rotations allow no verdict.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.config import Config
from vslam.datasets.euroc import open_euroc
from vslam.datasets.frames import Source
from vslam.doctor.imu import track_rotations
from vslam.run.imu_alignment import align
from vslam.run.imu_checks import Check, check_alignment, check_samples
from vslam.types.imu import GRAVITY, ImuCalibration
from vslam_lab.towns import open_synthetic, parse_drive, route_named
from vslam_lab.towns.inertial import imu_on_camera, samples_along, with_noise

Float = NDArray[np.float64]

MOTIONS = "room", "hall", "walk", "room", "hall"
N_IMUS, FRAMES = 10, 120
RANGE = 2 * GRAVITY  # of a cheap accelerometer


@dataclass(frozen=True)
class Rig:
    """The samples of an IMU, and what a calibration file says about it."""

    samples: Float
    calibration: ImuCalibration

    def resampled(self, change: Callable[[Float], Float]) -> Rig:
        return replace(self, samples=change(self.samples.copy()))

    def mounted(self, R: Float) -> Rig:
        """Replace the rotation in the calibration file."""
        T = self.calibration.T_imu_camera.copy()
        T[:3, :3] = R
        return replace(self, calibration=replace(self.calibration, T_imu_camera=T))


def inverse(rig: Rig) -> Rig:
    return rig.mounted(rig.calibration.T_imu_camera[:3, :3].T)


def turned(rig: Rig) -> Rig:
    R = Rotation.from_rotvec([0.1, 0.1, -0.1]).as_matrix()
    return rig.mounted(R @ rig.calibration.T_imu_camera[:3, :3])


def scaled(columns: slice, factor: float) -> Callable[[Rig], Rig]:
    def change(rows: Float) -> Float:
        rows[:, columns] *= factor
        return rows

    return lambda rig: rig.resampled(change)


def late(rig: Rig) -> Rig:
    return rig.resampled(lambda rows: rows + np.eye(1, 7) * 0.012)


def slow(rig: Rig) -> Rig:
    step = float(np.median(np.diff(rig.samples[:, 0])))
    return rig.resampled(lambda rows: rows[:: round(0.1 / step)])


def gap(rig: Rig) -> Rig:
    """Lose a quarter of a second in the middle of the drive."""
    middle = float(rig.samples[[0, -1], 0].mean())
    return rig.resampled(lambda rows: rows[np.abs(rows[:, 0] - middle) > 0.125])


def clipped(rig: Rig) -> Rig:
    """Shake the accelerometer beyond its range."""

    def change(rows: Float) -> Float:
        shaken = rows[:, 4:] + 15.0 * np.sin(44.0 * rows[:, :1] + [0.0, 1.0, 2.0])
        rows[:, 4:] = shaken.clip(-RANGE, RANGE)
        return rows

    return rig.resampled(change)


@dataclass(frozen=True)
class Fault:
    """A fault, the check that must find it, and words of the line to change."""

    plant: Callable[[Rig], Rig]
    check: str
    fix: str


FAULTS = {
    "inverted extrinsics": Fault(inverse, "IMU rotation", "use its inverse"),
    "extrinsics wrong by 10 degrees": Fault(turned, "IMU rotation", "into T_imu_camera"),
    "rates in degrees": Fault(scaled(slice(1, 4), 180 / np.pi), "gyroscope", "degrees per second"),
    "forces in g": Fault(scaled(slice(4, 7), 1 / GRAVITY), "gravity", "in g"),
    "12 ms late": Fault(late, "IMU time", "write time_offset"),
    "dead axis": Fault(scaled(slice(2, 3), 0.0), "IMU axes", "all axes"),
    "mirrored axis": Fault(scaled(slice(3, 4), -1.0), "gyroscope", "left-handed"),
    "10 samples per second": Fault(slow, "IMU rate", "samples per second"),
    "gap of 0.25 s": Fault(gap, "IMU gaps", "lost"),
    "clipping": Fault(clipped, "clipping", "wider range"),
}


def simulated(name: str, seed: int) -> Rig:
    """Mount a noisy IMU with a clock of its own on the camera of a rendered drive."""
    rng = np.random.default_rng([seed, 4711])
    route = route_named(*parse_drive(name))
    T = imu_on_camera().T_imu_camera.copy()
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    noise, offset = imu_on_camera().noise, float(rng.uniform(-0.03, 0.03))
    samples = samples_along(route.timestamps, route.T_wc, T)
    samples = with_noise(samples[samples[:, 0] < (FRAMES + 20) / route.rate], noise, seed)
    samples[:, 0] += offset
    return Rig(samples, ImuCalibration(T, noise, offset))


def checks_of(rig: Rig, times: Float, rotations: Float) -> list[Check]:
    """Make the checks of ``vslam doctor``."""
    one = rig.calibration
    found = align(times, rotations, rig.samples)
    return [
        *check_samples(rig.samples, one.noise),
        *check_alignment(found, one.T_imu_camera[:3, :3], one.time_offset),
    ]


def is_found(fault: Fault, checks: list[Check]) -> bool:
    return any(c.wrong and c.name == fault.check and fault.fix in c.fix for c in checks)


def rotations_of(source: Source) -> tuple[Float, Float]:
    return source.timestamps, track_rotations(source, slice(None), Config())


def report_real(source: Source) -> None:
    assert source.imu is not None
    assert source.imu.calibration is not None
    rig = Rig(source.imu.recorded.samples, source.imu.calibration)
    times, rotations = rotations_of(source)
    begin, end = times[[0, -1]] + rig.calibration.time_offset
    rig = rig.resampled(lambda rows: rows[(rows[:, 0] > begin - 1.0) & (rows[:, 0] < end + 1.0)])
    alarms = [check.name for check in checks_of(rig, times, rotations) if check.wrong]
    print(f"\n{source.name}: false alarms: {', '.join(alarms) or 'none'}")
    for name, fault in FAULTS.items():
        checks = checks_of(fault.plant(rig), times, rotations)
        silent = any(check.wrong is None and check.name == "IMU rotation" for check in checks)
        verdict = "no verdict, because the camera hardly turns" if silent else "not found"
        print(f"{name}: {'found' if is_found(fault, checks) else verdict}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sensor", choices=("stereo", "mono"), default="stereo")
    parser.add_argument("--seed", type=int, default=1001, help="seed of the first drive")
    parser.add_argument("--real", type=Path, metavar="EUROC_SEQUENCE")
    options = parser.parse_args()
    found = dict.fromkeys(FAULTS, 0)
    alarms: list[str] = []
    errors: list[tuple[float, float]] = []
    drives = [f"{name}+seed:{options.seed + k}" for k, name in enumerate(MOTIONS)]
    for k, name in enumerate(drives):
        mono = options.sensor == "mono"
        source = open_synthetic(name, max_frames=FRAMES, monocular=mono)
        rigs = [simulated(name, options.seed + 10 * k + one) for one in range(N_IMUS)]
        times, rotations = rotations_of(source)
        for rig in rigs:
            one = rig.calibration
            measured = align(times, rotations, rig.samples)
            if measured is not None:
                turn = np.linalg.norm(measured.turn_from(one.T_imu_camera[:3, :3]))
                late_by = abs(measured.time_offset - one.time_offset)
                errors.append((np.degrees(turn), 1e3 * late_by))
            wrong = [check for check in checks_of(rig, times, rotations) if check.wrong]
            alarms += [f"{name}: {check.name}: {check.measured}" for check in wrong[:1]]
        for what, fault in FAULTS.items():
            found[what] += is_found(fault, checks_of(fault.plant(rigs[0]), times, rotations))
    print(f"| planted fault ({options.sensor}) | found | of |\n|---|---|---|")
    for what, count in found.items():
        print(f"| {what} | {count} | {len(drives)} |")
    total = len(drives) * len(FAULTS)
    print(f"\n{sum(found.values())} of {total} planted faults, ", end="")
    print(f"{len(alarms)} false alarms in {len(drives) * N_IMUS}")
    print("".join(f"{alarm}\n" for alarm in alarms), end="")
    for what, unit, column in zip(
        ("rotation", "time offset"), ("degrees", "ms"), np.transpose(errors), strict=True
    ):
        print(f"{what}: median error {np.median(column):.2f} {unit}, largest {column.max():.2f}")
    if options.real is not None:
        report_real(open_euroc(options.real, monocular=options.sensor == "mono"))


if __name__ == "__main__":
    main()
