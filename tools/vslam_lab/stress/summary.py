"""Computes the content of the report of a stress test from the finished searches."""

from __future__ import annotations

import statistics
from collections.abc import Collection

from vslam.datasets.perturbation import law_kind
from vslam.report.schema import ReportJson
from vslam_lab.bench.grid import Cell
from vslam_lab.stress.criterion import Criterion, absolute_verdict, lost_percent
from vslam_lab.stress.kitti_c import CORRUPTIONS, Corruption
from vslam_lab.stress.plan import Plan, Reports, Search
from vslam_lab.stress.schema import BoundaryEntry, CleanEntry, CorruptionEntry, StressJson, Tested
from vslam_lab.stress.search import strength_at


def summarise(
    plan: Plan, searches: Collection[Search], reports: Reports, notes: list[str]
) -> StressJson:
    """Make the report of a stress test from the searches that have ended.

    If a run on unperturbed images failed, the report has a note on it.
    """
    failed = [(cell, found) for cell in plan.clean if isinstance(found := reports(cell), str)]
    notes = [*notes, *(f"{cell.name} is left out because it fails on clean images: {why}"
                       for cell, why in failed)]  # fmt: skip
    ended = [s for s in searches if isinstance(reports(s.clean), ReportJson) and s.wants() is None]
    return StressJson(
        criterion=plan.criterion.words,
        steps=plan.steps,
        max_frames=plan.clean[0].max_frames,
        notes=notes,
        clean=clean_entries(plan.clean, reports, plan.criterion),
        boundaries=[boundary_entry(search, reports) for search in ended],
        preset=plan.preset,
        baseline=plan.baseline if plan.preset else None,
        corruptions=corruption_entries(plan.preset_cells(), reports, plan.baseline)
        if plan.preset
        else [],
    )


def clean_entries(
    cells: Collection[Cell], reports: Reports, criterion: Criterion
) -> list[CleanEntry]:
    """Return the report's entries for the finished runs on unperturbed images."""
    return [
        CleanEntry(
            dataset=cell.dataset,
            sequence=cell.sequence,
            system=cell.detector,
            frames=report.frames,
            lost_frames=report.lost_frames,
            ate_rmse_m=report.ate_rmse_m,
            causal_ate_rmse_m=report.causal_ate_rmse_m,
            ate_limit_m=criterion.ate_limit(report),
            loops_found=report.loops_found,
        )
        for cell in cells
        if isinstance(report := reports(cell), ReportJson)
    ]


def boundary_entry(search: Search, reports: Reports) -> BoundaryEntry:
    """Return the entry in the report for a search that has ended."""
    found, kind = search.boundary, law_kind(search.law)
    return BoundaryEntry(
        dataset=search.clean.dataset,
        sequence=search.clean.sequence,
        law=search.law,
        unit=kind.unit,
        system=search.clean.detector,
        seed=search.seed,
        holds_to=found.holds_to,
        fails_at=found.fails_at,
        reason=found.reason,
        also_failed=found.also_failed,
        tested=[
            _tested(strength_at(kind, position), search.verdicts[position], reports(cell))
            for position, cell in sorted(search.tested.items())
        ],
    )


def _tested(strength: float, verdict: str, report: ReportJson | str | None) -> Tested:
    if not isinstance(report, ReportJson):
        return Tested(strength=strength, verdict=verdict)
    return Tested(
        strength=strength,
        verdict=verdict,
        absolute=absolute_verdict(report),
        lost_percent=lost_percent(report),
        ate_rmse_m=report.ate_rmse_m,
        causal_ate_rmse_m=report.causal_ate_rmse_m,
        loops_closed=report.loops_closed if report.loops_missed is not None else None,
    )


def corruption_entries(
    cells: Collection[Cell], reports: Reports, baseline: str
) -> list[CorruptionEntry]:
    """Compute the errors under each corruption of a preset, relative to a baseline.

    The mean corruption error (mCE; Hendrycks and Dietterich, ICLR 2019) is the mean of these
    errors.
    """
    systems = list(dict.fromkeys(cell.detector for cell in cells))
    return [
        _corruption(sequence, name, corruption, cells, reports, systems, baseline)
        for sequence in dict.fromkeys(cell.sequence for cell in cells)
        for name, corruption in CORRUPTIONS.items()
    ]


def _corruption(
    sequence: str,
    name: str,
    corruption: Corruption,
    cells: Collection[Cell],
    reports: Reports,
    systems: list[str],
    baseline: str,
) -> CorruptionEntry:
    sums: dict[str, float | None] = {}
    lost: dict[str, float | None] = {}
    for system in systems:
        ates, losses = [], []
        for spec in corruption.perturbations:
            outcomes = [
                reports(cell)
                for cell in cells
                if (cell.sequence, cell.detector, cell.perturb) == (sequence, system, spec)
            ]
            found = [report for report in outcomes if isinstance(report, ReportJson)]
            known = [report.ate_rmse_m for report in found if report.ate_rmse_m is not None]
            # If failed seeds were left out, a system that fails would look better.
            all_known = bool(known) and len(known) == sum(one is not None for one in outcomes)
            ates.append(statistics.median(known) if all_known else None)
            losses += [lost_percent(report) for report in found]
        complete = bool(ates) and None not in ates
        sums[system] = sum(a for a in ates if a is not None) if complete else None
        lost[system] = statistics.fmean(losses) if losses else None
    base = sums.get(baseline)
    return CorruptionEntry(
        sequence=sequence,
        corruption=name,
        specs=corruption.specs,
        note=corruption.note,
        ate_sum_m=sums,
        error_percent={
            system: 100.0 * value / base if value is not None and base else None
            for system, value in sums.items()
        },
        lost_percent=lost,
    )


def mean_error(entries: Collection[CorruptionEntry], system: str) -> float | None:
    """Compute the mean corruption error (mCE) of a system in percent.

    The mean is over the corruptions for which the errors of all systems are known.
    """
    complete = (e.error_percent for e in entries if None not in e.error_percent.values())
    values = [value for errors in complete if (value := errors.get(system)) is not None]
    return statistics.fmean(values) if values else None
