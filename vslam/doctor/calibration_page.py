"""The verdicts on a calibration from images of a board, and its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vslam.calibration.boards import Board
from vslam.calibration.models import Array, Calibration
from vslam.calibration.rectification import rectify
from vslam.calibration.solve import CameraFit, PairFit, rms
from vslam.doctor.findings import Finding, judge
from vslam.errors import InputError
from vslam.report.drawing import BLUE, GREY, LOW, RED, Drawing, draw, new_figure
from vslam.report.page import Code, Page, Row, Section, Table, Tile, Tiles
from vslam.report.render import html, write_files

_FEW_VIEWS = 10
_TILT, _FEW_TILTED = 15.0, 3  # degrees; a board that is never tilted fixes no focal length
_CELLS = (8, 6)  # of the image, across and down
_COVERED = 0.6  # share of the cells; corners hardly reach the outermost pixels
_LARGE_PX = 1.0  # RMS; half a pixel is usual for a video
_BENT = 2.0  # residuals in the outer half of the corners over those in the inner half
_MOST_DROPPED = 0.25
_ARROW = 60.0  # times which residuals are drawn


@dataclass(frozen=True)
class Calibrated:
    """A calibration and what it was estimated from.

    Attributes:
        board: what was filmed.
        calibration: the result.
        fits: the estimate of each camera, left first.
        pair: the estimate of the transformation; None for a single camera.
        n_seen: images that show the board, and images searched.
    """

    board: Board
    calibration: Calibration
    fits: tuple[CameraFit, ...]
    pair: PairFit | None
    n_seen: tuple[int, int]


def findings_of(result: Calibrated) -> list[Finding]:
    """The verdicts, for each camera and then for the pair."""
    found = []
    for side, fit in _sides(result):
        found += [
            _views(side, fit), _tilt(side, fit), _coverage(side, fit), _residuals(side, fit),
            _lens(side, fit),
        ]  # fmt: skip
    if result.pair is not None:
        n, error = len(result.pair.names), _total(result.pair.errors)
        found += [
            _dropped("pairs", n, result.pair.dropped, f"{n} pairs, {error:.2f} px RMS"),
            judge(
                "synchronisation", error > 2 * _LARGE_PX, f"{error:.2f} px between the cameras",
                "trigger both cameras together, or hold the board still",
            ),
        ]  # fmt: skip
    try:
        rectify(result.calibration)
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        found.append(Finding("rectification", "fault", measured, fix))
    return found


def write_page(result: Calibrated, findings: Sequence[Finding], text: str, path: Path) -> None:
    """Write the page as self-contained HTML.

    Args:
        text: the calibration file.

    Raises:
        ResultsError: the file cannot be written.
    """
    tiles = []
    for side, fit in _sides(result):
        m = fit.model
        tiles += [
            Tile(f"{side}focal length", f"{m.fx:.2f}, {m.fy:.2f} px", f"{m.width}x{m.height}"),
            Tile(f"{side}error", f"{_total(fit.errors):.3f} px", f"RMS of {len(fit.views)} views"),
        ]
    if result.calibration.T_left_right is not None:
        baseline = float(np.linalg.norm(result.calibration.T_left_right[:3, 3]))
        tiles.append(Tile("Baseline", f"{baseline:.4f} m"))
    head = ("check", "verdict", "measured", "fix")
    rows: list[Row] = [(f.check, f.verdict, f.measured, f.fix) for f in findings]
    page = Page(
        "Calibration",
        [str(result.board), "the board is seen in {} of {} images".format(*result.n_seen)],
        [
            Section("", [Tiles(tiles)]),
            Section("Verdicts", [Table(head, rows, head)]),
            Section("", draw(_drawings(result))),
            Section("Calibration file", [Code(text)]),
        ],
    )
    write_files(path.parent, {path.name: html(page)}, "name another file with --out")


def _sides(result: Calibrated) -> list[tuple[str, CameraFit]]:
    names = ("left ", "right ") if len(result.fits) == 2 else ("",)
    return list(zip(names, result.fits, strict=True))


def _total(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def _dropped(check: str, n: int, dropped: Sequence[tuple[str, float]], measured: str) -> Finding:
    if dropped:
        named = ", ".join(f"{name} ({error:.1f} px)" for name, error in dropped)
        measured += f"; dropped because they do not fit: {named}"
    return judge(
        check, len(dropped) > _MOST_DROPPED * (n + len(dropped)), measured,
        "keep the board flat and still, and film it in good light",
    )  # fmt: skip


def _views(side: str, fit: CameraFit) -> Finding:
    n = len(fit.views)
    if n < _FEW_VIEWS:
        fix = f"film the board in at least {_FEW_VIEWS} different places and directions"
        return Finding(f"{side}views", "fault", f"{n} views are too few", fix)
    return _dropped(f"{side}views", n, fit.dropped, f"{n} views")


def _tilt(side: str, fit: CameraFit) -> Finding:
    cosine = np.abs(fit.T_camera_board[:, 2, 2])
    n = int((np.degrees(np.arccos(cosine.clip(0, 1))) > _TILT).sum())
    return judge(
        f"{side}tilt", n < _FEW_TILTED, f"{n} views are tilted by more than {_TILT:.0f} degrees",
        "tilt the board: without that, focal length and distance cannot be told apart",
    )  # fmt: skip


def _coverage(side: str, fit: CameraFit) -> Finding:
    size = (fit.model.width, fit.model.height)
    cells = np.zeros(_CELLS, bool)
    at = (np.concatenate([view.corners.xy for view in fit.views]) / size * _CELLS).astype(int)
    cells[tuple(at.clip(0, np.subtract(_CELLS, 1)).T)] = True
    share = cells.mean()
    thirds = [np.array_split(part, 3, axis=1) for part in np.array_split(cells, 3, axis=0)]
    shares = {
        f"{row} {column}".replace("middle middle", "middle"): thirds[x][y].mean()
        for x, column in enumerate(("left", "middle", "right"))
        for y, row in enumerate(("upper", "middle", "lower"))
    }
    return judge(
        f"{side}coverage", share < _COVERED, f"corners in {share:.0%} of the image",
        f"film the board everywhere, above all {min(shares, key=shares.__getitem__)}",
    )  # fmt: skip


def _residuals(side: str, fit: CameraFit) -> Finding:
    error = _total(fit.errors)
    return judge(
        f"{side}residuals", error > _LARGE_PX, f"{error:.3f} px RMS",
        "check that the board is flat, sharp and still, and that its columns and rows are right",
    )  # fmt: skip


def _lens(side: str, fit: CameraFit) -> Finding:
    """Whether the residuals grow towards the border, as those of a model that does not fit do."""
    m = fit.model
    xy = np.concatenate([view.corners.xy for view in fit.views])
    far = np.linalg.norm(xy - (m.cx, m.cy), axis=1)
    residuals = np.concatenate(fit.residuals)
    outer = far > np.median(far)
    ratio = rms(residuals[outer]) / max(rms(residuals[~outer]), 1e-9)
    other = "pinhole" if m.lens == "fisheye" else "fisheye"
    return judge(
        f"{side}lens", ratio > _BENT, f"{m.lens}; residuals outside are {ratio:.1f} times those "
        "inside", f"try --lens {other}",
    )  # fmt: skip


def _drawings(result: Calibrated) -> Iterator[Drawing]:
    for side, fit in _sides(result):
        m, name = fit.model, side.strip() or "camera"
        figure, axes = new_figure(f"Corners and residuals: {name}", "x (px)", "y (px)", LOW + 0.8)
        xy = np.concatenate([view.corners.xy for view in fit.views])
        residuals = np.concatenate(fit.residuals)
        axes.quiver(
            *xy.T, *(_ARROW * residuals.T), angles="xy", scale_units="xy", scale=1, color=BLUE,
            width=0.002,
        )  # fmt: skip
        axes.set(xlim=(0, m.width), ylim=(m.height, 0), aspect="equal")
        yield (
            f"corners-{name}",
            f"Every corner of all views with its residual, enlarged {_ARROW:.0f} times. Arrows "
            "should point anywhere, and corners should fill the image.",
            figure,
        )
        figure, axes = new_figure(f"Error of each view: {name}", "view", "RMS (px)", LOW)
        errors = [*fit.errors, *(error for _, error in fit.dropped)]
        colours = [BLUE] * len(fit.views) + [RED] * len(fit.dropped)
        axes.bar(np.arange(len(errors)), errors, color=colours)
        axes.axhline(float(np.median(fit.errors)), color=GREY)
        yield f"errors-{name}", "Line: the median. Red: views that were dropped.", figure
