"""Options that several commands share, and the data source that they describe."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from vslam import plugins
from vslam.errors import InputError

if TYPE_CHECKING:
    from vslam.cli.console import Console
    from vslam.config import Config
    from vslam.datasets.frames import Source
    from vslam.datasets.sources import SourceOptions


def _with_plugins(names: tuple[str, ...], group: str) -> tuple[str, ...]:
    """vslam's own names, then those of other packages (docs/howto/plugins.md)."""
    return (*names, *(name for name in plugins.find_plugins(group) if name not in names))


_DATASETS = _with_plugins(("kitti", "euroc", "tum", "synthetic"), plugins.READERS)
_SOURCES = ("images", "video", "bag", "camera")
DETECTOR_NAMES = _with_plugins(
    (
        "none", "bow", "both", "capsule", "capsule-pruned", "capsule-paper", "alexnet", "vgg16",
        "darknet19", "googlenet", "mobilenet", "squeezenet", "pcanet",
    ),
    plugins.DETECTORS,
)  # fmt: skip
if TYPE_CHECKING:
    SourceName = str
    DetectorName = str
else:  # installed packages add names
    SourceName = Literal[(*_DATASETS, *_SOURCES)]
    DetectorName = Literal[DETECTOR_NAMES]
# Panels of --help.
INPUT, METHOD, MAP, OUTPUT, EXECUTION = "Input", "Method", "Map", "Output", "Execution"

Perturb = Annotated[
    str,
    typer.Option(
        metavar="LAWS",
        help="Perturbations, each with a strength, such as [b]fog:60,blur:0.5[/b]; [b]vslam "
        "perturb --list[/b] shows them all.",
        rich_help_panel=METHOD,
    ),
]
Seed = Annotated[
    int,
    typer.Option(min=0, metavar="N", help="Seed of the random numbers.", rich_help_panel=METHOD),
]
Thresholds = Annotated[
    str | None,
    typer.Option(
        "--config",
        metavar="FILE|NAME=VALUE",
        help="Thresholds: a JSON file, such as the config.json of a run, or values separated by "
        "commas, such as orb.n_features=1000 (docs/reference/thresholds.md).",
        rich_help_panel=METHOD,
    ),
]
Weights = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FILE",
        help="Weights of a detector in place of the shipped ones; repeat for more.",
        rich_help_panel=METHOD,
    ),
]
Seeds = Annotated[
    int,
    typer.Option(
        min=1, metavar="N", help="Seeds of each random perturbation.", rich_help_panel=METHOD
    ),
]
Jobs = Annotated[
    int,
    typer.Option(
        min=1,
        metavar="N",
        help="Runs at a time. Only with 1 are the frames per second comparable.",
        rich_help_panel=EXECUTION,
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Threads; they do not change the result.",
        show_default="all cores, at most 4",
        rich_help_panel=EXECUTION,
    ),
]
AllThreads = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Threads; they do not change the result.",
        show_default="all cores",
        rich_help_panel=EXECUTION,
    ),
]
ThreadsOfRun = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Threads of each run.",
        show_default="the cores shared by --jobs, at most 4",
        rich_help_panel=EXECUTION,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Dask scheduler, such as tcp://HOST:8786, whose workers do the runs.",
        rich_help_panel=EXECUTION,
    ),
]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", help="Show no progress and no summary.", rich_help_panel=OUTPUT),
]
SensorName = Literal["stereo", "mono", "rgbd"]
ViewerName = Literal["native", "web"]
AlignmentName = Literal["se3", "sim3", "none"]

KITTI_ROOT = "data/kitti"  # unless $KITTI_ROOT names another folder

_WITHOUT_DATA = """there is nothing to read; name your images, or use rendered ones:
  --dataset synthetic    rendered drives, which need no download
  DATA --calib FILE      images, video, bag or camera (docs/howto/sources.md)
  --data FOLDER          KITTI; or set $KITTI_ROOT to its folder (datasets.md)"""


def names_in(text: str) -> list[str]:
    """The names in a list with commas, without repetitions, in their order."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def kitti_root() -> str:
    """The folder of KITTI's data if no option names one."""
    return os.environ.get("KITTI_ROOT") or KITTI_ROOT


def sequences(default: str) -> Any:
    """The option ``--seqs`` of a command whose default is ``default``."""
    return typer.Option(
        metavar="LIST",
        help="Sequences of a data set, such as 00-05 or 00,demo.",
        show_default=f"{default}; the only one of EuRoC and TUM",
        rich_help_panel=INPUT,
    )


