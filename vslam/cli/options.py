"""Defines options that several commands share, and opens the data that these options describe."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from vslam.support import plugins
from vslam.support.errors import InputError

if TYPE_CHECKING:
    from vslam.cli.console import Console
    from vslam.config import Config
    from vslam.datasets.frames import Source
    from vslam.datasets.sources import SourceOptions


def _with_plugins(names: tuple[str, ...], group: str) -> tuple[str, ...]:
    return (*names, *(name for name in plugins.find_plugins(group) if name not in names))


_DATASETS = _with_plugins(("kitti", "kitti_raw", "euroc", "tum", "synthetic"), plugins.READERS)
_DEPTH_CAMERAS = ("realsense", "oakd")
_SOURCES = ("images", "video", "bag", "camera", *_DEPTH_CAMERAS)
DETECTOR_NAMES = _with_plugins(
    ("none", "bow", "both", "capsule", "capsule-pruned", "capsule-paper"), plugins.DETECTORS
)
if TYPE_CHECKING:
    SourceName = str
    DetectorName = str
else:  # plug-ins can add names
    SourceName = Literal[(*_DATASETS, *_SOURCES)]
    DetectorName = Literal[DETECTOR_NAMES]
# Panels of --help.
INPUT, METHOD, MAP, OUTPUT, EXECUTION = "Input", "Method", "Map", "Output", "Execution"


def option(
    panel: str, metavar: str, text: str, *names: str, unset: str | bool = True, **more: Any
) -> Any:
    """Define an option in a panel of ``--help``. The text ``unset`` is shown as the default."""
    return typer.Option(
        *names, metavar=metavar, help=text, show_default=unset, rich_help_panel=panel, **more
    )


def flag(panel: str, text: str, *names: str) -> Any:
    """Define an option without a value."""
    return typer.Option(*names, help=text, rich_help_panel=panel)


def threads(unset: str, text: str = "Number of threads. It does not change the result.") -> Any:
    """Define the option ``--threads``. The text ``unset`` is shown as the default."""
    return option(EXECUTION, "N", text, min=1, unset=unset)


Perturb = Annotated[
    str,
    option(
        METHOD,
        "LAWS",
        "Perturbations of the images, with strengths, such as [b]fog:60,blur:0.5[/b]. "
        "[b]vslam perturb --list[/b] shows all of them.",
    ),
]
Seed = Annotated[int, option(METHOD, "N", "Seed of the random numbers.", min=0)]
Thresholds = Annotated[
    str | None,
    option(
        METHOD,
        "FILE|NAME=VALUE",
        "Thresholds: a JSON file, or values separated by commas, such as orb.n_features=1000 "
        "(docs/reference/thresholds.md). [b]fast[/b] is faster but less accurate.",
        "--config",
    ),
]
Weights = Annotated[
    list[str] | None,
    option(
        METHOD,
        "NAME=FILE",
        "Weights of a detector. Repeat the option for several detectors.",
        unset="the shipped ones",
    ),
]
Detectors = Annotated[
    str,
    option(
        METHOD,
        "NAMES",
        "Loop detectors, separated by commas. The first one is the baseline.",
    ),
]
Seeds = Annotated[
    int, option(METHOD, "N", "Number of seeds of each perturbation with random numbers.", min=1)
]
Jobs = Annotated[
    int,
    option(EXECUTION, "N", "Number of runs at a time. Speeds can be compared only with 1.", min=1),
]
Threads = Annotated[int | None, threads("all cores, at most 4")]
AllThreads = Annotated[int | None, threads("all cores")]
ThreadsOfRun = Annotated[
    int | None, threads("cores / jobs, at most 4", "Number of threads of each run.")
]
Scheduler = Annotated[
    str | None,
    option(
        EXECUTION, "ADDRESS", "Dask scheduler whose workers do the runs, such as tcp://HOST:8786."
    ),
]
SystemNames = Annotated[
    str,
    option(
        METHOD,
        "NAMES",
        "Systems to test: [b]vslam[/b], [b]orbslam3[/b] and the names given with --system.",
    ),
]
OtherSystems = Annotated[
    list[str] | None,
    option(
        METHOD,
        "NAME=COMMAND",
        "Another system: a command that reads images from {folder} in KITTI's format and writes "
        "a trajectory to the folder {out} (docs/howto/stress.md).",
        "--system",
    ),
]
OrbSlam3Python = Annotated[
    Path | None,
    option(
        METHOD,
        "FILE",
        "Python interpreter in which pyorbslam3 is installed.",
        "--orbslam3-python",
        unset="that of vslam",
    ),
]
OrbSlam3Vocabulary = Annotated[
    Path | None,
    option(METHOD, "FILE", "Vocabulary of ORB-SLAM3, in DBoW2's text format.", "--vocabulary"),
]
Quiet = Annotated[bool, flag(OUTPUT, "Show neither progress nor a summary.", "--quiet")]
SensorName = Literal["stereo", "mono", "rgbd"]
ViewerName = Literal["native", "web"]
AlignmentName = Literal["se3", "sim3", "none"]

KITTI_ROOT = "data/kitti"  # unless $KITTI_ROOT is set to another folder

_WITHOUT_DATA = """there is no data to read; give your data, or use rendered images:
  --dataset synthetic    rendered drives, which need no download
  DATA --calib FILE      images, video, bag or camera (docs/howto/sources.md)
  --data FOLDER          KITTI; or set $KITTI_ROOT to its folder (datasets.md)"""


def names_in(text: str) -> list[str]:
    """Return the names in a comma-separated list, in order and without repetitions."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def kitti_root() -> str:
    return os.environ.get("KITTI_ROOT") or KITTI_ROOT


