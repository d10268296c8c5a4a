"""Lists the runs of a benchmark (the cells of its grid), and names the folder of each run."""

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
from vslam.report.schema import ReportJson
from vslam.support.errors import InputError
from vslam.types.source_options import SOURCES


@dataclass(frozen=True, order=True)
class Cell:
    """One run in a benchmark's grid of sequences, perturbations, detectors and seeds.

    Attributes:
        dataset: value of ``--dataset``.
        perturb: perturbation in canonical spelling, e.g. ``none`` or ``brightness:1.5,blur:0.5``.
        detector: name of a loop detector of vslam, or of another SLAM system.
        seed: seed of the perturbation.
        max_frames: number of frames, counted from the first frame; None for all frames.
        weights: weight file of a learned detector; None for the shipped weights. On a cluster, the
            file must have the same path on every worker.
        digest: digest of the weight file.
        sensor: value of ``--sensor``; None to use all images of the data.
        calib: calibration files that are given with ``--calib``.
        thresholds: digest of the thresholds that differ from the defaults; empty if none differs.
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
        """Name of the folder for the results of this run."""
        light = self.perturb.replace(":", "").replace(",", "+")
        parts = [self.dataset, self.sequence, light, self.detector, f"seed{self.seed}"]
        parts += [f"{self.max_frames}frames"] if self.max_frames else []
        parts += [f"weights{self.digest}"] if self.digest else []
        parts += [self.sensor] if self.sensor else []
        parts += [f"config{self.thresholds}"] if self.thresholds else []
        return "-".join(re.sub(r"[^A-Za-z0-9.+-]+", "_", part) for part in parts)

    def arguments(self) -> list[str]:
        """Return the arguments of ``vslam run`` for this cell."""
        words = ["--dataset", self.dataset, "--perturb", self.perturb]
        words += ["--detector", self.detector, "--seed", str(self.seed)]
        words += [] if self.dataset in SOURCES else ["--seq", self.sequence]
        words += ["--sensor", self.sensor] if self.sensor else []
        words += [word for path in self.calib for word in ("--calib", path)]
        words += ["--weights", self.weights] if self.weights else []
        return words + (["--max-frames", str(self.max_frames)] if self.max_frames else [])


def parse_sequences(text: str) -> list[str]:
    """Parse names and ranges of sequences: ``00-02,05,demo`` gives ``00 01 02 05 demo``.

    Repeated names are removed.

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
    """Parse perturbations: ``none,brightness:2+blur`` gives ``none`` and ``brightness:2,blur:1``.

    In the input, a comma separates the perturbations of different runs. ``+`` joins perturbations
    that are applied together in one run.

    Raises:
        InputError: a part of the text is not a valid perturbation.
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
    """List all cells (runs) of a benchmark.

    The runs with the first seed come first, so that the results of an interrupted benchmark are
    useful.

    A perturbation that is not random is run with only one seed. Its runs with other seeds would be
    identical, and a statistical test would count them as independent samples.

    Args:
        runs: number of seeds.
        weights: weight files by the name of the detector. Other detectors use the shipped weights.
        repeated: names of the systems that are not deterministic. They are run with every seed.
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
    """Return a digest of the thresholds that differ from the defaults; empty if none differs.

    Args:
        config: thresholds, as the text of a file ``config.json``.
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
    """Return whether a perturbation is random, so that the images depend on the seed."""
    laws = {law.partition(":")[0] for law in perturb.split(",")} - {"none"}
    return any(law_kind(law).drawn for law in laws)


def read_report(folder: Path) -> ReportJson | None:
    """Read the report of a run. Return None if it is missing or has an unknown schema."""
    try:
        return ReportJson.read(folder / "report.json")
    except InputError:
        return None


def tracked_nothing(folder: Path) -> bool:
    """Return whether tracking was lost in every frame of the run in a folder."""
    report = read_report(folder)
    return report is not None and report.lost_frames + report.dropped_frames == report.frames


def is_finished(cell: Cell, folder: Path, config: str) -> bool:
    """Return whether ``folder`` contains a complete run of exactly this cell of a benchmark.

    Args:
        config: thresholds, as the text of a file ``config.json``.
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
