"""Summarizes many runs, and compares systems.

Each system is represented by the median over its runs on a drive. A comparison pairs the errors of
two systems by *sequence*, and not by run. Runs on the same sequence are not independent, and
treating them as independent samples would overstate the evidence.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import combinations
from typing import NamedTuple

from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.support.errors import InputError, counted, did_you_mean
from vslam.support.machine import versions
from vslam_lab.overview.collect import MONOCULAR, Found, without_settings
from vslam_lab.overview.schema import (
    ALL,
    MEASURES,
    Comparison,
    Drive,
    OverviewJson,
    Pair,
    Row,
    RunEntry,
    Spread,
)

ALPHA = 0.05
_KNOWN = ("none", "bow", *NETWORKS, "both")


class Shown(NamedTuple):
    """The format of a printed error. The error times ``scale`` is the printed value in ``unit``."""

    title: str
    unit: str
    scale: float
    decimals: int

    def text(self, value: float, sign: str = "") -> str:
        """Format an error without its unit. Pass ``+`` as ``sign`` to format a difference."""
        return f"{self.scale * value:{sign}.{self.decimals}f}"


COMPARED = {"ate_rmse_m": Shown("ATE", "m", 1.0, 3), "rpe_m": Shown("RPE", "mm", 1e3, 1)}
ROTATION = {"rpe_deg": Shown("RPE", "°", 1.0, 3)}


def summarize(found: Found, baseline: str | None = None) -> OverviewJson:
    """Compute the content of the report of many runs.

    Args:
        baseline: the system with which the others are compared; None for the simplest system.

    Raises:
        InputError: there is no run of the baseline.
    """
    names = systems(found.runs, baseline)
    if baseline is not None and not _is_called(names[0], baseline):
        meant = did_you_mean(baseline, names)
        raise InputError(
            f"--baseline {baseline}: there is no such run{meant}; choose from {', '.join(names)}."
        )
    rows = make_rows(found.runs)
    laws = list(dict.fromkeys(row.drive.perturb for row in rows))
    compared: list[Comparison] = []
    for first, second in combinations(names, 2):
        for measure in COMPARED:
            under = [compare(rows, first, second, law, measure) for law in laws]
            compared += (known := [one for one in under if one is not None])
            if len(known) > 1 and (all_ := compare(rows, first, second, ALL, measure)) is not None:
                compared.append(all_)
    order = {(row.drive, row.system): k for k, row in enumerate(rows)}
    return OverviewJson(
        notes=[*found.notes, *_unlike_towns(found.runs)],
        systems=names,
        rows=rows,
        comparisons=compared,
        runs=sorted(found.runs, key=lambda run: order[run.drive, run.system]),
        versions=versions(),
        created=datetime.now(UTC).replace(microsecond=0),
    )


def _unlike_towns(runs: Iterable[RunEntry]) -> Iterator[str]:
    """Yield a note for each drive for which the systems were run in different rendered towns."""
    towns: dict[Drive, dict[str, set[int]]] = {}
    for run in runs:
        if run.town is not None:
            towns.setdefault(run.drive, {}).setdefault(run.system, set()).add(run.town)
    for drive, seeds in towns.items():
        if len(set(map(frozenset, seeds.values()))) > 1:
            lists = "; ".join(
                f"{system} in {', '.join(map(str, sorted(seeds[system])))}" for system in seeds
            )
            yield f"{drive.place}, {drive.perturb}: systems ran in different towns ({lists})"


def systems(runs: Iterable[RunEntry | Row], baseline: str | None = None) -> list[str]:
    """Return the names of the systems in the order in which the report lists them.

    The baseline is first. The loop detectors of vslam follow, from the simplest to the most
    elaborate one. Other SLAM systems are at the end. A detector with default settings precedes the
    same detector with other settings.
    """
    names = dict.fromkeys(run.system for run in runs)

    def key(name: str) -> tuple[bool, int, bool]:
        plain = without_settings(name)
        place = _KNOWN.index(plain) if plain in _KNOWN else len(_KNOWN)
        return not _is_called(name, baseline), place, name != plain

    return sorted(names, key=key)


def _is_called(system: str, name: str | None) -> bool:
    """Return whether a name that the user gave refers to a system.

    The name may omit the settings of the system and the suffix ``, mono``.
    """
    return name in {one.removesuffix(MONOCULAR) for one in (system, without_settings(system))}


def make_rows(runs: list[RunEntry]) -> list[Row]:
    """Summarize the runs in one row for each drive and system, sorted by the sequence's name."""
    groups: dict[tuple[Drive, str], list[RunEntry]] = {}
    for run in runs:
        groups.setdefault((run.drive, run.system), []).append(run)
    order = systems(runs)

    def key(group: tuple[Drive, str]) -> tuple[object, ...]:
        drive, system = group
        light = tuple(_law_and_strength(law) for law in drive.perturb.split(","))
        return drive.dataset, drive.sequence, drive.excerpt, light, order.index(system)

    return [
        Row(
            drive=drive,
            system=system,
            alignment=members[0].alignment,
            runs=len(members),
            frames=max(run.frames for run in members),
            measures={
                name: _spread(run.measures[name] for run in members) for name, *_ in MEASURES
            },
        )
        for (drive, system), members in sorted(groups.items(), key=lambda item: key(item[0]))
    ]


