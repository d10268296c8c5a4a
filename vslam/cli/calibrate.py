"""The command ``vslam calibrate``."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from itertools import count
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import typer

from vslam.cli.console import Console
from vslam.cli.options import flag, open_given, option, reads_source, require_data
from vslam.support.errors import BrokenSourceError, InputError, ResultsError
from vslam.support.options import METHOD, OUTPUT
from vslam.types.source_options import AUTO, LIVE

if TYPE_CHECKING:
    from vslam.calibration.boards import Board
    from vslam.calibration.solve import Frame
    from vslam.datasets.frames import RawSource, TimedFrame
    from vslam.types.camera import Image
    from vslam.types.source_options import SourceOptions

_EXAMPLES = """
[b]Examples[/b]
  vslam calibrate board.mp4 --board checkerboard --size 9x6 --square 0.025
  vslam calibrate pair.mkv --side-by-side --board charuco --size 7x5 --square 0.04 --marker 0.03
  vslam calibrate cam_april/mav0 --board april_6x6.yaml --lens fisheye --out stereo.yaml
  vslam calibrate drive.mp4 --auto --out camera.yaml
  vslam calibrate drive.mp4 --imu --side-by-side --calib stereo.yaml
"""
_MOST_SEARCHED = 300  # images, which are spread evenly over the source; this takes 1 to 2 minutes
_OF_DRIVES = ("calib", "depth", "depth_scale", "mask", "imu_topics")  # options with --imu
_DEFAULT_OUT = Path("calibration.yaml")
_EXAMINED = 10  # images in which other boards are searched for if the given board is not found

app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@reads_source(without=("imu",))
def calibrate(
    given: SourceOptions,
    board: Annotated[
        str,
        option(
            "Board",
            "KIND|FILE",
            "Kind of board: checkerboard, charuco, aprilgrid, or a target file of Kalibr.",
        ),
    ] = "",
    size: Annotated[
        str,
        option(
            "Board",
            "COLUMNSxROWS",
            "Number of inner corners of a checkerboard, of squares of a ChArUco board, or of tags "
            "of an AprilGrid.",
        ),
    ] = "",
    square: Annotated[
        float | None,
        option(
            "Board",
            "METRES",
            "Side of a square. For an AprilGrid, the distance from the edge of a tag to the same "
            "edge of the next tag. Not needed for a single camera and a checkerboard.",
        ),
    ] = None,
    marker: Annotated[
        float | None,
        option("Board", "METRES", "Side of a marker or tag, without its white border."),
    ] = None,
    dictionary: Annotated[
        str,
        option(
            "Board",
            "NAME",
            "Dictionary of the markers of a ChArUco board, as OpenCV names it, but without DICT_.",
        ),
    ] = "5X5_1000",
    lens: Annotated[
        Literal["pinhole", "fisheye"],
        option(
            METHOD,
            "pinhole|fisheye",
            "Camera model: [b]pinhole[/b] with radial-tangential distortion, or [b]fisheye[/b] "
            "(equidistant) for fields of view above about 120 degrees.",
        ),
    ] = "pinhole",
    out: Annotated[
        Path | None,
        option(
            OUTPUT,
            "FILE",
            "Calibration file to write. For a board, a page of residuals is written next to it. "
            "Existing files are renamed.",
            unset="calibration.yaml; with --imu, the file of --calib if it has this format",
        ),
    ] = None,
    imu: Annotated[
        bool,
        flag(
            METHOD,
            "Measure from a drive how the IMU is turned against the camera, and how its clock "
            "differs.",
            "--imu",
        ),
    ] = False,
    auto: Annotated[
        bool,
        flag(
            METHOD,
            "Calibrate one camera from a drive, without a board, as --calib auto does.",
            "--auto",
        ),
    ] = False,
) -> None:
    """Calibrate a camera or a stereo pair from images of a calibration board, one camera from any
    drive, or an IMU from a drive in which the camera turns about all axes.

    The exit code is 1 if the calibration has faults.
    """
    of_board = {"--board": board, "--size": size, "--square": square, "--marker": marker}
    if imu and auto:
        raise InputError("--auto: calibrates a camera, --imu an IMU; leave one of them out.")
    if imu or auto:
        for name in filter(of_board.get, of_board):
            what = "an IMU is calibrated" if imu else "--auto calibrates"
            raise InputError(f"{name}: {what} without a board; leave it out.")
    if imu:
        _calibrate_imu(given, out)
        return
    from vslam.calibration.boards import other_board
    from vslam.calibration.files import write_calibration
    from vslam.calibration.solve import estimate
    from vslam.datasets.sources import open_raw
    from vslam.doctor.calibration_page import findings_of, write_page
    from vslam.doctor.findings import lines

    for name in _OF_DRIVES:
        if getattr(given, name) not in (None, "", ()):
            raise InputError(f"--{name.replace('_', '-')}: only with --imu; leave it out.")
    if auto:
        _calibrate_from_motion(given, out or _DEFAULT_OUT)
        return
    if not board:
        raise InputError(
            "--board is missing: give a board, --auto to calibrate one camera without a board, or "
            "--imu to calibrate an IMU."
        )
    if given.sensor == "rgbd":
        raise InputError("--sensor rgbd: depth cameras cannot be calibrated; give mono or stereo.")
    out = out or _DEFAULT_OUT
    _check_place(out)
    raw = open_raw(given)
    if raw.live and given.max_frames is None:
        raise InputError(
            f"{given.data}: the images of a live camera never end; give --max-frames, such as 300."
        )
    stereo = len(raw.sizes) == 2
    made = _board(board, size, square, marker, dictionary.upper(), stereo=stereo)
    frames, examined = _search(raw, made)
    for warning in [] if raw.pairing is None else raw.pairing.warnings():
        typer.echo(f"warning: {warning}", err=True)
    try:
        found = estimate(made, frames, raw.sizes, lens)
    except InputError as error:
        what, _, fix = str(error).rstrip(".").rpartition("; ")
        fix = other_board(made, examined) or fix
        raise InputError(f"{given.data}: {what}; {fix}.") from error
    findings = findings_of(found)
    seen = f"The {made} is seen in {sum(map(any, frames))} of {len(frames)} images."
    typer.echo(seen)
    for line in lines(findings):
        typer.echo(line)
    page = out.with_suffix(".html")
    _keep_earlier(out, page)
    write_calibration(out, found.calibration)
    write_page(found, findings, seen, out.read_text("utf-8"), page)
    typer.echo(f"{out}: the calibration; {page}: residuals and coverage.")
    if any(finding.verdict == "fault" for finding in findings):
        fix = other_board(made, examined) or "apply the fixes above"
        typer.echo(f"Do not use this calibration, because it has faults; {fix}, and try again.")
        raise typer.Exit(1)
    options = " --side-by-side" * given.side_by_side + " --sensor mono" * (not stereo)
    typer.echo("Next, with a drive:")
    for command in ("doctor", "run"):
        typer.echo(f"  vslam {command} DRIVE{options} --calib {shlex.quote(str(out))}")


def _calibrate_from_motion(given: SourceOptions, out: Path) -> None:
    from vslam.calibration.files import write_calibration
    from vslam.datasets.sources import open_source

    _check_place(out)
    Console(shown=True).announce("calibrating the camera from its own images ...")
    source = open_source(given.model_copy(update={"calib": AUTO}))
    for sentence in source.warnings:
        typer.echo(sentence.removeprefix("--calib auto: "))
    assert source.calibration is not None
    _keep_earlier(out)
    write_calibration(out, source.calibration)
    typer.echo(f"{out}: the calibration.")
    typer.echo("Next, with a drive:")
    for command in ("doctor", "run"):
        typer.echo(f"  vslam {command} DRIVE --sensor mono --calib {shlex.quote(str(out))}")


def _calibrate_imu(given: SourceOptions, out: Path | None) -> None:
    from vslam.calibration.files import write_calibration
    from vslam.config import Config
    from vslam.datasets.frames import first_frames
    from vslam.doctor.imu_calibration import MOST_FRAMES, measure_imu
    from vslam.run.imu_checks import rotation_text

    require_data(given)
    if given.dataset in LIVE:
        raise InputError(f"--dataset {given.dataset}: record a drive, and calibrate its IMU.")
    source = first_frames(open_given(given, Console(shown=True)), MOST_FRAMES)
    used = Path("" if source.calibration is None else source.calibration.source)
    out = out or (used if _is_own(used) else _DEFAULT_OUT)
    _check_place(out)
    found = measure_imu(source, Config())
    alignment, new = found.alignment, found.new.imu
    assert new is not None
    typer.echo(
        f"measured: rotation {rotation_text(alignment.R_imu_camera)}, standard deviation "
        f"{degrees(alignment.rotation_sigma):.2f} degrees"
    )
    typer.echo(
        f"measured: time_offset {1e3 * alignment.time_offset:+.2f} ms, standard deviation "
        f"{1e3 * alignment.sigma:.2f} ms"
    )
    for name, one in (("old", found.old), ("new", new if found.replaced else None)):
        if one is not None:
            typer.echo(f"{name}: T_imu_camera {rotation_text(one.T_imu_camera)}")
            typer.echo(f"{name}: time_offset {1e3 * one.time_offset:+.2f} ms")
    if not found.replaced:
        typer.echo("The calibration agrees with the measurement, so nothing is written.")
        return
    _keep_earlier(out)
    write_calibration(out, found.new)
    typer.echo(f"{out}: new {' and '.join(found.replaced)}.")
    if not new.T_imu_camera[:3, 3].any():
        typer.echo(
            "The translation is 0, because rotations do not show it; write the position of the "
            "camera in the frame of the IMU into the last column of T_imu_camera, in metres."
        )


def _is_own(file: Path) -> bool:
    """Return whether a file is a calibration in vslam's own format, in YAML."""
    from vslam.calibration.documents import read_document

    return file.suffix in (".yaml", ".yml") and file.is_file() and "left" in read_document(file)


