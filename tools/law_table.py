"""Write docs/howto/laws.csv: every kind of perturbation with its unit and range."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from vslam.datasets.perturbation import LAWS

TABLE = Path(__file__).parents[1] / "docs" / "howto" / "laws.csv"


def table() -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["law", "unit", "default", "weakest", "strongest", "random", "needs", "sides", "what"]
    )
    for name, kind in LAWS.items():
        numbers = (f"{x:g}" for x in (kind.default, kind.weakest, kind.strongest))
        drawn = "yes" if kind.drawn else "no"
        needs = " ".join(kind.needs)
        sides = "" if kind.of_imu else kind.sides
        writer.writerow([name, kind.unit, *numbers, drawn, needs, sides, kind.about])
    return text.getvalue()


if __name__ == "__main__":
    TABLE.write_text(table())
