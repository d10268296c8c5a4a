"""The options of ``vslam run``, saved in the folder of the run so that it can be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import ValidationError

from vslam.config import Config
from vslam.loopclosure.names import DEFAULT_DETECTOR, detector_names
from vslam.support.errors import InputError
from vslam.support.options import EXECUTION, INPUT, MAP, METHOD, Option, with_paths
from vslam.support.plugins import packages_of
from vslam.types.source_options import SourceOptions

OPTIONS = "run.json"
# Options of other commands, too.
PERTURB = Option(
    METHOD,
    "LAWS",
    "Perturbations of the images, with strengths, such as [b]fog:60,blur:0.5[/b]. "
    "[b]vslam perturb --list[/b] shows all of them.",
)
SEED = Option(METHOD, "N", "Seed of the random numbers.", min=0)
THRESHOLDS = Option(
    METHOD,
    "FILE|NAME=VALUE",
    "Thresholds: a JSON file, or values separated by commas, such as orb.n_features=1000 "
    "(docs/reference/thresholds.md). [b]fast[/b] is faster but less accurate.",
    name="--config",
    given_as=str,
)


class RunOptions(SourceOptions):
    """The options of ``vslam run``, as given on the command line.

    In the file ``run.json``, all paths are absolute.

    Attributes:
        plugins: name of the package of each plug-in that the run uses. This attribute is set only
            when the options are read from ``run.json``.
    """

    gps: Annotated[
        Path | None,
        Option(
            INPUT,
            "FILE",
            "GPS fixes that georeference the trajectory: CSV, a bag, or the folder oxts of KITTI "
            "raw (docs/howto/gps.md).",
        ),
    ] = None
    gps_antenna: Annotated[
        tuple[float, float, float] | None,
        Option(
            INPUT,
            "X,Y,Z",
            "Position of the GPS antenna relative to the left camera: metres to the right, below "
            "and ahead, such as [b]0.1,-0.5,-1.5[/b].",
            unset="from KITTI's calibration, or 0,0,0",
            given_as=str,
        ),
    ] = None
    perturb: Annotated[
        str,
        PERTURB,
    ] = "none"
    seed: Annotated[int, SEED] = 0
    detector: Annotated[
        str,
        Option(
            METHOD,
            "NAME",
            "Loop detector: [b]both[/b] combines the capsule network and the bag of words, "
            "[b]none[/b] closes no loops. All detectors: {choices}.",
            unset="both, or the detector of --map",
            choices=detector_names,
            given_as=str,
        ),
    ] = DEFAULT_DETECTOR
    weights: Annotated[
        Path | None,
        Option(
            METHOD,
            "FILE",
            "ONNX file of the detector's network, from [b]vslam train[/b], or the vocabulary of "
            "[b]bow[/b], from [b]vslam vocabulary[/b].",
            unset="the shipped ones",
        ),
    ] = None
    local_weights: Annotated[
        Path | None,
        Option(METHOD, "FILE", "ONNX file of the local descriptors that verify loops."),
    ] = None
    thresholds: Annotated[
        Config,
        THRESHOLDS,
    ] = Config()
    compare: Annotated[
        tuple[str, ...],
        Option(
            METHOD,
            "NAMES",
            "Other loop detectors, separated by commas. They run on the same frames, and a table "
            "compares them.",
            given_as=str,
        ),
    ] = ()
    map_file: Annotated[
        Path | None,
        Option(
            MAP,
            "FILE|FOLDER",
            "Continue the map in a file, or the map of a run.",
            name="--map",
        ),
    ] = None
    localize: Annotated[bool, Option(MAP, "", "Localise in the map without changing it.")] = False
    autosave: Annotated[
        float,
        Option(MAP, "SECONDS", "Time between saves of the map. 0 saves it only at the end.", min=0),
    ] = 60.0
    threads: Annotated[
        int,
        Option(
            EXECUTION,
            "N",
            "Number of threads. It does not change the result.",
            min=1,
            unset="all cores, at most 4",
            given_as=int,
        ),
    ] = 1
    realtime: Annotated[
        bool,
        Option(
            EXECUTION,
            "",
            "Process the frames in real time. Frames are dropped while tracking is too slow.",
        ),
    ] = False
    plugins: Mapping[str, str] = {}


def write_options(folder: Path, options: RunOptions) -> None:
    """Write the options of a run to the file ``run.json`` in its folder.

    Raises:
        InputError: the file cannot be written.
    """
    data = Path(options.data)
    changed: dict[str, object] = with_paths(options, Path.resolve)
    if options.data and data.exists():
        changed["data"] = str(data.resolve())
    laws = (law.partition(":")[0] for law in options.perturb.split(","))
    names = {options.detector, *options.compare, options.dataset or "", *laws}
    changed["plugins"] = packages_of(sorted(names))
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