def compare(
    rows: list[Row], first: str, second: str, perturb: str, measure: str
) -> Comparison | None:
    """Compare the errors of two systems, paired by sequence.

    Errors that were computed after different alignments are not compared.

    Args:
        rows: for each drive and system, the medians over the runs. Rows of other systems are
            ignored.
        first, second: names of the systems.
        perturb: a perturbation, or `ALL`. With `ALL`, the error on a sequence is the mean over the
            perturbations for which there are runs of both systems.
        measure: ``ate_rmse_m`` or ``rpe_m``.

    Returns:
        The comparison; None if there is no drive for which there are runs of both systems.
    """
    medians: dict[str, dict[tuple[Drive, str], float]] = {first: {}, second: {}}
    for row in rows:
        spread = row.measures[measure]
        if row.system in medians and perturb in (row.drive.perturb, ALL) and spread is not None:
            medians[row.system][row.drive, row.alignment] = spread.median
    values: dict[tuple[Drive, str], list[tuple[float, float]]] = {}
    for (drive, alignment), value in medians[first].items():
        if (drive, alignment) in medians[second]:
            sequence = drive.model_copy(update={"perturb": perturb}), alignment
            values.setdefault(sequence, []).append((value, medians[second][drive, alignment]))
    if not values:
        return None
    pairs = []
    for (drive, _), both in values.items():
        a, b = (statistics.fmean(column) for column in zip(*both, strict=True))
        pairs.append(Pair(drive=drive, first=a, second=b, difference=b - a))
    different = [pair for pair in pairs if not is_tie(pair.difference, measure)]
    better = [pair for pair in different if pair.difference < 0]
    worse = [pair for pair in different if pair.difference > 0]
    p_value, second_is_less = _wilcoxon([pair.difference for pair in (*better, *worse)])
    winner = None
    if p_value is not None and p_value < ALPHA:
        winner = second if second_is_less else first
    found = Comparison(
        measure=measure,
        perturb=perturb,
        first=first,
        second=second,
        pairs=pairs,
        second_better=len(better),
        first_better=len(worse),
        ties=len(pairs) - len(better) - len(worse),
        median_difference=statistics.median(pair.difference for pair in pairs),
        p_value=p_value,
        winner=winner,
        words="",
    )
    return found.model_copy(update={"words": _words(found, better, worse)})


def is_tie(difference: float, measure: str) -> bool:
    """Return whether two errors differ by at most half a unit of the last printed digit."""
    shown = COMPARED[measure]
    return shown.scale * abs(difference) <= 0.5 * 10.0**-shown.decimals


def strengths(drives: Iterable[Drive], law: str) -> dict[Drive, float]:
    """Return the strength of a perturbation for each drive that has no other perturbation.

    The strength is 0 for unperturbed drives.

    Args:
        law: name of the perturbation, without strength.
    """
    found = {}
    for drive in drives:
        if drive.perturb == "none":
            found[drive] = 0.0
        elif "," not in drive.perturb and drive.perturb.partition(":")[0] == law:
            found[drive] = _law_and_strength(drive.perturb)[1]
    return found


def least_pairs() -> int:
    """Return the smallest number of pairs with which Wilcoxon's test can be significant.

    The test is two-sided, and its significance level is ``ALPHA``.
    """
    return math.ceil(1.0 - math.log2(ALPHA))


def _wilcoxon(differences: list[float]) -> tuple[float | None, bool]:
    """Perform Wilcoxon's signed-rank test (two-sided) on paired differences.

    Returns the p-value, and whether the differences tend to be negative. The p-value is None if
    there are too few differences.
    """
    if len(differences) < least_pairs():
        return None, False
    from scipy.stats import wilcoxon

    less = float(wilcoxon(differences, alternative="less").pvalue)
    return float(wilcoxon(differences).pvalue), less < 0.5


def _words(found: Comparison, better: list[Pair], worse: list[Pair]) -> str:
    def named(some: list[Pair]) -> str:
        return ", ".join(pair.drive.place for pair in some)

    first, second, shown = found.first, found.second, COMPARED[found.measure]
    what = shown.title
    light = {"none": ", unperturbed images", ALL: " over all conditions"}.get(
        found.perturb, f", {found.perturb}"
    )
    n, untied = len(found.pairs), len(better) + len(worse)
    ties = [pair for pair in found.pairs if pair not in better and pair not in worse]
    counts = [
        f"{who} has the smaller {what} on {len(some)} ({named(some)})"
        for who, some in ((second, better), (first, worse))
        if some
    ]
    counts += [f"no difference on {len(ties)} ({named(ties)})"] if ties else []
    beginning = f"{what}{light}, {second} against {first}:"
    if not untied:
        return f"{beginning} a tie on {f'all {n} sequences' if n > 1 else 'the only sequence'}."
    verdict = f"{found.winner} wins" if found.winner else "no winner"
    text = f"{beginning} {verdict}. Of {counted(n, 'sequence')}, {'; '.join(counts)}. "
    differences = sorted(pair.difference for pair in found.pairs)
    least, greatest = (shown.text(differences[k], "+") for k in (0, -1))
    median = shown.text(found.median_difference, "+")
    text += f"{second} minus {first}: median {median} {shown.unit}"
    text += f" ({least} to {greatest}). " if n > 1 else ". "
    if found.p_value is None:
        return text.rstrip()
    chance = "unlikely to be chance" if found.winner else "may be chance"
    return (
        f"{text}Wilcoxon's signed-rank test on {untied} sequences: p = {found.p_value:.3g}, "
        f"{chance}."
    )


def _spread(values: Iterable[float | None]) -> Spread | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return Spread(
        n=len(known), median=statistics.median(known), least=min(known), greatest=max(known)
    )


def _law_and_strength(text: str) -> tuple[str, float]:
    law, _, strength = text.partition(":")
    return ("" if law == "none" else law), float(strength or 0.0)