def sequences(default: str) -> Any:
    """Define the option ``--seqs`` with the given default value."""
    return option(
        INPUT,
        "LIST",
        "Sequences of a data set, such as 00-05 or 00,demo.",
        unset=f"{default}; not needed for EuRoC and TUM",
    )


def _source_options(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="SOURCE",
            help="The data to read, the same as [b]--data[/b].",
            show_default=False,
            rich_help_panel=INPUT,
        ),
    ] = None,
    data: Annotated[
        str | None,
        option(
            INPUT,
            "DATA",
            "Data set, folder of images, video, bag, or the number or URL of a camera "
            "(docs/howto/sources.md).",
            unset="$KITTI_ROOT, else data/kitti",
        ),
    ] = None,
    dataset: Annotated[
        SourceName | None,
        option(
            INPUT,
            "KIND",
            f"Kind of data: {', '.join((*_DATASETS, *_SOURCES))}.",
            unset="detected from the files",
        ),
    ] = None,
    seq: Annotated[
        str | None,
        option(INPUT, "NAME", "Sequence of a data set.", unset="00; not needed for EuRoC and TUM"),
    ] = None,
    calib: Annotated[
        list[Path] | None,
        option(
            INPUT,
            "FILE",
            "Calibration file (docs/howto/cameras.md). If each camera has its own file, give the "
            "option twice, the left camera first.",
        ),
    ] = None,
    right: Annotated[
        Path | None,
        option(INPUT, "FOLDER", "Right images. [b]--data[/b] gives the left images."),
    ] = None,
    depth: Annotated[
        Path | None,
        option(INPUT, "FOLDER", "Depth images. [b]--data[/b] gives the grey or colour images."),
    ] = None,
    fps: Annotated[
        float | None,
        option(INPUT, "NUMBER", "Frames per second, for data without timestamps."),
    ] = None,
    side_by_side: Annotated[
        bool, flag(INPUT, "Each image contains both views side by side.", "--side-by-side")
    ] = False,
    topics: Annotated[
        str,
        option(
            INPUT,
            "LEFT,RIGHT",
            "Image topics of a bag: LEFT,RIGHT for stereo, one topic for mono, COLOUR,DEPTH for "
            "RGB-D.",
        ),
    ] = "",
    imu_topics: Annotated[
        str,
        option(
            INPUT,
            "TOPIC",
            "IMU topic of a bag, or GYRO,ACCEL.",
            unset=False,
        ),
    ] = "",
    imu: Annotated[bool, flag(INPUT, "Whether to use the IMU.", "--imu/--no-imu")] = True,
    depth_scale: Annotated[
        float | None,
        option(
            INPUT,
            "NUMBER",
            "Value of a pixel at a depth of one metre.",
            unset="from the calibration, data set or encoding",
        ),
    ] = None,
    sensor: Annotated[
        SensorName | None,
        option(
            INPUT,
            "stereo|mono|rgbd",
            "Images to use. [b]mono[/b] uses only the left images, and its scale is arbitrary.",
            unset="all images of the data",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        option(
            INPUT,
            "FILE|FOLDER",
            "Mask image that is black where the left images must not be used, or a folder with "
            "a mask for each image (docs/howto/masks.md).",
        ),
    ] = None,
    start: Annotated[int, option(INPUT, "N", "First frame.", min=0)] = 0,
    every: Annotated[int, option(INPUT, "N", "Use only every N-th frame.", min=1)] = 1,
    max_frames: Annotated[
        int | None, option(INPUT, "N", "Stop after N frames.", min=1, unset="all")
    ] = None,
) -> SourceOptions:
    from vslam.datasets.sources import SourceOptions

    if source is not None and data is not None:
        raise InputError(f"{source}: data is also given with --data; leave one of the two out.")
    data = source if source is not None else data
    if data is None and dataset in (None, "kitti"):
        data = kitti_root()
        dataset = "kitti" if data != KITTI_ROOT else dataset
    elif data is None and dataset not in ("synthetic", *_DEPTH_CAMERAS):
        raise InputError(f"--dataset {dataset}: give the data with --data.")
    return SourceOptions(
        data=data or "", dataset=dataset, seq=seq, calib=tuple(calib or ()), right=right,
        depth=depth, fps=fps, side_by_side=side_by_side, topics=topics,
        imu_topics=imu_topics, imu=imu, depth_scale=depth_scale,
        sensor=sensor, mask=mask, start=start, every=every, max_frames=max_frames,
    )  # fmt: skip


