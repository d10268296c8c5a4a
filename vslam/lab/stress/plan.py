"""The searches of a stress test: which cells run next, and the results so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from vslam.datasets.perturbation import all_laws, law_kind, parse_perturbation
from vslam.errors import InputError, did_you_mean
from vslam.lab.bench.grid import Cell, draws
from vslam.lab.stress.criterion import Criterion
from vslam.lab.stress.kitti_c import CORRUPTIONS
from vslam.lab.stress.search import Boundary, boundary, next_position, strength_at
from vslam.report.schema import ReportJson

Reports = Callable[[Cell], ReportJson | str | None]
"""A function that returns the report of a cell, or the reason why the cell failed.

It returns None if the cell has not run yet.
"""


@dataclass
class Search:
    """The search for one law, sequence, system and seed.

    Attributes:
        clean: the cell on clean images.
        law: name of the law.
        seed: seed of the perturbation.
        steps: number of bisections.
        verdicts: verdicts of finished tests, by position. The position is 0 for the weakest and 1
            for the greatest strength.
        tested: cells of finished tests, by position.
    """

    clean: Cell
    law: str
    seed: int
    steps: int
    verdicts: dict[float, str] = field(default_factory=dict)
    tested: dict[float, Cell] = field(default_factory=dict)

    def cell(self, position: float) -> Cell:
        """The cell that tests a position from 0 (weakest strength) to 1 (greatest strength)."""
        strength = strength_at(law_kind(self.law), position)
        name = parse_perturbation(f"{self.law}:{strength:g}", self.seed).name
        return replace(self.clean, perturb=name, seed=self.seed)

    def position(self) -> float | None:
        """The next position to test; None if the search has ended."""
        return next_position({p: bool(v) for p, v in self.verdicts.items()}, self.steps)

    def wants(self) -> Cell | None:
        """The next cell to run; None if the search has ended."""
        return None if (position := self.position()) is None else self.cell(position)

    def advance(self, reports: Reports, criterion: Criterion) -> None:
        """Judge the tests that have ended. This determines the next position."""
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
        """The result of the search. The search must have ended."""
        return boundary(self.verdicts, law_kind(self.law), self.steps)


@dataclass(frozen=True)
class Plan:
    """The searches and runs of a stress test.

    Attributes:
        clean: the runs of each system on the clean images of each sequence.
        laws: names of the laws whose boundaries are searched.
        seeds: number of seeds for each law.
        steps: number of bisections in each search.
        baseline: the system with which the errors of a preset are compared.
        criterion: criterion that decides whether a run has failed.
        repeated: systems that are not deterministic, so that they run with every seed.
        preset: ``kitti-c``, whose fixed severities are tested instead of ``laws``. None if there is
            no preset.
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
        """All searches.

        A law that is not random is searched with only one seed, unless the system is not
        deterministic.
        """
        return [
            Search(clean, law, seed, self.steps)
            for seed in range(self.seeds)
            for law in self.laws
            for clean in self.clean
            if seed == 0 or law_kind(law).drawn or clean.detector in self.repeated
        ]

    def preset_cells(self) -> list[Cell]:
        """The runs of the preset; empty if there is no preset."""
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
    """Parse names of laws, such as ``fog,rain`` or ``all``.

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
