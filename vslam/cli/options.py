"""Defines options that several commands share, and opens the data that these options describe."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer
from pydantic.fields import FieldInfo

from vslam.run.options import PERTURB, SEED, THRESHOLDS
from vslam.support.errors import InputError
from vslam.support.options import EXECUTION, INPUT, METHOD, OUTPUT, Option, options_of
from vslam.types.source_options import AUTO, DEPTH_CAMERAS, SourceOptions

if TYPE_CHECKING:
    from vslam.cli.console import Console
    from vslam.config import Config
    from vslam.datasets.frames import Source


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


def shown_as(shown: Option, name: str) -> Any:
    """Define the option of the field ``name`` of a model of options."""
    names = [shown.name or f"--{name.replace('_', '-')}"]
    if not shown.metavar:
        return flag(shown.panel, shown.help, *names)
    text = shown.help
    if shown.choices is not None:
        text = text.format(choices=", ".join(shown.choices()))
    return option(
        shown.panel, shown.metavar, text, *names, unset=shown.unset or True, min=shown.min
    )


def threads(unset: str, text: str = "Number of threads. It does not change the result.") -> Any:
    """Define the option ``--threads``. The text ``unset`` is shown as the default."""
    return option(EXECUTION, "N", text, min=1, unset=unset)


Perturb = Annotated[str, shown_as(PERTURB, "perturb")]
Seed = Annotated[int, shown_as(SEED, "seed")]
Thresholds = Annotated[str | None, shown_as(THRESHOLDS, "config")]
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


_SOURCE = Annotated[
    str | None,
    typer.Argument(
        metavar="SOURCE",
        help="The data to read, the same as [b]--data[/b].",
        show_default=False,
        rich_help_panel=INPUT,
    ),
]


def source_options(values: dict[str, Any]) -> SourceOptions:
    """Take the options of the source out of the values of a command.

    Without data, they name the folder of the KITTI data.

    Raises:
        InputError: the data are given twice or not at all.
    """
    names = [name for name, _ in options_of(SourceOptions) if name in values]
    given = {name: values.pop(name) for name in names}
    source, data = values.pop("source", None), given["data"]
    if source is not None and data is not None:
        raise InputError(f"{source}: data is also given with --data; leave one of the two out.")
    data, dataset = source if source is not None else data, given["dataset"]
    if data is None and dataset in (None, "kitti"):
        data = kitti_root()
        given["dataset"] = "kitti" if data != KITTI_ROOT else dataset
    elif data is None and dataset not in ("synthetic", *DEPTH_CAMERAS):
        raise InputError(f"--dataset {dataset}: give the data with --data.")
    if "calib" in given:
        given["calib"] = tuple(given["calib"] or ())
    return SourceOptions(**given | {"data": data or ""})


def reads_source(
    *, without: tuple[str, ...] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command that reads images. The parameter ``given`` of the command is replaced with
    the options that describe the source of the images.

    Args:
        without: names of the options to leave out.
    """
    return _takes(SourceOptions, without, source_options)


def takes_options(
    model: type[SourceOptions],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command. Its parameter ``given`` is replaced with the options of a model, and
    receives their values by name."""
    return _takes(model, (), lambda values: values)


def _takes(
    model: type[SourceOptions], without: tuple[str, ...], convert: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        source = [p for p in _parameters_of(model) if p.name not in without]
        own = [p for p in _parameters(command) if p.name != "given"]

        def called(**values: Any) -> None:
            given = {parameter.name: values.pop(parameter.name) for parameter in source}
            command(given=convert(given), **values)

        called.__signature__ = inspect.Signature([*source, *own])  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in (*source, *own)}
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        return called

    return decorate


def _parameters_of(model: type[SourceOptions]) -> list[inspect.Parameter]:
    """Return the options of a model as parameters of a command, after the argument SOURCE."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    found = [inspect.Parameter("source", keyword, default=None, annotation=_SOURCE)]
    for name, shown in options_of(model):
        annotation, default = _annotation(name, shown, model.model_fields[name])
        found.append(inspect.Parameter(name, keyword, default=default, annotation=annotation))
    return found


def _annotation(name: str, shown: Option, field: FieldInfo) -> tuple[Any, Any]:
    """Return the annotation of the parameter for a field, and its default."""
    value = field.annotation if shown.given_as is None else shown.given_as | None
    if shown.choices is not None:
        value = Literal[shown.choices()] | None
    default = None if shown.given_as is not None else field.default
    return Annotated[value, shown_as(shown, name)], default


def _parameters(function: Callable[..., object]) -> list[inspect.Parameter]:
    """Return the parameters of a function, with evaluated annotations."""
    hints = get_type_hints(function, localns={"SourceOptions": object}, include_extras=True)
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
    if options.calib == AUTO:
        console.announce("calibrating the camera from its own images ...")
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