def _check_place(out: Path) -> None:
    from vslam.maps.new_output import require_place

    require_place(out, "--out")
    if out.suffix not in (".yaml", ".yml"):
        raise InputError(f"--out {out}: a calibration is YAML; give a name that ends in .yaml.")
    if out.exists() and not _is_own(out):
        raise InputError(f"--out {out}: belongs to another program; give another name.")


def _keep_earlier(*files: Path) -> None:
    """Rename the files of an earlier calibration, for example ``a.yaml`` to ``a-1.yaml``.

    All files get the same number, the smallest one for which none of the new names exists.
    """
    for n in count(1):
        kept = {path: path.with_stem(f"{path.stem}-{n}") for path in files}
        if not any(path.exists() for path in kept.values()):
            break
    for path in filter(Path.exists, files):
        try:
            path.rename(kept[path])
        except OSError as error:
            raise ResultsError(
                f"{path}: cannot be renamed to {kept[path].name} ({error.strerror}); give another "
                "file with --out."
            ) from error
        typer.echo(f"{kept[path]}: the earlier {path.name}, which is replaced.")


def _board(
    kind: str, size: str, square: float | None, marker: float | None, tags: str, *, stereo: bool
) -> Board:
    from vslam.calibration.boards import Board, Kind, read_board

    if kind not in get_args(Kind):
        if not Path(kind).is_file():
            raise InputError(
                f"--board {kind}: there is no such file; give checkerboard, charuco, aprilgrid or "
                "a target file of Kalibr."
            )
        if size or square is not None or marker is not None:
            raise InputError(
                f"--board {kind}: contains all sizes; leave out --size, --square and --marker."
            )
        return read_board(Path(kind))
    columns, _, rows = size.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise InputError(f"--size {size or 'is missing'}: give columns and rows, such as 9x6.")
    has_markers = kind != "checkerboard"
    if marker is not None and not has_markers:
        raise InputError("--marker: leave it out, because a checkerboard has no markers.")
    if square is None and (stereo or has_markers):
        raise InputError("--square is missing: measure the board and give metres.")
    if marker is None and has_markers:
        raise InputError("--marker is missing: measure the board and give metres.")
    side = 0.1 if square is None else square
    return Board(cast("Kind", kind), int(columns), int(rows), side, marker or 0.0, tags)


