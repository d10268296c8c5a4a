"""Write docs/reference/thresholds.md: every threshold of vslam/config.py with its unit and source.

The docstring below a field ends with the source of the field in brackets. The source has the paper,
the section and the status of the value, as in "[OS1 V-D, customary]". The source is "[own]" if
neither the rule nor the value comes from a paper.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel

from vslam.config import Config

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "thresholds.md"
DESCRIPTION = re.compile(
    r"(?P<text>\S.*\.) "
    r"\[(?P<source>(?:(?:OS1|OS2|ZS)(?: [IVX]+(?:-[A-F])?)?, (?:printed|customary|own))|own)\]"
)
HEAD = """# Thresholds

Written by `python tools/threshold_table.py` from `vslam/config.py`; `tests/test_threshold_table.py` compares the two. `vslam run --config FILE` reads them from a JSON file, `{"orb": {"n_features": 1500}}` or `{"orb.n_features": 1500}`, and `--config orb.n_features=1500,tracking.method=patches` sets them on the command line. In Python they are `Slam(camera, config={"orb.n_features": 1500})`. [design.md](../explanation/design.md) describes the methods.

The source names the paper and section of the rule and says what the value is: *printed* in that section, *customary* in the programs and KITTI configurations of the ORB-SLAM family, or our *own*. OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017. ZS: Zhou and Sun, Sci Rep 15, 7644 (2025). Descriptor distances and ratios of best over second-best distance are upper bounds; a descriptor has 256 bits. A search radius at octave 0 grows with the scale of the pyramid level.

The other numbers of the method are constants in the code: mathematics, numerical tolerances, sizes of arrays and kernels, and numbers that belong to another constant or to trained weights. The most important ones are the chi-square quantiles, the viewing angle of 60 degrees and the search radius 1.6 times as wide for landmarks seen obliquely (OS1 V-D), the distance range of a landmark with 20 % slack, the 30 bins of the orientation check, 3 keyframes of probation for a landmark (OS1 VI-B).
"""  # noqa: E501


class Row(NamedTuple):
    """One threshold: its dotted name, its default, its meaning with the unit, and its source."""

    name: str
    default: str
    text: str
    source: str


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """The docstring below each field of a class, as one line; empty if there is no docstring."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in pairwise([*definition.body, None]):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = ""
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                text = str(below.value.value)
            found[field.target.id] = " ".join(text.split())
    return found


def rows(config: Config, section: str) -> list[Row]:
    """The thresholds of one section.

    Raises:
        ValueError: a docstring is missing or does not end with a source.
    """
    part = getattr(config, section)
    found = []
    for field, text in descriptions(type(part)).items():
        parsed = DESCRIPTION.fullmatch(text)
        if parsed is None:
            raise ValueError(f"{section}.{field}: no source in {text!r}")
        default = str(getattr(part, field))
        found.append(Row(f"{section}.{field}", default, parsed["text"], parsed["source"]))
    return found


def page(config: Config) -> str:
    """The page for a configuration, with the docstring and a table for each section."""
    lines = [HEAD]
    for section in type(config).model_fields:
        title, _, rest = (type(getattr(config, section)).__doc__ or "").partition("\n\n")
        title = " ".join(title.split()).removesuffix(".")
        lines += [f"## `{section}`: {title}\n"]
        lines += [f"{' '.join(rest.split())}\n"] if rest.strip() else []
        lines += ["| name | default | what it is | source |", "|---|---|---|---|"]
        lines += [
            f"| `{row.name}` | {row.default} | {row.text} | {row.source} |"
            for row in rows(config, section)
        ]
        lines += [""]
    return "\n".join(lines).rstrip("\n") + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(Config()))
