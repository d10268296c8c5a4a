"""The command ``vslam perturb``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import KITTI_ROOT, Data, Dataset, Every, MaxFrames, Perturb, Seed, Seq, Start
from vslam.errors import InputError

_EXAMPLE = "[b]Example[/b]\n\n  vslam perturb --seq 00 --perturb brightness:1.5 --out sheet.png"


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command("perturb", epilog=_EXAMPLE)(preview)


def preview(
    data: Data = KITTI_ROOT,
    dataset: Dataset = "kitti",
    seq: Seq = None,
    perturb: Perturb = "brightness",
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    seed: Seed = 0,
    frames: Annotated[int, typer.Option(min=1, help="Frames to show, evenly spread.")] = 8,
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("perturbation.png"),
) -> None:
    """Preview a perturbation: the left image as it is beside both images perturbed."""
    import cv2
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.datasets.perturbation import contact_sheet, parse_perturbation

    sequence = open_sequence(dataset, data, seq, start=start, every=every, max_frames=max_frames)
    law = parse_perturbation(perturb, seed)
    shown = np.unique(np.linspace(0, len(sequence) - 1, frames).round().astype(int)).tolist()
    sheet = cv2.imencode(".png", contact_sheet(sequence, law, shown))[1]
    try:
        out.write_bytes(sheet.tobytes())
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); name another file with --out."
        ) from error
    typer.echo(f"{out}: {law.name}, seed {seed}, frames {', '.join(map(str, shown))}")
