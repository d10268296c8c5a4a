"""The command ``vslam perturb``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.console import Console
from vslam.cli.options import Perturb, Seed, flag, open_given, option, reads_source
from vslam.support.errors import write_file
from vslam.support.options import OUTPUT

if TYPE_CHECKING:
    from vslam.types.source_options import SourceOptions

_EXAMPLE = """
[b]Examples[/b]
  vslam perturb --list
  vslam perturb --seq 00 --perturb brightness:1.5 --out sheet.png
  vslam perturb --seq 00 --perturb all --start 100
"""


app = typer.Typer()


@app.command("perturb", epilog=_EXAMPLE)
@reads_source(without=("mask", "imu", "imu_topics"))
def preview(
    given: SourceOptions,
    perturb: Perturb = "brightness",
    seed: Seed = 0,
    frames: Annotated[int, option(OUTPUT, "N", "Number of evenly spaced frames.", min=1)] = 8,
    out: Annotated[Path, option(OUTPUT, "FILE", "PNG file to write.")] = Path("perturbation.png"),
    list_: Annotated[
        bool,
        flag(
            OUTPUT,
            "Only list the perturbations and their default strengths.",
            "--list",
        ),
    ] = False,
) -> None:
    """Write a picture of a perturbation.

    Each row shows the original and the perturbed images of a frame. [b]--perturb all[/b] shows one
    frame under every perturbation at its default strength.
    """
    if list_:
        _list_laws()
        return
    import cv2
    import numpy as np

    from vslam.datasets.frames import first_frames
    from vslam.datasets.perturbation import (
        contact_sheet,
        law_kind,
        laws_for,
        parse_perturbation,
        sheet_of_laws,
    )
    from vslam.maps.new_output import require_place

    require_place(out, "--out")
    name = perturb if perturb == "all" else parse_perturbation(perturb, seed).name
    opened = open_given(given, Console(shown=True))
    sequence = first_frames(opened)
    if perturb == "all":
        fit, unfit = laws_for(opened)
        for why in unfit.values():
            typer.echo(f"left out: {why}", err=True)
        shown = [min(10, len(sequence) - 1)]
        kinds = {law: law_kind(law) for law in fit}
        specs = [f"{law}:{kind.default:g}" for law, kind in kinds.items() if not kind.of_imu]
        image = sheet_of_laws(sequence, specs, shown[0], seed)
    else:
        shown = np.unique(np.linspace(0, len(sequence) - 1, frames).round().astype(int)).tolist()
        image = contact_sheet(
            sequence, parse_perturbation(perturb, seed), shown, given.start, given.every
        )
    write_file(out, cv2.imencode(".png", image)[1].tobytes(), "give another file with --out")
    frames_shown = ", ".join(str(given.start + given.every * frame) for frame in shown)
    typer.echo(f"{out}: {name}, seed {seed}, frames {frames_shown}")


def _list_laws() -> None:
    from vslam.cli.tables import show_sections
    from vslam.datasets.perturbation import all_laws
    from vslam.report.page import Section, Table

    rows = [(name, f"{kind.default:g}", kind.unit, kind.about) for name, kind in all_laws().items()]
    head = ("perturbation", "default", "unit", "what it does")
    show_sections([Section("", [Table(head, rows, (head[0], *head[2:]))])])
