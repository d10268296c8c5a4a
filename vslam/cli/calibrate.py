"""The command ``vslam calibrate``."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import typer

from vslam.cli.console import Console
from vslam.cli.options import reads_source
from vslam.errors import BrokenSourceError, InputError, ResultsError

if TYPE_CHECKING:
    from vslam.calibration.boards import Board
    from vslam.calibration.solve import View
    from vslam.camera import Image
    from vslam.datasets.frames import RawSource, TimedFrame
    from vslam.datasets.sources import SourceOptions

_EXAMPLES = """
[b]Examples[/b]

  vslam calibrate board.mp4 --board checkerboard --size 9x6 --square 0.025

  vslam calibrate pair.mkv --side-by-side --board charuco --size 7x5 --square 0.04 --marker 0.03

  vslam calibrate cam_april/mav0 --board april_6x6.yaml --lens fisheye --out stereo.yaml
"""
_MOST_SEARCHED = 300  # images, spread evenly; a minute or two
_MOST_VIEWS = 60
_ALONE = 20  # of these, views of one camera of a pair alone
_EXAMINED = 10  # images in which another board is looked for
if TYPE_CHECKING:
    Dictionary = str
else:
    Dictionary = Literal[
        (
            *(f"{bits}X{bits}_{n}" for bits in (4, 5, 6, 7) for n in (50, 100, 250, 1000)),
            *("ARUCO_ORIGINAL", "ARUCO_MIP_36h12"),
            *(f"APRILTAG_{name}" for name in ("16h5", "25h9", "36h10", "36h11")),
        )
    ]


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
@reads_source(without=("calib", "depth", "depth_scale", "mask"))
def calibrate(
    given: SourceOptions,
    board: Annotated[
        str,
        typer.Option(
            metavar="KIND|FILE",
            help="[b]checkerboard[/b], [b]charuco[/b], [b]aprilgrid[/b], or the YAML of a target "
            "of Kalibr, which has all sizes.",
        ),
    ],
    size: Annotated[
        str,
        typer.Option(
            metavar="COLUMNSxROWS",
            help="Inner corners of a checkerboard, squares of a ChArUco board, tags of an "
            "AprilGrid.",
        ),
    ] = "",
    square: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Side of a square in metres; of an AprilGrid, from one tag to the next. A single "
            "camera does not need it for a checkerboard.",
            show_default=False,
        ),
    ] = None,
    marker: Annotated[
        float | None,
        typer.Option(
            metavar="METRES", help="Side of a marker or tag in metres.", show_default=False
        ),
    ] = None,
    dictionary: Annotated[
        Dictionary,
        typer.Option(
            metavar="NAME",
            help="Markers of a ChArUco board, by OpenCV's name without DICT_.",
            case_sensitive=False,
        ),
    ] = "5X5_1000",
    lens: Annotated[
        Literal["pinhole", "fisheye"],
        typer.Option(
            metavar="pinhole|fisheye",
            help="[b]pinhole[/b] has radial-tangential distortion; [b]fisheye[/b] is equidistant, "
            "for angles of view above about 120 degrees.",
        ),
    ] = "pinhole",
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Calibration to write; the page beside it ends in .html. Those of an earlier try "
            "are kept under another name.",
        ),
    ] = Path("calibration.yaml"),
) -> None:
    """Calibrate a camera or a stereo pair from images of a board; exit code 1 if the result is
    doubtful."""
    from vslam.calibration.boards import other_board
    from vslam.calibration.files import write_calibration
    from vslam.calibration.models import Calibration
    from vslam.calibration.solve import fit_camera, fit_pair
    from vslam.datasets.sources import open_raw
    from vslam.doctor.calibration_page import Calibrated, findings_of, write_page
    from vslam.doctor.findings import lines

    if given.sensor == "rgbd":
        raise InputError("--sensor rgbd: depth is not calibrated; give mono or stereo.")
    _check_place(out)
    raw = open_raw(given)
    if raw.live and given.max_frames is None:
        raise InputError(f"{given.data}: a camera never ends; give --max-frames, such as 300.")
    made = _board(board, size, square, marker, dictionary, stereo=len(raw.sizes) == 2)
    n, seen, examined = _search(raw, made)
    try:
        chosen = _choose(made, raw, seen, n)
        fits = tuple(
            fit_camera(made, views, raw.sizes[side], lens) for side, views in enumerate(chosen)
        )
        pair = fit_pair(made, *fits) if len(fits) == 2 else None
    except InputError as error:
        what, _, fix = str(error).rstrip(".").rpartition("; ")
        fix = other_board(made, examined) or fix
        raise InputError(f"{given.data}: {what}; {fix}.") from error
    calibration = Calibration(fits[0].model, source=str(out))
    if pair is not None:
        calibration = replace(calibration, right=fits[1].model, T_left_right=pair.T_left_right)
    result = Calibrated(made, calibration, fits, pair, (len(seen), n))
    findings = findings_of(result)
    typer.echo(f"The {made} is seen in {len(seen)} of {n} images.")
    for line in lines(findings):
        typer.echo(line)
    page = out.with_suffix(".html")
    _keep_earlier(out, page)
    write_calibration(out, calibration)
    write_page(result, findings, out.read_text("utf-8"), page)
    typer.echo(f"{out}: the calibration; {page}: residuals and coverage.")
    if any(finding.verdict == "fault" for finding in findings):
        fix = other_board(made, examined) or "do what the fixes above say"
        typer.echo(f"Do not use this calibration, because it has faults; {fix}, and try again.")
        raise typer.Exit(1)
    options = " --side-by-side" if given.side_by_side else ""
    options += " --sensor mono" if pair is None else ""
    typer.echo("Next, with a drive:")
    for command in ("doctor", "run"):
        typer.echo(f"  vslam {command} DRIVE{options} --calib {shlex.quote(str(out))}")


def _check_place(out: Path) -> None:
    """Refuse, before any work, a file that cannot be written or that another program made."""
    from vslam.calibration.documents import read_document
    from vslam.maps.new_output import require_place

    require_place(out, "--out")
    if out.suffix not in (".yaml", ".yml"):
        raise InputError(f"--out {out}: a calibration is YAML; give a name that ends in .yaml.")
    if out.exists() and "left" not in read_document(out):
        raise InputError(f"--out {out}: is another program's file; name a new one.")


def _keep_earlier(*files: Path) -> None:
    """Rename the files of an earlier try to the first number that is free for all of them."""
    for n in count(1):
        kept = [path.with_stem(f"{path.stem}-{n}") for path in files]
        if not any(path.exists() for path in kept):
            break
    for path, free in zip(files, kept, strict=True):
        if path.exists():
            try:
                path.rename(free)
            except OSError as error:
                raise ResultsError(
                    f"{path}: cannot be renamed to {free.name} ({error.strerror}); name another "
                    "file with --out."
                ) from error
            typer.echo(f"{free}: the earlier {path.name}, which is replaced.")


def _board(
    kind: str,
    size: str,
    square: float | None,
    marker: float | None,
    dictionary: str,
    *,
    stereo: bool,
) -> Board:
    """The board that the options describe."""
    from vslam.calibration.boards import Board, Kind, read_board

    if kind not in get_args(Kind):
        if not Path(kind).is_file():
            raise InputError(
                f"--board {kind}: is no file; give checkerboard, charuco, aprilgrid or a target "
                "of Kalibr."
            )
        if size or square is not None or marker is not None:
            raise InputError(
                f"--board {kind}: holds all sizes; leave out --size, --square and --marker."
            )
        return read_board(Path(kind))
    found = re.fullmatch(r"(\d+)x(\d+)", size)
    if found is None:
        raise InputError(f"--size {size or 'is missing'}: give columns and rows, such as 9x6.")
    has_markers = kind != "checkerboard"
    for option, missing in (
        ("--square", square is None and (stereo or has_markers)),
        ("--marker", marker is None and has_markers),
    ):
        if missing:
            raise InputError(f"{option} is missing: measure the board and give metres.")
    if marker is not None and not has_markers:
        raise InputError("--marker: leave it out, because a checkerboard has no markers.")
    side = 0.1 if square is None else square
    columns, rows = int(found[1]), int(found[2])
    return Board(cast("Kind", kind), columns, rows, side, marker or 0.0, dictionary)


def _frames(raw: RawSource, most: int) -> Iterator[TimedFrame]:
    """Frames of a source, evenly spread."""
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


def _search(raw: RawSource, board: Board) -> tuple[int, list[tuple[View | None, ...]], list[Image]]:
    """How many images were searched, the views of each that shows the board to a camera, and a few
    left images."""
    from vslam.calibration.boards import corner_finder, same_order
    from vslam.calibration.solve import View

    find = corner_finder(board)
    total = min(raw.n_expected or _MOST_SEARCHED, _MOST_SEARCHED)
    seen: list[tuple[View | None, ...]] = []
    examined: list[Image] = []
    n = 0
    with Console(shown=True).count_bar("images", total) as advance:
        for frame in _frames(raw, _MOST_SEARCHED):
            name = frame.file.name if frame.file else f"{frame.timestamp:.2f} s"
            images = [cast("Image", image) for image in frame.read(map) if image is not None]
            corners = [find(image) for image in images]
            if len(corners) == 2 and corners[0] and corners[1]:
                corners[1] = same_order(board, corners[0], corners[1])
            if any(corners):
                seen.append(tuple(None if c is None else View(name, c) for c in corners))
            if n % max(1, total // _EXAMINED) == 0:
                examined.append(images[0])
            n += 1
            advance()
    return n, seen, examined[:_EXAMINED]


def _choose(
    board: Board, raw: RawSource, seen: list[tuple[View | None, ...]], n: int
) -> list[list[View]]:
    """The views of each camera to calibrate with: of a pair, above all those of both.

    Raises:
        InputError: the board is not seen, or not by both cameras.
    """
    from vslam.calibration.solve import diverse

    sides = [[s[k] for s in seen if s[k]] for k in range(len(raw.sizes))]
    if not any(sides):
        raise InputError(
            f"no {board} in any of {n} images; no other board is recognised either, so check that "
            "this is the right video or folder, and that images show all of the board, sharp."
        )
    for side, other, name in ((0, 1, "left"), (1, 0, "right")):
        if len(sides) == 2 and not sides[side]:
            raise InputError(
                f"the {name} camera never sees the {board}, which the other one sees in "
                f"{len(sides[other])} of {n} images; hold it where both cameras see it, or give "
                "--sensor mono."
            )
    both = [tuple(v for v in s if v is not None) for s in seen if all(s)]
    chosen = [both[k] for k in diverse(board, both, raw.sizes, _MOST_VIEWS)]
    views = [[pair[k] for pair in chosen] for k in range(len(sides))]
    for k, size in enumerate(raw.sizes if len(sides) == 2 else ()):
        alone = [v for s in seen if (v := s[k]) is not None and not all(s)]
        views[k] += [alone[i] for i in diverse(board, [(v,) for v in alone], [size], _ALONE)]
    return views
