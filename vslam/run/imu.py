"""Decides whether a run uses the IMU of its source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vslam.datasets.frames import Source
from vslam.datasets.imu import Imu
from vslam.run.imu_checks import check_samples
from vslam.support.errors import InputError

_COVERED = 0.5  # share of the frames that must lie between the first and the last sample


def with_usable_imu(source: Source) -> Source:
    """Return a source without an IMU that would harm, and with warnings that say why."""
    imu, notes = usable_imu(source)
    refused = notes[0] if imu is None and notes else ""
    return replace(source, imu=imu, imu_refused=refused, warnings=(*source.warnings, *notes))


def usable_imu(source: Source) -> tuple[Imu | None, list[str]]:
    """Return the IMU of a source if a run is not worse with it, and warnings.

    Only checks that need no images are made. ``vslam doctor`` makes all of them. An IMU that would
    harm is left out, and a sentence says why.
    """
    imu = source.imu
    if imu is None:
        return None, []
    if imu.calibration is None:
        return None, [
            f"{imu.name}: the IMU is not used, because the calibration does not tell where it is; "
            "add T_imu_camera to it (docs/howto/imu.md)."
        ]
    if imu.live:
        return imu, []
    try:
        found = imu.recorded
    except InputError as error:
        return None, [f"The IMU is not used: {error}"]
    notes = [f"{imu.name}: {note}." for note in found.notes]
    samples = found.samples
    for check in check_samples(samples, imu.noise):
        if check.wrong and check.harmful:
            return None, [
                f"{imu.name}: the IMU is not used, because of its {_named(check.name)} "
                f"({check.measured}); {check.fix}."
            ]
    if source.seekable and len(samples):
        times = source.timestamps + imu.calibration.time_offset
        covered = float(np.mean((times >= samples[0, 0]) & (times <= samples[-1, 0])))
        if covered < _COVERED:
            return None, [
                f"{imu.name}: the IMU is not used, because its samples are from "
                f"{samples[0, 0]:.3f} to {samples[-1, 0]:.3f} s but the images from "
                f"{times[0]:.3f} to {times[-1]:.3f} s; both need times of one clock, or "
                "time_offset in the calibration."
            ]
    return imu, notes


def _named(check: str) -> str:
    return check.removeprefix("IMU ")
