"""The cells of a benchmark, and where the results of a finished one are."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from vslam.datasets.perturbation import law_kind, parse_perturbation
from vslam.datasets.sources import SOURCES
from vslam.errors import InputError
from vslam.report.schema import ReportJson


@dataclass(frozen=True, order=True)
class Cell:
    """One run of the grid: all that its figures depend on, apart from thresholds and images.

    Attributes:
        perturb: in canonical spelling, ``none`` or ``brightness:1.5,blur:0.5`` for example.
        max_frames: frames from the first one, None for all.
        weights: of a learned detector, a file that every worker has under this path; None for the
            shipped ones.
        digest: of these weights.
        sensor: that the run is told to be of, None for all that the data has.
        calib: calibration files.
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

    @property
    def name(self) -> str:
        """Of its folder: what tells cells apart is in it, so that none overwrites another."""
        light = self.perturb.replace(":", "").replace(",", "+")
        parts = [self.dataset, self.sequence, light, self.detector, f"seed{self.seed}"]
        parts += [f"{self.max_frames}frames"] if self.max_frames else []
        parts += [f"weights{self.digest}"] if self.digest else []
        parts += [self.sensor] if self.sensor else []
        return "-".join(re.sub(r"[^A-Za-z0-9.+-]+", "_", part) for part in parts)

    def arguments(self) -> list[str]:
        """Of ``vslam run``."""
        words = ["--dataset", self.dataset, "--perturb", self.perturb]
        words += ["--detector", self.detector, "--seed", str(self.seed)]
        words += [] if self.dataset in SOURCES else ["--seq", self.sequence]
        words += ["--sensor", self.sensor] if self.sensor else []
        words += [word for path in self.calib for word in ("--calib", path)]
        words += ["--weights", self.weights] if self.weights else []
        return words + (["--max-frames", str(self.max_frames)] if self.max_frames else [])


def parse_sequences(text: str) -> list[str]:
    """``00-02,05,demo`` -> ``00 01 02 05 demo``: names and ranges of numbers, each once.

    Raises:
        InputError: a range that runs backwards, or no name at all.
    """
    names: dict[str, None] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        if ends := re.fullmatch(r"(\d+)-(\d+)", item):
            first, last = int(ends[1]), int(ends[2])
            if last < first:
                raise InputError(
                    f"--seqs {text}: {item} runs backwards; write {ends[2]}-{ends[1]}."
                )
            width = len(ends[1])
            names.update(dict.fromkeys(f"{k:0{width}d}" for k in range(first, last + 1)))
        else:
            names[item] = None
    if not names:
        raise InputError("--seqs: no sequence; name some, 00-05 or demo,00 for example.")
    return list(names)


def parse_perturbations(text: str) -> list[str]:
    """``none,brightness:2+blur`` -> ``none`` and ``brightness:2,blur:1``, in canonical spelling.

    A comma separates entries of the grid, so that laws that act together are joined by ``+``.

    Raises:
        InputError: an entry that ``vslam run --perturb`` would refuse.
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
) -> list[Cell]:
    """All cells, in the order in which they are worth most if the work is cut short: every
    sequence with the first seed, then with the next.

    A perturbation that draws nothing gets one run: the same input gives the same bytes, and
    counting them again would make a test believe in more than it has seen.

    Args:
        weights: by detector, for those that do not use the shipped ones.
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
        )
        for seed, sequence, perturb, detector in product(
            range(runs), sequences, perturbations, detectors
        )
        if seed == 0 or draws(perturb)
    ]


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:8]
    except OSError as error:
        raise InputError(f"--weights {path}: cannot be read ({error.strerror}).") from error


def draws(perturb: str) -> bool:
    """Whether the images depend on the seed."""
    laws = {law.partition(":")[0] for law in perturb.split(",")} - {"none"}
    return any(law_kind(law).drawn for law in laws)


def read_report(folder: Path) -> ReportJson | None:
    """The report of a run folder, None if there is none or it is of another schema."""
    try:
        return ReportJson.read(folder / "report.json")
    except InputError:
        return None


def tracked_nothing(folder: Path) -> bool:
    """Whether a run folder holds the report of a run that was lost in every frame."""
    report = read_report(folder)
    return report is not None and report.lost_frames + report.dropped_frames == report.frames


def is_finished(cell: Cell, folder: Path, config: str) -> bool:
    """Whether ``folder`` holds a complete run of just this cell.

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
        cell.digest,  # the folder is named after it
        cell.sensor,
        tuple(map(str, report.calib)),
    )
    as_asked = cell.sensor in (None, report.sensor)
    whole = (report.start, report.every) == (0, 1)
    return same_config and as_asked and whole and found == cell
