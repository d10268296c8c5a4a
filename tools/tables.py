"""Write the CSV tables of the documentation from the results of benchmarks.

    python tools/tables.py runs bench/report.json [MORE ...] --out runs.csv
    python tools/tables.py pairs runs.csv [MORE ...] --out pairs.csv
    python tools/tables.py loops loops-bench/loops.json --out FOLDER

- ``runs``: a row for each run of ``vslam bench``.
- ``pairs``: Wilcoxon's signed-rank test of each pair of systems, for each perturbation and measure,
  from tables of runs. Only runs on the same images are compared, so a seed of a perturbation counts
  only if both systems were run with it. ``vslam bench`` prints the same tests for its folder.
- ``loops``: the tables and curves of ``vslam loops bench``.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable
from itertools import combinations
from pathlib import Path

from vslam_lab.loopbench.curves import draw_curves
from vslam_lab.loopbench.report import MEAN, top_figures
from vslam_lab.loopbench.schema import Cost, LoopsJson, OnlineScore, Score
from vslam_lab.overview.collect import Found
from vslam_lab.overview.schema import DECIMALS, Comparison, Drive, OverviewJson, RunEntry
from vslam_lab.overview.summary import summarize, systems

Row = dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=("runs", "pairs", "loops"))
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    files, out = options.files, options.out
    if options.kind == "runs":
        reports = [OverviewJson.model_validate_json(path.read_bytes()) for path in files]
        write(out, [run_row(run) for report in reports for run in report.runs])
    elif options.kind == "pairs":
        runs = [run for path in files for run in read_runs(path)]
        pairs = combinations(systems(runs), 2)
        write(out, [pair_row(one) for pair in pairs for one in compared(runs, *pair)])
    else:
        for path in files:
            write_loops(LoopsJson.model_validate_json(path.read_bytes()), out)


def write(path: Path, rows: list[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def run_row(run: RunEntry) -> Row:
    measures = {
        name: "" if run.measures[name] is None else f"{run.measures[name]:.{decimals}f}"
        for name, decimals in DECIMALS.items()
        if name != "fps"  # the speed depends on the load of the machine
    }
    named = {"system": run.system, "seed": run.seed, "town": run.town, "alignment": run.alignment}
    return run.drive.model_dump() | named | {"frames": run.frames} | measures


def read_runs(path: Path) -> list[RunEntry]:
    """Read the runs of a table. Measures that the table does not contain are None."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            RunEntry(
                drive=Drive(**{name: row[name] for name in Drive.model_fields}),
                system=row["system"],
                seed=int(row["seed"]) if row["seed"] else None,
                alignment=row["alignment"],
                frames=int(row["frames"]),
                measures={x: float(row[x]) if row.get(x) else None for x in DECIMALS},
                source=str(path),
                machine=None,
            )
            for row in csv.DictReader(file)
        ]


def compared(runs: list[RunEntry], first: str, second: str) -> list[Comparison]:
    images = [{(one.drive, one.seed) for one in runs if one.system == x} for x in (first, second)]
    both = [
        one
        for one in runs
        if one.system in (first, second) and (one.drive, one.seed) in images[0] & images[1]
    ]
    return summarize(Found(both, [])).comparisons if both else []


def pair_row(found: Comparison) -> Row:
    return {
        "first": found.first,
        "second": found.second,
        "perturb": found.perturb,
        "measure": found.measure,
        "sequences": str(len(found.pairs)),
        "second_smaller": str(found.second_better),
        "first_smaller": str(found.first_better),
        "equal": str(found.ties),
        "median_difference": f"{found.median_difference:.4f}",
        "p_value": "" if found.p_value is None else f"{found.p_value:.3f}",
    }


