"""Write the tables and curves of docs/research/loops from the results of ``vslam loops bench``.

python tools/loop_tables.py loops-bench/loops.json FOLDER
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable
from pathlib import Path

from vslam_lab.loopbench.curves import draw_curves
from vslam_lab.loopbench.report import MEAN, top_figures
from vslam_lab.loopbench.schema import Cost, LoopsJson, OnlineScore, Score

Row = dict[str, str]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("loops", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    report = LoopsJson.model_validate_json(options.loops.read_bytes())
    options.out.mkdir(parents=True, exist_ok=True)
    for name, rows in tables(report).items():
        if rows:
            with (options.out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
                table = csv.DictWriter(file, rows[0], lineterminator="\n")
                table.writeheader()
                table.writerows(rows)
    for figure in draw_curves(report):
        (options.out / f"{figure.name}.png").write_bytes(figure.image)


def tables(report: LoopsJson) -> dict[str, list[Row]]:
    """Return the rows of each table. A table without results in the report has no rows."""
    cells = report.cells
    ordered = [cell for cell in cells if cell.sequence_right is not None]
    return {
        "average_precision": _average_precision(report),
        "recall_precision": _wide(cells, _operating_points),
        "places_found": _wide([cell for cell in cells if cell.verified], _places),
        "f1": _wide(cells, lambda cell: {"": _share(cell.figures["max_f1"])}),
        "accuracy": _wide(cells, _accuracy),
        "sequences": _wide(ordered, _sequence),
        "verification": [_verification(cell) for cell in cells if cell.verified],
        "scores": [_score(cell) for cell in cells],
        "top_k": [_top(cell) for cell in cells if cell.top_average_precision],
        "online": [_online(score) for score in report.online],
        "cost": [_cost(cost) for cost in report.costs],
    }


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


def _operating_points(cell: Score) -> Row:
    names = ("recall_at_100_precision", "precision_at_70_recall")
    return {f"_{name}": _share(cell.figures[name]) for name in names}


def _places(cell: Score) -> Row:
    return {
        "_best_right": _share(cell.first_right),
        "_best_right_verified": _share(cell.verified["orb"].right),
        "_wrong_verified": str(cell.verified["orb"].wrong),
    }


def _accuracy(cell: Score) -> Row:
    return {f"_at_{threshold}": _share(value) for threshold, value in cell.accuracy.items()}


def _sequence(cell: Score) -> Row:
    return {"": _share(cell.first_right), " over sequences": _share(cell.sequence_right)}


def _verification(cell: Score) -> Row:
    row = {"images": cell.data, "condition": cell.condition, "detector": cell.detector}
    row |= {"queries": str(cell.queries), "best_image_right": _share(cell.first_right)}
    for by, found in cell.verified.items():
        row |= {f"{by}_right": _share(found.right), f"{by}_wrong": str(found.wrong)}
    return row


def _score(cell: Score) -> Row:
    precision, recall = cell.accepted or (None, None)
    orb = cell.verified.get("orb")
    return {
        "images": cell.data,
        "condition": cell.condition,
        "detector": cell.detector,
        "average_precision": _share(cell.figures["average_precision"]),
        **{name.removeprefix("_"): text for name, text in _operating_points(cell).items()},
        "precision_at_p_0.9": _share(precision),
        "recall_at_p_0.9": _share(recall),
        "best_right": _share(cell.first_right),
        "best_right_verified": _share(orb and orb.right),
        "wrong_verified": str(orb.wrong) if orb else "",
    }


def _top(cell: Score) -> Row:
    row = {"images": cell.data, "condition": cell.condition, "detector": cell.detector}
    row["average_precision"] = _share(cell.figures["average_precision"])
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
