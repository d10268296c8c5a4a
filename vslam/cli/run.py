"""The command ``vslam run``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from vslam.cli.drive import Output, drive
from vslam.cli.options import (
    Quiet,
    ViewerName,
    flag,
    names_in,
    option,
    read_thresholds,
    source_options,
    takes_options,
)
from vslam.loopclosure.names import DEFAULT_DETECTOR, detector_names
from vslam.run.options import RunOptions
from vslam.support.errors import InputError
from vslam.support.options import MAP, OUTPUT

_EXAMPLES = """
[b]Examples[/b]
  vslam run --dataset synthetic --seq demo
  vslam run drive.mp4 --side-by-side --calib stereo.yaml
  vslam run --data ~/euroc/V1_01_easy
  vslam run --data ~/kitti --seq 06 --perturb brightness:1.5,blur:0.5 --seed 3
  vslam run --data ~/kitti --seq 00 --perturb brightness --compare bow
  vslam run --data ~/kitti --seq 00 --map runs/latest --localize
  vslam run --resume runs/20261123-101500-kitti-00-none-bow
"""

app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@takes_options(RunOptions)
def run(
    context: typer.Context,
    given: dict[str, Any],
    save_map: Annotated[
        Path | None,
        option(MAP, "FILE", "Also save the map to this file. An existing file is replaced."),
    ] = None,
    resume: Annotated[
        Path | None,
        option(
            MAP,
            "FOLDER",
            "Resume an interrupted run in its folder, with its own options. Only --record, "
            "--view, --keep-open, --report, --ply, --save-map and --quiet can be given again.",
        ),
    ] = None,
    view: Annotated[
        ViewerName | None,
        option(
            OUTPUT,
            "native|web",
            "Show the run live in Rerun, in a window or in a browser on this machine.",
        ),
    ] = None,
    keep_open: Annotated[
        bool, flag(OUTPUT, "Keep the page of [b]--view web[/b] open until Ctrl-C.", "--keep-open")
    ] = False,
    out: Annotated[
        Path, option(OUTPUT, "FOLDER", "Folder in which each run creates its own folder.")
    ] = Path("runs"),
    record: Annotated[
        bool, flag(OUTPUT, "Whether to write a Rerun recording.", "--record/--no-record")
    ] = True,
    pages: Annotated[
        bool,
        flag(OUTPUT, "Write a report with figures, or only report.json.", "--report/--no-report"),
    ] = True,
    ply: Annotated[bool, flag(OUTPUT, "Write the landmarks as map.ply.", "--ply")] = False,
    quiet: Quiet = False,
) -> None:
    """Run SLAM on a sequence, and write the trajectory, map, recording and report to a folder."""
    from vslam.loopclosure.registry import require_detector

    if save_map is not None:
        from vslam.maps.new_output import require_place

        require_place(save_map, "--save-map")
    if keep_open and view != "web":
        raise InputError("--keep-open: only for --view web; a window stays open by itself.")
    output = Output(
        record=record, view=view, keep_open=keep_open, pages=pages, ply=ply, save_map=save_map,
        quiet=quiet,
    )  # fmt: skip
    if resume is not None:
        _refuse_with_resume(context)
        from vslam.run.options import resumed_options

        if resume.is_symlink():  # the next run changes the target of runs/latest
            resume = resume.parent / resume.readlink()
        options = resumed_options(resume)
        require_detector(options.detector, options.weights, f"--resume {resume}: detector")
        drive(options, output, resume=resume)
        return
    drive(_checked(given), output, out=out)


def _checked(given: dict[str, Any]) -> RunOptions:
    """Check the options of a new run, and complete those that were not given."""
    from vslam.config import as_config
    from vslam.loopclosure.registry import require_detector
    from vslam.support.machine import available_cores

    source = source_options(given)
    local_weights, map_file, gps = given["local_weights"], given["map_file"], given["gps"]
    if local_weights is not None and not local_weights.is_file():
        raise InputError(f"--local-weights {local_weights}: no such file; give an .onnx file.")
    if given["localize"] and map_file is None:
        raise InputError("--localize: give the map to localise in with --map.")
    if given["localize"] and gps is not None:
        raise InputError("--gps: changes the map, but --localize must not; leave one of them out.")
    antenna, compare, config = given["gps_antenna"], given["compare"] or "", given["thresholds"]
    if antenna is not None and gps is None:
        raise InputError("--gps-antenna: give the fixes of this antenna with --gps.")
    detector, of_map = given["detector"], dict[str, object]()
    if map_file is not None:
        if compare:
            raise InputError(
                "--compare: a run that continues a map uses the detector of the map; leave it out."
            )
        map_file, detector, of_map = _map_to_continue(map_file, detector)
    detector = detector or DEFAULT_DETECTOR
    require_detector(detector, given["weights"])
    compared = _compared(compare, detector)
    if compared and given["realtime"]:
        raise InputError(
            "--compare: in real time, each detector would make the others drop frames; leave "
            "out --realtime."
        )
    of_run = as_config(of_map, str(map_file)) if config is None else read_thresholds(config)
    completed = {
        "gps_antenna": None if antenna is None else _antenna(antenna),
        "thresholds": of_run,
        "threads": given["threads"] or min(available_cores(), 4),
        "detector": detector,
        "compare": compared,
        "map_file": map_file,
    }
    return RunOptions(**source.model_dump(), **given | completed)


_WITH_RESUME = {"resume", "record", "view", "keep_open", "pages", "ply", "save_map", "quiet"}


def _refuse_with_resume(context: typer.Context) -> None:
    """Refuse options that cannot be combined with ``--resume``, because a resumed run keeps its own
    options."""
    for one in context.command.params:
        source = context.get_parameter_source(one.name or "")
        given = source is not None and source.name == "COMMANDLINE"
        if given and one.name not in _WITH_RESUME:
            raise InputError(
                f"{one.opts[0]}: a resumed run continues with its own options; leave it out."
            )


def _antenna(text: str) -> tuple[float, float, float]:
    """Parse the position of the antenna: metres to the right of, below and ahead of the left
    camera."""
    try:
        right, down, ahead = map(float, text.split(","))
    except ValueError:
        right = down = ahead = math.nan
    if not math.isfinite(right + down + ahead):
        raise InputError(
            f"--gps-antenna {text}: give three numbers separated by commas, the metres to the "
            "right of, below and ahead of the left camera."
        )
    return right, down, ahead


def _compared(names: str, detector: str) -> tuple[str, ...]:
    from vslam.loopclosure.registry import require_detector

    found = tuple(names_in(names))
    for name in found:
        require_detector(name, option="--compare")
    if detector in found:
        raise InputError(f"--compare {detector}: this is the run's own detector; give another one.")
    return found


def _map_to_continue(file: Path, detector: str | None) -> tuple[Path, str, dict[str, object]]:
    """Return the map file, and the detector and the thresholds with which the map was made.

    The path of the map file is absolute, because ``runs/latest`` refers to a different folder as
    soon as this run has created its folder.
    """
    from vslam.maps.storage import made_with, map_file_of

    file = map_file_of(file)
    _, of_map, thresholds = made_with(file)
    if detector not in (None, of_map):
        raise InputError(
            f"--detector {detector}: {file} was made with the detector {of_map}; leave it out."
        )
    if of_map not in detector_names():
        raise InputError(
            f"{file} was made with the detector {of_map}, a plug-in that is not installed here; "
            "install its package."
        )
    return file.resolve(), of_map, thresholds
