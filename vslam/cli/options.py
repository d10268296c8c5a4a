"""Options that several commands share. The words that they allow are checked by the parser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Data = Annotated[
    Path,
    typer.Option(envvar="KITTI_ROOT", help="Folder with the data set, see datasets.md."),
]
DatasetName = Literal["kitti", "synthetic"]
Dataset = Annotated[DatasetName, typer.Option(help="Data set.")]
Seq = Annotated[str, typer.Option(help="Sequence, 00 for example.")]
Perturb = Annotated[
    str,
    typer.Option(
        help="Photometric laws, each with a strength, joined by commas: brightness, gamma, "
        "flicker, noise, blur, occlusion. Example: [b]brightness:1.5,blur:0.5[/b]"
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all that is random.")]
Start = Annotated[int, typer.Option(min=0, help="First frame.")]
Every = Annotated[int, typer.Option(min=1, help="Take every N-th frame.")]
MaxFrames = Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")]
Thresholds = Annotated[
    Path | None,
    typer.Option("--config", help="JSON file with thresholds, as config.json of a run."),
]
Weights = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=FILE", help="Weights of a detector, not the shipped ones."),
]
DetectorName = Literal[
    "none", "bow", "both", "capsule", "capsule-pruned", "alexnet", "vgg16", "darknet19",
    "googlenet", "mobilenet", "squeezenet", "pcanet",
]  # fmt: skip
SensorName = Literal["stereo", "mono"]
AlignmentName = Literal["se3", "sim3", "none"]

KITTI_ROOT = Path("data/kitti")


def names_in(text: str) -> list[str]:
    """The names that commas separate, each once, in the order given."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