def _source_options(
    source: Annotated[
        str | None,
        typer.Argument(help="What to read; the same as [b]--data[/b].", show_default=False),
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            help="Data set, folder of images, video, bag, or a camera's number or URL "
            "(docs/howto/sources.md).",
            show_default="$KITTI_ROOT, else data/kitti",
        ),
    ] = None,
    dataset: Annotated[
        SourceName | None,
        typer.Option(
            metavar="KIND",
            help=f"Kind of data: {', '.join((*_DATASETS, *_SOURCES))}.",
            show_default="detected from the files",
        ),
    ] = None,
    seq: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Sequence of a data set.",
            show_default="00; the only one of EuRoC and TUM",
        ),
    ] = None,
    calib: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Calibration of the cameras (docs/howto/cameras.md). Give it twice for one file "
            "per camera, the left one first.",
        ),
    ] = None,
    right: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Right images; [b]--data[/b] then names the left ones."
        ),
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Depth images; [b]--data[/b] then names the grey or colour ones."
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Frames per second where the data has no time stamps."),
    ] = None,
    side_by_side: Annotated[
        bool,
        typer.Option("--side-by-side", help="Each image holds the left and the right one."),
    ] = False,
    topics: Annotated[
        str,
        typer.Option(
            metavar="LEFT,RIGHT",
            help="Image topics of a bag: one for mono, COLOUR,DEPTH for RGB-D.",
        ),
    ] = "",
    depth_scale: Annotated[
        float | None,
        typer.Option(
            metavar="NUMBER",
            help="Value of a depth pixel at one metre.",
            show_default="from the calibration, data set or encoding",
        ),
    ] = None,
    sensor: Annotated[
        SensorName | None,
        typer.Option(
            metavar="stereo|mono|rgbd",
            help="Images to use. With [b]mono[/b], the left ones alone, the scale is arbitrary.",
            show_default="all that the data has",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER",
            help="Image that is black where the left images are not to be used, or a folder of one "
            "for each image (docs/howto/masks.md).",
        ),
    ] = None,
    start: Annotated[int, typer.Option(min=0, metavar="N", help="First frame.")] = 0,
    every: Annotated[int, typer.Option(min=1, metavar="N", help="Use every N-th frame only.")] = 1,
    max_frames: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Stop after N frames.", show_default="all"),
    ] = None,
) -> SourceOptions:
    """The source that the options describe."""
    from vslam.datasets.sources import SourceOptions

    if source is not None and data is not None:
        raise InputError(f"{source}: --data also names what to read; leave one of them out.")
    data = source if source is not None else data
    if data is None and dataset in (None, "kitti"):
        data = kitti_root()
        dataset = "kitti" if data != KITTI_ROOT else dataset
    elif data is None and dataset != "synthetic":
        raise InputError(f"--dataset {dataset}: name the data with --data.")
    return SourceOptions(
        data=data or "", dataset=dataset, seq=seq, calib=tuple(calib or ()), right=right,
        depth=depth, fps=fps, side_by_side=side_by_side, topics=topics, depth_scale=depth_scale,
        sensor=sensor, mask=mask, start=start, every=every, max_frames=max_frames,
    )  # fmt: skip


_NAMES = {"SourceOptions": object}  # annotations whose types are slow to import


def reads_source(
    *, without: tuple[str, ...] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace the parameter ``given`` of a command by the options of a source.

    Args:
        without: options that the command does not take.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        source = [p for p in _parameters(_source_options) if p.name not in without]
        own = [p for p in _parameters(command) if p.name != "given"]
        for parameter in source:
            parameter.annotation.__metadata__[0].rich_help_panel = INPUT

        def called(**values: Any) -> None:
            given = {parameter.name: values.pop(parameter.name) for parameter in source}
            command(given=_source_options(**given), **values)

        called.__signature__ = inspect.Signature([*source, *own])  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in (*source, *own)}
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        return called

    return decorate


def _parameters(function: Callable[..., object]) -> list[inspect.Parameter]:
    """The parameters of a function, with evaluated annotations."""
    hints = get_type_hints(function, localns=_NAMES, include_extras=True)
    return [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(function).parameters.items()
    ]


def require_data(options: SourceOptions) -> None:
    """Refuse a command that names no data if there is no KITTI data either.

    Raises:
        InputError: there is nothing to read.
    """
    if options.dataset is None and options.data == KITTI_ROOT and not Path(KITTI_ROOT).exists():
        raise InputError(_WITHOUT_DATA)


def kind_of_source(options: SourceOptions) -> str:
    """The kind of data that the options name, or that is detected.

    Raises:
        InputError: there is nothing to read, or its kind is unknown.
    """
    from vslam.datasets.detection import detect_dataset

    require_data(options)
    return options.dataset or detect_dataset(options.data)


def read_thresholds(given: str | None) -> Config:
    """The thresholds of ``--config``, a file or values; the defaults for None.

    Raises:
        InputError: as `vslam.config.load_config`.
    """
    from vslam.config import Config, as_config, load_config

    if given is None:
        return Config()
    if "=" not in given or Path(given).exists():
        return load_config(given)
    pairs = (pair.partition("=") for pair in given.split(","))
    values = {name.strip(): value.strip() for name, _, value in pairs}
    return as_config(values, f"--config {given}")


def open_given(options: SourceOptions, told: Console) -> Source:
    """Open the source that the options name; a bar shows the rendering of a town.

    Raises:
        InputError: as `vslam.datasets.sources.open_source`, or there is nothing to read.
    """
    from vslam.datasets.sources import open_source

    require_data(options)
    with told.render_bar() as on_render:
        return open_source(options, on_render)
