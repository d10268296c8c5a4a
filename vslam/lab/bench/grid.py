"""The cells of a benchmark, and the folders of their results."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from vslam.config import changed_thresholds
from vslam.datasets.perturbation import law_kind, parse_perturbation
from vslam.datasets.sources import SOURCES
from vslam.errors import InputError
from vslam.report.schema import ReportJson


@dataclass(frozen=True, order=True)
class Cell:
    """One run of the grid.

    Apart from the images, its attributes determine the result of the run.

    Attributes:
        dataset: value of ``--dataset``.
        sequence: name of the sequence.
        perturb: perturbation in canonical spelling, e.g. ``none`` or ``brightness:1.5,blur:0.5``.
        detector: loop detector, or the name of another system.
        seed: seed of the perturbation.
        max_frames: number of frames, counted from the first frame; None for all frames.
        weights: weight file of a learned detector; None for the shipped weights. The file must have
            the same path on every worker.
        digest: digest of the weight file.
        sensor: value of ``--sensor``; None to use all images of the data.
        calib: calibration files.
        thresholds: digest of the thresholds that differ from the defaults; empty if there are none.
    """

    dataset: str
    sequence: str
    perturb: str
    detector: str
    seed: int
    max_frames: int | None = None
    weights: str | None = None
    digest: str = ""
    sensor: str | None = None
    calib: tuple[str, ...] = ()
    thresholds: str = ""

    @property
    def name(self) -> str:
        """Name of the folder for the results of this cell. No two cells have the same name."""
        light = self.perturb.replace(":", "").replace(",", "+")
        parts = [self.dataset, self.sequence, light, self.detector, f"seed{self.seed}"]
        parts += [f"{self.max_frames}frames"] if self.max_frames else []
        parts += [f"weights{self.digest}"] if self.digest else []
        parts += [self.sensor] if self.sensor else []
        parts += [f"config{self.thresholds}"] if self.thresholds else []
        return "-".join(re.sub(r"[^A-Za-z0-9.+-]+", "_", part) for part in parts)

    def arguments(self) -> list[str]:
        """Arguments of ``vslam run``."""
        words = ["--dataset", self.dataset, "--perturb", self.perturb]
        words += ["--detector", self.detector, "--seed", str(self.seed)]
        words += [] if self.dataset in SOURCES else ["--seq", self.sequence]
        words += ["--sensor", self.sensor] if self.sensor else []
        words += [word for path in self.calib for word in ("--calib", path)]
        words += ["--weights", self.weights] if self.weights else []
        return words + (["--max-frames", str(self.max_frames)] if self.max_frames else [])


def parse_sequences(text: str) -> list[str]:
    """Parse names and ranges of sequences.

    For example, ``00-02,05,demo`` gives ``00 01 02 05 demo``. Repetitions are removed.

    Raises:
        InputError: a range is reversed, or there is no name.
    """
    names: dict[str, None] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        if ends := re.fullmatch(r"(\d+)-(\d+)", item):
            first, last = int(ends[1]), int(ends[2])
            if last < first:
                raise InputError(f"--seqs {text}: {item} is reversed; write {ends[2]}-{ends[1]}.")
            width = len(ends[1])
            names.update(dict.fromkeys(f"{k:0{width}d}" for k in range(first, last + 1)))
        else:
            names[item] = None
    if not names:
        raise InputError("--seqs: names no sequence; give some, for example 00-05 or demo,00.")
    return list(names)


def parse_perturbations(text: str) -> list[str]:
    """Parse ``none,brightness:2+blur`` into ``none`` and ``brightness:2,blur:1``.

    A comma separates the entries of the grid. ``+`` joins perturbations that are applied together.

    Raises:
        InputError: one of the entries is not a valid perturbation.
    """
    specs = [part.strip().replace("+", ",") for part in text.split(",")]
    return list(dict.fromkeys(parse_perturbation(spec, 0).name for spec in specs))


def make_grid(
    dataset: str,
    sequences: Iterable[str],
    perturbations: Iterable[str],
    detectors: Iterable[str],
    runs: int,
    max_frames: int | None = None,
    weights: Mapping[str, Path] | None = None,
    sensor: str | None = None,
    calib: tuple[str, ...] = (),
    thresholds: str = "",
    repeated: Collection[str] = (),
) -> list[Cell]:
    """Make all cells of a grid.

    Every sequence first runs with the first seed, then with the next seed. In this order, the
    results of an interrupted benchmark are most useful. A perturbation that is not random gets only
    one run. Its repetitions would be identical, and a statistical test would count them as
    independent samples.

    Args:
        runs: number of seeds.
        weights: weight files by detector, for detectors that do not use the shipped weights.
        repeated: systems that are not deterministic, so that they run with every seed.
    """
    paths = {name: str(path) for name, path in (weights or {}).items()}
    digests = {name: _digest(path) for name, path in (weights or {}).items()}
    return [
        Cell(
            dataset=dataset,
            sequence=sequence,
            perturb=perturb,
            detector=detector,
            seed=seed,
            max_frames=max_frames,
            weights=paths.get(detector),
            digest=digests.get(detector, ""),
            sensor=sensor,
            calib=calib,
            thresholds=thresholds,
        )
        for seed, sequence, perturb, detector in product(
            range(runs), sequences, perturbations, detectors
        )
        if seed == 0 or draws(perturb) or detector in repeated
    ]


def thresholds_digest(config: str) -> str:
    """Digest of the thresholds that differ from the defaults; empty if there are none.

    Args:
        config: the text of a ``config.json``.
    """
    changed = changed_thresholds(json.loads(config))
    return _digest_of(json.dumps(changed, sort_keys=True).encode()) if changed else ""


def _digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:8]


def _digest(path: Path) -> str:
    try:
        return _digest_of(path.read_bytes())
    except OSError as error:
        raise InputError(f"--weights {path}: cannot be read ({error.strerror}).") from error


def draws(perturb: str) -> bool:
    """Whether a perturbation is random, so that the images depend on the seed."""
    laws = {law.partition(":")[0] for law in perturb.split(",")} - {"none"}
    return any(law_kind(law).drawn for law in laws)


def read_report(folder: Path) -> ReportJson | None:
    """The report in a run folder; None if it is missing or has another schema."""
    try:
        return ReportJson.read(folder / "report.json")
    except InputError:
        return None


def tracked_nothing(folder: Path) -> bool:
    """Whether a run folder contains the report of a run that was lost in every frame."""
    report = read_report(folder)
    return report is not None and report.lost_frames + report.dropped_frames == report.frames


def is_finished(cell: Cell, folder: Path, config: str) -> bool:
    """Whether ``folder`` contains a complete run of exactly this cell.

    Args:
        config: the thresholds, as in ``config.json`` of a run.
    """
    report = read_report(folder)
    if report is None or report.interrupted is not None:
        return False
    try:
        same_config = (folder / "config.json").read_text() == config
    except OSError:
        return False
    found = Cell(
        report.dataset,
        report.sequence,
        report.perturb,
        report.detector,
        report.seed,
        report.max_frames,
        str(report.weights) if report.weights else None,
        cell.digest,  # part of the folder's name
        cell.sensor,
        tuple(map(str, report.calib)),
        cell.thresholds,  # a digest of ``config``
    )
    same_sensor = cell.sensor in (None, report.sensor)
    whole = (report.start, report.every) == (0, 1)
    return same_config and same_sensor and whole and found == cell
