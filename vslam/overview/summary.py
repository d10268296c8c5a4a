"""From runs to rows, and from rows to who wins where.

A system's figure on a drive is the median over its runs. Two systems are compared under one
perturbation, and what is paired are *sequences*: runs of one sequence are not independent, and
counting each of them would make the test believe in more than it has seen.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from itertools import combinations

from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.machine import versions
from vslam.overview.collect import Found
from vslam.overview.schema import (
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
# Differences below this are ties: the last digit that is printed.
_TIES = {"ate_rmse_m": 0.0005}


def summarize(found: Found) -> OverviewJson:
    """All that the report says."""
    rows = make_rows(found.runs)
    compared = [
        comparison
        for first, second in combinations(systems(found.runs), 2)
        for perturb in dict.fromkeys(row.drive.perturb for row in rows)
        if (comparison := compare(rows, first, second, perturb, "ate_rmse_m")) is not None
    ]
    order = {(row.drive, row.system): k for k, row in enumerate(rows)}
    return OverviewJson(
        notes=[*found.notes, *_unlike_towns(found.runs)],
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


def systems(runs: Iterable[RunEntry | Row]) -> list[str]:
    """Loop detectors from the simplest to the most elaborate, then other systems as they came."""
    names = dict.fromkeys(run.system for run in runs)
    return sorted(names, key=lambda name: _KNOWN.index(name) if name in _KNOWN else len(_KNOWN))


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
    """The second system against the first, by the medians of a measure of which less is better;
    None where they share no drive. Errors after different alignments are not compared."""
    medians: dict[str, dict[tuple[Drive, str], float]] = {first: {}, second: {}}
    for row in rows:
        spread = row.measures[measure]
        if row.system in medians and row.drive.perturb == perturb and spread is not None:
            medians[row.system][row.drive, row.alignment] = spread.median
    pairs = [
        Pair(
            drive=key[0], first=a, second=medians[second][key], difference=medians[second][key] - a
        )
        for key, a in medians[first].items()
        if key in medians[second]
    ]
    if not pairs:
        return None
    threshold = _TIES.get(measure, 0.0)
    better = [pair for pair in pairs if pair.difference < -threshold]
    worse = [pair for pair in pairs if pair.difference > threshold]
    p_value = _wilcoxon([pair.difference for pair in (*better, *worse)])
    return Comparison(
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
        words=_words(first, second, perturb, pairs, better, worse, p_value),
    )


def strengths(drives: Iterable[Drive], law: str) -> dict[Drive, float]:
    """Drives with this law alone, or with none, and how strong it is there."""
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


def _wilcoxon(differences: list[float]) -> float | None:
    if len(differences) < least_pairs():
        return None
    from scipy.stats import wilcoxon

    return float(wilcoxon(differences).pvalue)


def _words(
    first: str,
    second: str,
    perturb: str,
    pairs: list[Pair],
    better: list[Pair],
    worse: list[Pair],
    p_value: float | None,
) -> str:
    def named(some: list[Pair]) -> str:
        return ", ".join(pair.drive.place for pair in some)

    n = len(pairs)
    light = "images as they are" if perturb == "none" else perturb
    ties = [pair for pair in pairs if pair not in better and pair not in worse]
    parts = [
        f"{who} has the smaller ATE on {len(some)} ({named(some)})"
        for who, some in ((second, better), (first, worse))
        if some
    ]
    parts += [f"no difference on {len(ties)} ({named(ties)})"] if ties else []
    differences = sorted(pair.difference for pair in pairs)
    text = f"{light}: of {n} sequence{'s' if n > 1 else ''}, {'; '.join(parts)}. "
    text += f"{second} minus {first}: median {statistics.median(differences):+.3f} m"
    text += f" ({differences[0]:+.3f} to {differences[-1]:+.3f}). " if n > 1 else ". "
    untied = len(better) + len(worse)
    if p_value is None:
        return text + (
            f"Too few sequences differ ({untied}) for Wilcoxon's test, which takes {least_pairs()} "
            f"to reach p < {ALPHA:g}: no claim about others."
        )
    verdict = "unlikely by chance" if p_value < ALPHA else "chance alone may do this"
    return text + f"Wilcoxon's signed-rank test on {untied}: p = {p_value:.3g}, {verdict}."


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
