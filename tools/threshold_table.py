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

from vslam.config import PRESETS, Config

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "thresholds.md"
DESCRIPTION = re.compile(
    r"(?P<text>\S.*\.) "
    r"\[(?P<source>(?:(?:OS1|OS2|ZS)(?: [IVX]+(?:-[A-F])?)?, (?:printed|customary|own))|own)\]"
)
HEAD = """# Thresholds

`vslam/config.py` has all thresholds, from which `python tools/threshold_table.py` writes this page. [The design](../explanation/design.md) describes the methods that use them. There are four ways to change them:

- On the command line: `vslam run --config orb.n_features=1500,tracking.method=orb`.
- In a JSON file: `vslam run --config FILE`, with `{"orb": {"n_features": 1500}}` or `{"orb.n_features": 1500}` in it.
- In Python: `Slam(camera, config={"orb.n_features": 1500})`.
- With a [preset](#presets): `vslam run --config fast,orb.n_features=1000`, or `Slam(camera, config="fast")`.

*Source* names the paper and section of the rule, and where the value comes from: *printed* in this section, *customary* in the programs of the ORB-SLAM family or their configurations for KITTI, or our *own*. OS1 is Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2 is Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017. ZS is Zhou and Sun, Sci Rep 15, 7644 (2025).

Descriptors have 256 bits. Search radii at octave 0 grow with the scale of the pyramid level.

What nobody needs to tune is a constant beside the rule that uses it, with its source: for example, chi-square quantiles, the limit of 60 degrees for the viewing angle of a landmark (OS1 V-D), and the 20 % tolerance of its distance range.
"""  # noqa: E501


class Row(NamedTuple):
    """One threshold. ``text`` contains its meaning and its unit."""

    name: str
    default: str
    text: str
    source: str


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring below each field of a class as one line; empty if it is missing."""
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
    """Return the thresholds in one section of the configuration.

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
    return "\n".join([*lines, *presets()])


def presets() -> list[str]:
    """Return the lines of the section on presets."""
    lines = [
        "## Presets\n",
        "A preset sets several thresholds. All others keep their defaults. The preset `fast` "
        "trades accuracy for speed ([measurements](../research/performance.md#the-preset-fast)).\n",
        "| preset | thresholds |",
        "|---|---|",
    ]
    for name, thresholds in PRESETS.items():
        values = ", ".join(f"`{key}={value}`" for key, value in thresholds.items())
        lines.append(f"| `{name}` | {values} |")
    return [*lines, ""]


if __name__ == "__main__":
    PAGE.write_text(page(Config()))