_NAMES = {"SourceOptions": object}  # annotations whose types are slow to import


def reads_source(
    *, without: tuple[str, ...] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command that reads images. The parameter ``given`` of the command is replaced with
    the options that describe the source of the images.

    Args:
        without: names of the options to leave out.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        source = [p for p in _parameters(_source_options) if p.name not in without]
        own = [p for p in _parameters(command) if p.name != "given"]

        def called(**values: Any) -> None:
            given = {parameter.name: values.pop(parameter.name) for parameter in source}
            command(given=_source_options(**given), **values)

        called.__signature__ = inspect.Signature([*source, *own])  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in (*source, *own)}
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        return called

    return decorate


def _parameters(function: Callable[..., object]) -> list[inspect.Parameter]:
    """Return the parameters of a function, with evaluated annotations."""
    hints = get_type_hints(function, localns=_NAMES, include_extras=True)
    return [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(function).parameters.items()
    ]


def require_data(options: SourceOptions) -> None:
    """Check that the options name data, or that the default folder of the KITTI data exists.

    Raises:
        InputError: there are no data to read.
    """
    if options.dataset is None and options.data == KITTI_ROOT and not Path(KITTI_ROOT).exists():
        raise InputError(_WITHOUT_DATA)


def kind_of_source(options: SourceOptions) -> str:
    """Return the kind of data that the options name, or detect it from the files."""
    from vslam.datasets.detection import detect_dataset

    require_data(options)
    return options.dataset or detect_dataset(options.data)


def read_thresholds(given: str | None) -> Config:
    """Read the thresholds of ``--config``: a file, or a text with presets and values, of which
    later ones replace earlier ones. None gives the defaults."""
    from vslam.config import Config, as_config, load_config, preset

    if given is None:
        return Config()
    if os.path.exists(given):  # unlike Path.exists, it accepts a text of any length
        return load_config(given)
    where = f"--config {given}"
    thresholds: dict[str, Any] = {}
    for part in given.split(","):
        name, equals, value = part.partition("=")
        if equals:
            thresholds[name.strip()] = value.strip()
        else:
            thresholds.update(preset(name.strip(), where, "file or preset"))
    return as_config(thresholds, where)


def open_given(options: SourceOptions, console: Console) -> Source:
    """Open the source that the options describe. If a synthetic town must be rendered first, the
    progress is shown."""
    from vslam.datasets.sources import open_source

    require_data(options)
    with console.render_bar() as on_render:
        return open_source(options, on_render)


def require_writable(out: Path) -> None:
    """Check that files can be written to a folder, which need not exist yet. Call this before a
    long computation.

    Raises:
        InputError: the path is a file, or the folder is not writable.
    """
    try:
        there = next(path for path in (out, *out.absolute().parents) if path.exists())
        with TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); give another folder with --out."
        ) from error