def write_loops(report: LoopsJson, folder: Path) -> None:
    """Write the tables for which the report has results, and its curves."""
    folder.mkdir(parents=True, exist_ok=True)
    cells = report.cells
    tables = {
        "average_precision": _average_precision(report),
        "places_found": _wide([cell for cell in cells if cell.verified], _places),
        "scores": [_score(cell) for cell in cells],
        "top_k": [_top(cell) for cell in cells if cell.top_average_precision],
        "online": [_online(score) for score in report.online],
        "cost": [_cost(cost) for cost in report.costs],
    }
    for name, rows in tables.items():
        if rows:
            write(folder / f"{name}.csv", rows)
    for figure in draw_curves(report):
        (folder / f"{figure.name}.png").write_bytes(figure.image)


def _share(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _wide(cells: Iterable[Score], columns: Callable[[Score], Row]) -> list[Row]:
    """Make a row for each set of images and each condition. Each detector has its own columns."""
    rows: dict[tuple[str, str], Row] = {}
    for cell in cells:
        row = rows.setdefault(
            (cell.data, cell.condition), {"images": cell.data, "condition": cell.condition}
        )
        row |= {f"{cell.detector}{ending}": text for ending, text in columns(cell).items()}
    return list(rows.values())


def _average_precision(report: LoopsJson) -> list[Row]:
    rows = _wide(report.cells, lambda cell: {"": _share(cell.figures["average_precision"])})
    for gain in report.gains:
        (row,) = (r for r in rows if (r["images"], r["condition"]) == (gain.data, gain.condition))
        certain = gain.low > 0 or gain.high < 0
        row |= {
            f"{gain.second}_minus_{gain.first}": f"{gain.difference:+.3f}",
            f"{gain.second}_low": f"{gain.low:+.3f}",
            f"{gain.second}_high": f"{gain.high:+.3f}",
            f"{gain.second}_beyond_chance": "yes" if certain else "no",
        }
    names = dict.fromkeys(cell.detector for cell in report.cells)
    for condition in dict.fromkeys(cell.condition for cell in report.cells):
        mean = {"images": MEAN, "condition": condition}
        for name in names:
            found = [
                cell.figures["average_precision"]
                for cell in report.cells
                if (cell.condition, cell.detector) == (condition, name)
            ]
            mean[name] = _share(sum(found) / len(found))
        rows.append(mean)
    return [dict.fromkeys(rows[0], "") | row for row in rows]


def _places(cell: Score) -> Row:
    return {
        "_best_right": _share(cell.first_right),
        "_best_right_verified": _share(cell.verified["orb"].right),
        "_wrong_verified": str(cell.verified["orb"].wrong),
    }


def _named(cell: Score) -> Row:
    return {"images": cell.data, "condition": cell.condition, "detector": cell.detector}


def _score(cell: Score) -> Row:
    precision, recall = cell.accepted or (None, None)
    orb = cell.verified.get("orb")
    names = ("average_precision", "recall_at_100_precision", "precision_at_70_recall")
    return {
        **_named(cell),
        **{name: _share(cell.figures[name]) for name in names},
        "precision_at_p_0.9": _share(precision),
        "recall_at_p_0.9": _share(recall),
        "best_right": _share(cell.first_right),
        "best_right_verified": _share(orb and orb.right),
        "wrong_verified": str(orb.wrong) if orb else "",
    }


def _top(cell: Score) -> Row:
    row = _named(cell) | {"average_precision": _share(cell.figures["average_precision"])}
    row |= {f"{name}_average_precision": _share(x) for name, x in top_figures(cell).items()}
    return row | {"best_right": _share(cell.first_right)}


def _online(score: OnlineScore) -> Row:
    values = score.model_dump(exclude={"curve", "max_f1_threshold"})
    return {key: _share(x) if isinstance(x, float) else str(x) for key, x in values.items()}


def _cost(cost: Cost) -> Row:
    return {
        "detector": cost.detector,
        "load_s": f"{cost.load_s:.2f}",
        "image_ms": f"{cost.image_ms:.1f}",
        **{f"query_of_{n}_ms": f"{ms:.2f}" for n, ms in cost.query_ms.items()},
        "parameters_million": f"{cost.parameters / 1e6:.2f}",
        "memory_mb": f"{cost.memory_mb:.0f}",
    }


if __name__ == "__main__":
    main()
