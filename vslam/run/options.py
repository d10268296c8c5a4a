"""The options of ``vslam run``, saved in the folder of the run so that it can be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from vslam.config import Config
from vslam.datasets.sources import SourceOptions
from vslam.loopclosure.registry import DEFAULT_DETECTOR
from vslam.support.errors import InputError
from vslam.support.plugins import packages_of

OPTIONS = "run.json"


class RunOptions(SourceOptions):
    """The options of ``vslam run``, as given on the command line.

    In the file ``run.json``, all paths are absolute.

    Attributes:
        plugins: name of the package of each plug-in that the run uses. This attribute is set only
            when the options are read from ``run.json``.
    """

    perturb: str = "none"
    seed: int = 0
    gps: Path | None = None
    gps_antenna: tuple[float, float, float] | None = None
    threads: int = 1
    detector: str = DEFAULT_DETECTOR
    weights: Path | None = None
    local_weights: Path | None = None
    thresholds: Config = Config()
    map_file: Path | None = None
    localize: bool = False
    compare: tuple[str, ...] = ()
    realtime: bool = False
    autosave: float = 60.0
    plugins: Mapping[str, str] = {}


def write_options(folder: Path, options: RunOptions) -> None:
    """Write the options of a run to the file ``run.json`` in its folder.

    Raises:
        InputError: the file cannot be written.
    """
    data = Path(options.data)
    changed: dict[str, object] = {
        name: path.resolve()
        for name in ("right", "depth", "mask", "gps", "weights", "local_weights", "map_file")
        if (path := getattr(options, name)) is not None
    }
    if options.data and data.exists():
        changed["data"] = str(data.resolve())
    laws = (law.partition(":")[0] for law in options.perturb.split(","))
    names = {options.detector, *options.compare, options.dataset or "", *laws}
    changed["plugins"] = packages_of(sorted(names))
    changed["calib"] = tuple(path.resolve() for path in options.calib)
    text = options.model_copy(update=changed).model_dump_json(indent=2)
    try:
        (folder / OPTIONS).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"{folder / OPTIONS}: cannot be written ({error.strerror}); use --out to give a folder "
            "on a disk with free space."
        ) from error


def resumed_options(folder: Path) -> RunOptions:
    """Read the options of a run that is to be resumed.

    Raises:
        InputError: ``run.json`` cannot be read, a plug-in of the run is not installed, or the
            folder contains a symbolic link, through which the run would write outside the folder.
    """
    for path in folder.rglob("*"):
        if path.is_symlink():
            raise InputError(
                f"{path}: this is a symbolic link, but a resumed run writes only into its own "
                "folder; replace the link by the file."
            )
    options = read_options(folder)
    installed = packages_of(options.plugins)
    for name, package in options.plugins.items():
        if name not in installed:
            raise InputError(
                f"{folder}: the run used {name} of the package {package}, which is not installed "
                "here; install the package."
            )
    return options


def read_options(folder: Path) -> RunOptions:
    """Read the options of a run from the file ``run.json`` in its folder.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = folder / OPTIONS
    try:
        return RunOptions.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the folder of a run."
        ) from error
    except ValidationError as error:
        raise InputError(f"{path}: damaged or from another version; start a new run.") from error
