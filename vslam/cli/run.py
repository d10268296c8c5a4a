"""The command ``vslam run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from vslam.cli.drive import Output, drive
from vslam.cli.options import DetectorName, Perturb, Seed, Thresholds, ViewerName, reads_source
from vslam.errors import InputError

if TYPE_CHECKING:
    from vslam.datasets.sources import SourceOptions

_EXAMPLES = """
[b]Examples[/b]

  vslam run --data ~/kitti --seq 00

  vslam run --data ~/kitti --seq 06 --perturb brightness:1.5,blur:0.5 --seed 3

  vslam run --dataset synthetic --seq demo

  vslam run --data ~/kitti --seq 00 --perturb brightness --compare bow

  vslam run --dataset euroc --data ~/euroc/V1_01_easy

  vslam run --seq 00 --max-frames 200 --no-record --quiet

  vslam run --resume runs/20261123-101500-kitti-00-none-bow

  vslam run drive.mp4 --side-by-side --calib stereo.yaml

  vslam run --data ~/kitti --seq 00 --map runs/latest --localize
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(run)


@reads_source()
def run(
    context: typer.Context,
    given: SourceOptions,
    perturb: Perturb = "none",
    seed: Seed = 0,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="Threads; the result does not depend on it.", show_default="cores, up to 4"
        ),
    ] = None,
    detector: Annotated[
        DetectorName | None,
        typer.Option(
            help="Loop detector: [b]both[/b] is the capsule network beside the bag of words, "
            "[b]none[/b] odometry only; those after capsule-paper need [b]--weights[/b].",
            show_default="both, or that of --map",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="ONNX file of a learned detector ([b]vslam train[/b])."),
    ] = None,
    local_weights: Annotated[
        Path | None,
        typer.Option(
            help="ONNX file of the local descriptors that verify loops "
            "(docs/research/local_descriptors.md)."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Where the folders of the runs go.")] = Path("runs"),
    config: Thresholds = None,
    compare: Annotated[
        str,
        typer.Option(
            metavar="DETECTORS",
            help="Loop detectors to run beside it on the same frames, joined by commas, each with "
            "a map of its own: a table of all. [b]none[/b] is odometry only.",
        ),
    ] = "",
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", help="Go on in this map, the map.npz of a run for example."
        ),
    ] = None,
    localize: Annotated[
        bool,
        typer.Option("--localize", help="Only track in the map of --map; it stays as it is."),
    ] = False,
    save_map: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the map to this file, too, in place of another."),
    ] = None,
    autosave: Annotated[
        float,
        typer.Option(
            min=0, metavar="SECONDS", help="What a killed run loses at most; 0 saves at the end."
        ),
    ] = 60.0,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Go on at the next frame of a run that was cut off.",
        ),
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Play frames at their times; drop overtaken ones."),
    ] = False,
    record: Annotated[bool, typer.Option(help="Write a Rerun recording.")] = True,
    view: Annotated[
        ViewerName | None,
        typer.Option(help="Show the run live in Rerun, in a window or in the browser, too."),
    ] = None,
    pages: Annotated[
        bool,
        typer.Option(
            "--report/--no-report",
            help="Write report.html, report.md and figures; without, of the report only its JSON, "
            "which is all that [b]vslam report[/b] needs of a run.",
        ),
    ] = True,
    ply: Annotated[bool, typer.Option("--ply", help="Write the landmarks as map.ply.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")] = False,
) -> None:
    """Run SLAM on a sequence and write trajectory, map, recording and report to a folder."""
    from vslam.loopclosure.registry import DEFAULT_DETECTOR, require_detector

    if save_map is not None:
        from vslam.maps.new_output import require_place

        require_place(save_map, "--save-map")
    output = Output(record=record, view=view, pages=pages, ply=ply, save_map=save_map, quiet=quiet)
    if resume is not None:
        _refuse_beside_resume(context)
        from vslam.run.options import resumed_options

        drive(resumed_options(resume), output, resume=resume)
        return
    if local_weights is not None and not local_weights.is_file():
        raise InputError(f"--local-weights {local_weights}: no such file; name an .onnx file.")
    if localize and map_file is None:
        raise InputError("--localize: name the map to localise in with --map.")
    if map_file is not None:
        if compare:
            raise InputError(
                "--compare: a run that continues a map has the detector of that map; leave it out."
            )
        map_file, detector = _map_to_go_on_in(map_file, detector)
    detector = detector or DEFAULT_DETECTOR
    require_detector(detector, weights)
    beside = _compared(compare, detector)
    if beside and realtime:
        raise InputError(
            "--compare: in real time each detector would cost the others frames; leave out "
            "--realtime."
        )

    from vslam.config import Config, load_config
    from vslam.machine import available_cores
    from vslam.run.options import RunOptions

    options = RunOptions(
        **given.model_dump(),
        perturb=perturb,
        seed=seed,
        threads=threads or min(available_cores(), 4),
        detector=detector,
        weights=weights,
        local_weights=local_weights,
        thresholds=Config() if config is None else load_config(config),
        map_file=map_file,
        localize=localize,
        compare=beside,
        realtime=realtime,
        autosave=autosave,
    )
    drive(options, output, out=out)


_BESIDE_RESUME = {"resume", "record", "view", "pages", "ply", "save_map", "quiet"}


def _refuse_beside_resume(context: typer.Context) -> None:
    """A run goes on with its own options."""
    for option in context.command.params:
        source = context.get_parameter_source(option.name or "")
        given = source is not None and source.name == "COMMANDLINE"
        if given and option.name not in _BESIDE_RESUME:
            raise InputError(
                f"{option.opts[0]}: a run that is resumed goes on with its own options; leave it "
                "out."
            )


def _compared(names: str, detector: str) -> tuple[str, ...]:
    """The detectors of ``--compare``, each once."""
    from vslam.loopclosure.registry import require_detector
    from vslam.loopclosure.siamese.weights import NETWORKS, SHIPPED

    found = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
    for name in found:
        if name in NETWORKS and not (SHIPPED / f"{name}.onnx").exists():
            raise InputError(
                f"--compare {name}: vslam ships no weights for it; name it with --detector and "
                "--weights, and compare it with another."
            )
        require_detector(name, option="--compare")
    if detector in found:
        raise InputError(
            f"--compare {detector}: this is the detector that the run itself has; name another."
        )
    return found


def _map_to_go_on_in(file: Path, detector: DetectorName | None) -> tuple[Path, DetectorName]:
    """The map of a file or of the folder of a run, and the detector that it was made with. The path
    is absolute: ``runs/latest`` will be another folder once this run has one."""
    from vslam.maps.storage import made_with, map_file_of

    file = map_file_of(file)
    _, of_map = made_with(file)
    if detector not in (None, of_map):
        raise InputError(
            f"--detector {detector}: {file} was made with the detector {of_map}; leave it out."
        )
    return file.resolve(), cast("DetectorName", of_map)
