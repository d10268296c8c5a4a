"""From runs to rows, and from rows to who wins where.

A system is represented on a drive by the median over its runs. Two systems are compared under one
perturbation and over all of them, paired by *sequence*: runs of one sequence are not independent,
and counting each of them would overstate the evidence.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import combinations
from typing import NamedTuple

from vslam.errors import InputError, counted, did_you_mean
from vslam.lab.overview.collect import MONOCULAR, Found, without_settings
from vslam.lab.overview.schema import (
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
from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.machine import versions

ALPHA = 0.05
_KNOWN = ("none", "bow", *NETWORKS, "both")


class Shown(NamedTuple):
    """How an error is printed: the value of the measure times ``scale``."""

    title: str
    unit: str
    scale: float
    decimals: int

    def text(self, value: float, sign: str = "") -> str:
        """The figure without its unit; ``sign`` is ``+`` for differences."""
        return f"{self.scale * value:{sign}.{self.decimals}f}"


COMPARED = {"ate_rmse_m": Shown("ATE", "m", 1.0, 3), "rpe_m": Shown("RPE", "mm", 1e3, 1)}
ROTATION = {"rpe_deg": Shown("RPE", "°", 1.0, 3)}


def summarize(found: Found, baseline: str | None = None) -> OverviewJson:
    """Reduce runs to what the report holds.

    Args:
        found: the runs.
        baseline: the system that the others are compared with; None for the simplest.

    Raises:
        InputError: no run of the baseline.
    """
    names = systems(found.runs, baseline)
    if baseline is not None and not _is_called(names[0], baseline):
        meant = did_you_mean(baseline, names)
        raise InputError(
            f"--baseline {baseline}: no run of it{meant}; choose from {', '.join(names)}."
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
    """Drives whose medians are not of the same rendered towns in all systems."""
    towns: dict[Drive, dict[str, set[int]]] = {}
    for run in runs:
        if run.town is not None:
            towns.setdefault(run.drive, {}).setdefault(run.system, set()).add(run.town)
    for drive, seeds in towns.items():
        if len(set(map(frozenset, seeds.values()))) > 1:
            had = "; ".join(
                f"{system} in {', '.join(map(str, sorted(seeds[system])))}" for system in seeds
            )
            yield f"{drive.place}, {drive.perturb}: runs in towns of different seeds ({had})"


def systems(runs: Iterable[RunEntry | Row], baseline: str | None = None) -> list[str]:
    """The baseline if one is named, monocular or not, then loop detectors from the simplest to the
    most elaborate, then other systems as they came. Of one detector the run without changed
    settings comes first."""
    names = dict.fromkeys(run.system for run in runs)

    def key(name: str) -> tuple[bool, int, bool]:
        plain = without_settings(name)
        place = _KNOWN.index(plain) if plain in _KNOWN else len(_KNOWN)
        return not _is_called(name, baseline), place, name != plain

    return sorted(names, key=key)


def _is_called(system: str, name: str | None) -> bool:
    """Whether ``--baseline`` may call a system so: with its settings or without."""
    return name in {one.removesuffix(MONOCULAR) for one in (system, without_settings(system))}


def make_rows(runs: list[RunEntry]) -> list[Row]:
    """One row for each drive and system, sequences in the order of their names."""
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
    """The second system against the first, by a measure of which less is better.

    Args:
        rows: medians of both, and of others.
        first, second: systems. Errors after different alignments are not compared.
        perturb: a perturbation, or `ALL`: a sequence then counts with its mean over the
            perturbations under which both systems have run on it.
        measure: ``ate_rmse_m`` or ``rpe_m``.

    Returns:
        None where the two share no drive.
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
    better = [
        pair for pair in pairs if pair.difference < 0 and not is_tie(pair.difference, measure)
    ]
    worse = [pair for pair in pairs if pair.difference > 0 and not is_tie(pair.difference, measure)]
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
    """Whether two systems differ by at most half of the last digit that is printed."""
    shown = COMPARED[measure]
    return shown.scale * abs(difference) <= 0.5 * 10.0**-shown.decimals


def strengths(drives: Iterable[Drive], law: str) -> dict[Drive, float]:
    """The strength of a law in each drive that has this law alone; 0 in drives without any law."""
    found = {}
    for drive in drives:
        if drive.perturb == "none":
            found[drive] = 0.0
        elif "," not in drive.perturb and drive.perturb.partition(":")[0] == law:
            found[drive] = _law_and_strength(drive.perturb)[1]
    return found


def least_pairs() -> int:
    """Pairs below which Wilcoxon's two-sided test cannot reach ``ALPHA``, whatever they are."""
    n = 1
    while 2.0 ** (1 - n) > ALPHA:
        n += 1
    return n


def _wilcoxon(differences: list[float]) -> tuple[float | None, bool]:
    """The two-sided p, None where there are too few differences, and whether they tend to be
    negative."""
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
    light = {"none": ", images as they are", ALL: " over all conditions"}.get(
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
    text = f"{beginning} {verdict}. Of {counted(n, 'sequence')}, "
    text += "; ".join(counts) + ". "
    differences = sorted(pair.difference for pair in found.pairs)
    least, greatest = (shown.text(differences[k], "+") for k in (0, -1))
    median = shown.text(found.median_difference, "+")
    text += f"{second} minus {first}: median {median} {shown.unit}"
    text += f" ({least} to {greatest}). " if n > 1 else ". "
    if found.p_value is None:
        return text.rstrip()
    chance = "unlikely to be chance" if found.winner else "may be chance"
    return text + f"Wilcoxon's signed-rank test on {untied}: p = {found.p_value:.3g}, {chance}."


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
