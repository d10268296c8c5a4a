"""The searches of a stress test: which runs are next, and the results obtained so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from vslam.datasets.perturbation import all_laws, law_kind, parse_perturbation
from vslam.report.schema import ReportJson
from vslam.support.errors import InputError, did_you_mean
from vslam_lab.bench.grid import Cell, draws
from vslam_lab.stress.criterion import Criterion
from vslam_lab.stress.kitti_c import CORRUPTIONS
from vslam_lab.stress.search import Boundary, boundary, next_position, strength_at

Reports = Callable[[Cell], ReportJson | str | None]
"""A function that returns the report of a cell, or the reason why the cell failed.

It returns None if the cell has not run yet.
"""


@dataclass
class Search:
    """A search for the perturbation strength at which a system fails on a sequence.

    A *cell* is one run. A *position* is a strength on a scale from 0 (weakest) to 1 (greatest).

    Attributes:
        clean: the run of the same system on the unperturbed images of the sequence.
        law: name of the perturbation, without its strength.
        seed: seed of the perturbation.
        steps: number of bisections.
        verdicts: for each tested position, why the run failed; an empty text if it did not fail.
        tested: for each tested position, the run.
    """

    clean: Cell
    law: str
    seed: int
    steps: int
    verdicts: dict[float, str] = field(default_factory=dict)
    tested: dict[float, Cell] = field(default_factory=dict)

    def cell(self, position: float) -> Cell:
        """Return the run that tests a position (0 is the weakest, 1 the greatest strength)."""
        strength = strength_at(law_kind(self.law), position)
        name = parse_perturbation(f"{self.law}:{strength:g}", self.seed).name
        return replace(self.clean, perturb=name, seed=self.seed)

    def position(self) -> float | None:
        """Return the position (0 to 1) that is tested next; None if the search has ended."""
        return next_position({p: bool(v) for p, v in self.verdicts.items()}, self.steps)

    def wants(self) -> Cell | None:
        """Return the run that comes next in this search; None if the search has ended."""
        return None if (position := self.position()) is None else self.cell(position)

    def advance(self, reports: Reports, criterion: Criterion) -> None:
        """Judge the runs that have ended."""
        clean = reports(self.clean)
        if not isinstance(clean, ReportJson):
            return
        while (position := self.position()) is not None:
            cell = self.cell(position)
            found = reports(cell)
            if found is None:
                break
            verdict = found if isinstance(found, str) else criterion.verdict(found, clean)
            self.verdicts[position], self.tested[position] = verdict, cell

    @property
    def boundary(self) -> Boundary:
        """The strength at which the system fails. The search must have ended."""
        return boundary(self.verdicts, law_kind(self.law), self.steps)


@dataclass(frozen=True)
class Plan:
    """The searches of a stress test and their options.

    Attributes:
        clean: the run of each system on the unperturbed images of each sequence.
        laws: names of the perturbations to test, without strengths.
        seeds: number of seeds for each perturbation.
        steps: number of bisections in each search.
        baseline: name of the system with which the errors of other systems are compared, if there
            is a preset.
        repeated: names of the systems that are not deterministic. They are tested with every seed.
        preset: ``kitti-c`` or None. With ``kitti-c``, the fixed severities of KITTI-C are tested
            instead of ``laws``.
    """

    clean: list[Cell]
    laws: tuple[str, ...]
    seeds: int
    steps: int
    baseline: str
    criterion: Criterion
    repeated: tuple[str, ...] = ()
    preset: str | None = None

    def searches(self) -> list[Search]:
        """List the searches: one for each perturbation, system, sequence and seed.

        If neither the perturbation nor the system is random, only the first seed is used.
        """
        return [
            Search(clean, law, seed, self.steps)
            for seed in range(self.seeds)
            for law in self.laws
            for clean in self.clean
            if seed == 0 or law_kind(law).drawn or clean.detector in self.repeated
        ]

    def preset_cells(self) -> list[Cell]:
        """Return the runs that the preset demands; an empty list if there is no preset."""
        if self.preset is None:
            return []
        specs = [spec for corruption in CORRUPTIONS.values() for spec in corruption.perturbations]
        return [
            replace(clean, perturb=spec, seed=seed)
            for seed in range(self.seeds)
            for spec in specs
            for clean in self.clean
            if seed == 0 or draws(spec) or clean.detector in self.repeated
        ]


def parse_laws(text: str) -> list[str]:
    """Parse names of perturbations (laws), such as ``fog,rain`` or ``all``.

    Raises:
        InputError: a law is unknown, or the text names no law.
    """
    names = list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if names == ["all"]:
        return list(all_laws())
    for name in names:
        if name not in all_laws():
            raise InputError(
                f"--laws {text}: unknown law '{name}'{did_you_mean(name, all_laws())}; choose from "
                f"all, {', '.join(all_laws())}, without strengths."
            )
    if not names:
        raise InputError("--laws: names no law; give some, for example fog,rain, or all.")
    return names
