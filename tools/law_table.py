"""Write docs/howto/laws.csv: every law of ``--perturb`` with its unit and range.

python tools/law_table.py            # writes it
python tools/law_table.py --check    # exits 1 if the file differs
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from pathlib import Path

from vslam.datasets.perturbation import LAWS

TABLE = Path(__file__).parents[1] / "docs" / "howto" / "laws.csv"


def table() -> str:
    """A row for each law; ``vslam stress`` searches between the weakest and strongest value."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["law", "unit", "default", "weakest", "strongest", "random", "needs", "sides", "what"]
    )
    for name, kind in LAWS.items():
        numbers = (f"{x:g}" for x in (kind.default, kind.weakest, kind.strongest))
        drawn = "yes" if kind.drawn else "no"
        needs = " ".join(kind.needs)
        writer.writerow([name, kind.unit, *numbers, drawn, needs, kind.sides, kind.about])
    return text.getvalue()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--check", action="store_true", help="compare, do not write")
    if parser.parse_args().check:
        sys.exit(TABLE.read_text() != table())
    TABLE.write_text(table())


if __name__ == "__main__":
    main()
