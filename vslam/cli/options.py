"""Options that several commands share. The words that they allow are checked by the parser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from vslam import plugins
from vslam.errors import InputError

if TYPE_CHECKING:
    from vslam.datasets.sources import SourceOptions


def _with_plugins(names: tuple[str, ...], group: str) -> tuple[str, ...]:
    """vslam's own names, then those of other packages (docs/howto/plugins.md)."""
    return (*names, *(name for name in plugins.find_plugins(group) if name not in names))


_DATASETS = _with_plugins(("kitti", "euroc", "tum", "synthetic"), plugins.READERS)
_SOURCES = ("images", "video", "bag", "camera")
_DETECTORS = _with_plugins(
    (
        "none", "bow", "both", "capsule", "capsule-pruned", "capsule-paper", "alexnet", "vgg16",
        "darknet19", "googlenet", "mobilenet", "squeezenet", "pcanet",
    ),
    plugins.DETECTORS,
)  # fmt: skip
_LAWS = _with_plugins(
    (
        "brightness", "gamma", "flicker", "noise", "blur", "occlusion", "fog", "rain", "night",
        "exposure", "motion", "flare", "vignetting", "dirt", "jpeg", "resolution", "drop",
        "outage", "bias", "contrast", "shot", "impulse", "bits", "stereo_gain", "desync",
        "baseline", "yaw", "pitch", "black_right", "black_left",
    ),
    plugins.PERTURBATIONS,
)  # fmt: skip

Data = Annotated[
    Path,
    typer.Option(envvar="KITTI_ROOT", help="Folder with the data set, see datasets.md."),
]
if TYPE_CHECKING:
    DatasetName = str
    SourceName = str
    DetectorName = str
else:  # what is installed decides
    DatasetName = Literal[_DATASETS]
    SourceName = Literal[(*_DATASETS, *_SOURCES)]
    DetectorName = Literal[_DETECTORS]
Dataset = Annotated[DatasetName, typer.Option(help="Data set.")]
Source = Annotated[
    str,
    typer.Option(
        "--data",
        envvar="KITTI_ROOT",
        help="Data set, folder of images, video, bag, number of a camera or URL, see "
        "docs/howto/sources.md.",
    ),
]
SourceKind = Annotated[
    SourceName | None,
    typer.Option("--dataset", help="What it is.", show_default="found out from what is there"),
]
Seq = Annotated[
    str | None,
    typer.Option(
        help="Sequence of a data set, 00 for example.",
        show_default="00; of euroc and tum the only one there",
    ),
]
Calib = Annotated[
    list[Path] | None,
    typer.Option(
        "--calib",
        help="Calibration to rectify images with, see docs/howto/cameras.md; twice for a file of "
        "each camera, left first.",
    ),
]
Right = Annotated[
    Path | None, typer.Option(help="Folder of the right images, --data has the left ones.")
]
Depth = Annotated[
    Path | None,
    typer.Option(help="Folder of the depth images, --data has the images they belong to."),
]
FramesPerSecond = Annotated[
    float | None,
    typer.Option("--fps", help="Frames a second of images or a video without time stamps."),
]
SideBySide = Annotated[
    bool, typer.Option("--side-by-side", help="Video or camera of both sides in one image.")
]
Topics = Annotated[
    str,
    typer.Option(
        metavar="LEFT,RIGHT", help="Image topics of a bag: one with mono, COLOUR,DEPTH with rgbd."
    ),
]
DepthScale = Annotated[
    float | None,
    typer.Option(
        help="What depth images count in a metre.",
        show_default="the calibration's; of tum 5000, of a bag as its encoding says",
    ),
]
Perturb = Annotated[
    str,
    typer.Option(
        help="Laws of light, weather, glass, sensor and stereo rig, each with a strength in its "
        f"unit (docs/howto/stress.md), joined by commas: {', '.join(_LAWS)}. Example: "
        "[b]brightness:1.5,fog:60[/b]"
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
SensorName = Literal["stereo", "mono", "rgbd"]
ViewerName = Literal["native", "web"]
Sensor = Annotated[
    SensorName | None,
    typer.Option(
        help="[b]mono[/b] reads the left camera alone; its scale is arbitrary.",
        show_default="all that the data has",
    ),
]
AlignmentName = Literal["se3", "sim3", "none"]

KITTI_ROOT = Path("data/kitti")


def names_in(text: str) -> list[str]:
    """The names that commas separate, each once, in the order given."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def kind_of_source(named: SourceName | None, data: str) -> str:
    """What ``--dataset`` says, or what is found at ``--data``; KITTI where neither was given.

    Raises:
        InputError: nothing there, or nothing known.
    """
    from vslam.datasets.detection import detect_dataset

    if named is not None:
        return named
    return "kitti" if data == str(KITTI_ROOT) else detect_dataset(data)


def source_options(
    calib: list[Path] | None,
    right: Path | None,
    depth: Path | None,
    fps: float | None,
    side_by_side: bool,
    topics: str,
    depth_scale: float | None,
) -> SourceOptions:
    """What some kinds of sources need to be told.

    Raises:
        InputError: a rate or scale that is no positive number.
    """
    from vslam.datasets.sources import SourceOptions

    for option, value in (("--fps", fps), ("--depth-scale", depth_scale)):
        if value is not None and not 0.0 < value < float("inf"):
            raise InputError(f"{option} {value}: must be a positive number.")
    return SourceOptions(
        calib or (), right, depth, fps, side_by_side, tuple(names_in(topics)), depth_scale
    )
