"""Checks of a calibration from images of a board, and its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.boards import Board
from vslam.calibration.models import Array, Calibration
from vslam.calibration.rectification import rectify
from vslam.calibration.solve import CameraFit, PairFit
from vslam.doctor.findings import Finding, judge, sections
from vslam.errors import InputError, write_file
from vslam.report.drawing import BLUE, GREY, LOW, RED, Drawing, draw, new_figure
from vslam.report.page import Code, Page, Section, Tile, Tiles
from vslam.report.render import html

_FEW_VIEWS = 10
# Degrees, and number of views tilted by more. Without tilt, the focal length is not determined.
_TILT, _FEW_TILTED = 15.0, 3
_CELLS = (8, 6)  # cells of the image, across and down
_COVERED = 0.6  # smallest share of cells with corners, which hardly reach the outermost pixels
_LARGE_PX = 0.5  # largest RMS in images of the common width; grows with the width of wider images
_COMMON_WIDTH = 640
_APART_PX = 2.0  # largest RMS between the cameras
_SHARED = 0.2  # largest share of the squared residuals that neighbouring corners have in common
_MOST_DROPPED = 0.25
_ARROW = 0.02  # length of an arrow of the RMS error, relative to the image width


@dataclass(frozen=True)
class Calibrated:
    """A calibration and its estimates.

    Attributes:
        board: the board in the images.
        calibration: the result.
        fits: the estimate of each camera, left first.
        pair: the estimate of the transformation between the cameras; None for a single camera.
        n_seen: number of images that show the board, and of all images.
    """

    board: Board
    calibration: Calibration
    fits: tuple[CameraFit, ...]
    pair: PairFit | None
    n_seen: tuple[int, int]


def findings_of(result: Calibrated) -> list[Finding]:
    """Check each camera, and then the pair."""
    found = [finding for side, fit in _sides(result) for finding in _camera(side, fit)]
    if result.pair is not None:
        n, error = len(result.pair.names), _rms(result.pair.errors)
        fix = "trigger both cameras together, or film the board again while it stands still"
        found += [
            _kept("pairs", n, result.pair.dropped),
            judge("synchronisation", error > _APART_PX, f"{error:.2f} px between the cameras", fix),
        ]
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
    values: list[tuple[str, str, str]] = []
    for side, fit in _sides(result):
        m, n, error = fit.model, len(fit.views), _rms(fit.errors)
        values += [
            (f"{side}focal length", f"{m.fx:.2f}, {m.fy:.2f} px", f"{m.width}x{m.height}"),
            (f"{side}error", f"{error:.3f} px", f"RMS of {n} views"),
        ]
    if result.pair is not None:
        baseline = float(np.linalg.norm(result.pair.T_left_right[:3, 3]))
        values.append(("baseline", f"{baseline:.4f} m", ""))
    tiles = [Tile(name.capitalize(), value, note) for name, value, note in values]
    page = Page(
        "Calibration",
        [str(result.board), "the board is seen in {} of {} images".format(*result.n_seen)],
        [
            Section("", [Tiles(tiles)]),
            *sections(findings),
            Section("", draw(_drawings(result)), wide=False),
            Section("Calibration file", [Code(text)]),
        ],
    )
    write_file(path, html(page), "name another file with --out")


def _sides(result: Calibrated) -> list[tuple[str, CameraFit]]:
    names = ("left ", "right ") if len(result.fits) == 2 else ("",)
    return list(zip(names, result.fits, strict=True))


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def _camera(side: str, fit: CameraFit) -> list[Finding]:
    m, n, error = fit.model, len(fit.views), _rms(fit.errors)
    views = _kept(f"{side}views", n, fit.dropped)
    if n < _FEW_VIEWS:
        fix = f"film the board in at least {_FEW_VIEWS} different places and directions"
        views = Finding(views.check, "fault", f"{views.measured}, too few", fix)
    cosines = np.abs(fit.T_camera_board[:, 2, 2]).clip(0.0, 1.0)
    tilted = int((np.degrees(np.arccos(cosines)) > _TILT).sum())
    xy = np.concatenate([view.corners.xy for view in fit.views])
    share, emptiest = _coverage(xy / (m.width, m.height))
    most = max(_LARGE_PX, m.width * _LARGE_PX / _COMMON_WIDTH)
    shared = _shared(xy / (m.width, m.height), np.concatenate(fit.residuals))
    other = "pinhole" if m.lens == "fisheye" else "fisheye"
    return [
        views,
        judge(
            f"{side}tilt", tilted < _FEW_TILTED,
            f"{tilted} views are tilted by more than {_TILT:.0f} degrees",
            "film the board tilted by 20 to 45 degrees in all directions",
        ),
        judge(
            f"{side}coverage", share < _COVERED, f"corners in {share:.0%} of the image",
            f"film the board in all parts of the image, above all on the {emptiest}",
        ),
        judge(
            f"{side}residuals", error > most, f"{error:.3f} px RMS",
            "check --size, --square and --marker, and film the board flat, sharp and still",
        ),
        judge(
            f"{side}lens", shared > _SHARED,
            f"{m.lens}; {shared:.0%} of the residuals depend on the position in the image",
            f"try --lens {other}",
        ),
    ]  # fmt: skip


def _kept(check: str, n: int, dropped: Sequence[tuple[str, float]]) -> Finding:
    """Check how many images were dropped as outliers."""
    measured = f"{n} {check.split()[-1]}"
    if dropped:
        named = ", ".join(f"{name} ({error:.1f} px)" for name, error in dropped)
        measured += f"; dropped as outliers: {named}"
    fix = "film the board again in good light, flat and still"
    return judge(check, len(dropped) > _MOST_DROPPED * (n + len(dropped)), measured, fix)


def _coverage(at: Array) -> tuple[float, str]:
    """The share of the image that corners cover, and the edge where they cover least; ``at`` holds
    ``(N, 2)`` positions from 0 to 1."""
    cells = np.zeros(_CELLS, bool)
    cells.flat[_cells(at)] = True
    parts = {"left": cells[:2], "right": cells[-2:], "top": cells[:, :2], "bottom": cells[:, -2:]}
    return float(cells.mean()), min(parts, key=lambda name: float(parts[name].mean()))


def _shared(at: Array, residuals: Array) -> float:
    """The share of the squared residuals that neighbours in the image have in common: about 0 for
    noise, nearly 1 for a model that does not fit the lens."""
    cells = _cells(at)
    n = np.bincount(cells)
    sums = np.stack([np.bincount(cells, weights=column) for column in residuals.T], axis=1)
    common = (sums[n > 0] ** 2 / n[n > 0, None]).sum() / (residuals**2).sum()
    by_chance = np.count_nonzero(n) / len(at)
    return float(max(0.0, (common - by_chance) / (1.0 - by_chance)))


def _cells(at: Array) -> NDArray[np.int64]:
    x, y = (at * _CELLS).astype(np.int64).clip(0, np.subtract(_CELLS, 1)).T
    return np.asarray(x * _CELLS[1] + y, np.int64)


def _drawings(result: Calibrated) -> Iterator[Drawing]:
    for side, fit in _sides(result):
        m, name = fit.model, side.strip() or "camera"
        figure, axes = new_figure(f"Corners and residuals: {name}", "x (px)", "y (px)", LOW + 0.8)
        xy = np.concatenate([view.corners.xy for view in fit.views])
        times = _ARROW * m.width / _rms(fit.errors)
        axes.quiver(
            *xy.T, *(times * np.concatenate(fit.residuals).T), angles="xy", scale_units="xy",
            scale=1, color=BLUE, width=0.002,
        )  # fmt: skip
        axes.set(xlim=(0, m.width), ylim=(m.height, 0), aspect="equal")
        yield (
            f"corners-{name}",
            f"The corners of all views with their residuals, enlarged {times:.0f} times. Arrows "
            "should have random directions, and corners should fill the image.",
            figure,
        )
        figure, axes = new_figure(f"Error of each view: {name}", "view", "RMS (px)", LOW)
        errors = [*fit.errors, *(error for _, error in fit.dropped)]
        colours = [BLUE] * len(fit.views) + [RED] * len(fit.dropped)
        axes.bar(np.arange(len(errors)), errors, color=colours)
        axes.axhline(float(np.median(fit.errors)), color=GREY)
        yield f"errors-{name}", "Line: the median. Red: views that were dropped.", figure