def _frames(raw: RawSource, most: int) -> Iterator[TimedFrame]:
    """Yield the frames of a source, or about ``most`` evenly spread frames if it has more.

    If the source ends early because it is damaged, a warning is printed.

    Raises:
        BrokenSourceError: fewer than two frames can be read.
    """
    every = -(-(raw.n_expected or 1) // most)
    n = 0
    try:
        for n, frame in enumerate(raw.frames()):
            if n % every == 0:
                yield frame
    except BrokenSourceError as error:
        if not n:
            raise
        typer.echo(f"warning: {error}", err=True)


def _search(raw: RawSource, board: Board) -> tuple[list[Frame], list[Image]]:
    """Return the corners of the board in each frame, and some of the left images."""
    from vslam.calibration.boards import find_corners, same_order

    total = min(raw.n_expected or _MOST_SEARCHED, _MOST_SEARCHED)
    found: list[Frame] = []
    examined: list[Image] = []
    with Console(shown=True).count_bar("images", total) as advance:
        for n, frame in enumerate(_frames(raw, _MOST_SEARCHED)):
            name = frame.file.name if frame.file else f"{frame.timestamp:.3f} s"
            images = [cast("Image", image) for image in frame.read(map) if image is not None]
            views = [find_corners(board, image, name) for image in images]
            if len(views) == 2 and views[0] and views[1]:
                views[1] = same_order(board, views[0], views[1])
            found.append(tuple(views))
            if n % max(1, total // _EXAMINED) == 0:
                examined.append(images[0])
            advance()
    return found, examined[:_EXAMINED]
