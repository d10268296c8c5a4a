"""Checks a calibration from images of a board, and writes an HTML page with the results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.models import Array
from vslam.calibration.rectification import rectify
from vslam.calibration.solve import CameraFit, Estimate
from vslam.doctor.findings import Finding, judge, sections
from vslam.report.drawing import BLUE, GREY, LOW, RED, Drawing, draw, new_figure
from vslam.report.page import Code, Page, Section, Tile, Tiles
from vslam.report.render import html
from vslam.support.errors import InputError, write_file

_FEW_VIEWS = 10
# A view counts as tilted above the first number, in degrees. The second number is the least number
# of tilted views. Views of a board that faces the camera do not determine the focal length.
_TILT, _FEW_TILTED = 15.0, 3
_CELLS = (8, 6)  # number of cells across and down the image
_COVERED = 0.6  # least share of cells with corners; a whole board hardly reaches the image border
_LARGE_PX = 0.5  # largest RMS, for images of at most the common width; it grows with the width
_COMMON_WIDTH = 640
_APART_PX = 2.0  # largest RMS of the pair; a larger error means that the board moved
_SHARED = 0.2  # largest systematic share of the squared residuals (_systematic_share)
_MOST_DROPPED = 0.25
_ARROW = 0.02  # length of an arrow of the RMS error, relative to the image width


def findings_of(found: Estimate) -> list[Finding]:
    """Check the calibration of each camera, and then the calibration of the pair."""
    findings = [finding for side, fit in _sides(found) for finding in _camera(side, fit)]
    if found.pair is not None:
        error = _rms(found.pair.errors)
        fix = "trigger both cameras together, or film the board again while it stands still"
        findings += [
            _kept("pairs", len(found.pair.errors), found.pair.dropped),
            judge("synchronisation", error > _APART_PX, f"{error:.2f} px between the cameras", fix),
        ]
    try:
        rectify(found.calibration)
    except InputError as error:
        measured, _, fix = str(error).rstrip(".").rpartition("; ")
        findings.append(Finding("rectification", "fault", measured, fix))
    return findings


def write_page(
    found: Estimate, findings: Sequence[Finding], about: str, text: str, path: Path
) -> None:
    """Write a self-contained HTML page about a calibration.

    Args:
        about: line below the title.
        text: content of the calibration file.

    Raises:
        ResultsError: the file cannot be written.
    """
    tiles = []
    for side, fit in _sides(found):
        m, n = fit.model, len(fit.views)
        focal, error = f"{m.fx:.2f}, {m.fy:.2f} px", f"{_rms(fit.errors):.3f} px"
        tiles.append(Tile(f"{side}focal length".capitalize(), focal, f"{m.width}x{m.height}"))
        tiles.append(Tile(f"{side}error".capitalize(), error, f"RMS of {n} views"))
    if found.pair is not None:
        baseline = float(np.linalg.norm(found.pair.T_left_right[:3, 3]))
        tiles.append(Tile("Baseline", f"{baseline:.4f} m", ""))
    parts = [
        Section("", [Tiles(tiles)]),
        *sections(findings),
        Section("", draw(_drawings(found)), wide=False),
        Section("Calibration file", [Code(text)]),
    ]
    page = html(Page("Calibration", [about], parts))
    write_file(path, page, "give another file with --out")


def _sides(found: Estimate) -> list[tuple[str, CameraFit]]:
    names = ("left ", "right ") if len(found.cameras) == 2 else ("",)
    return list(zip(names, found.cameras, strict=True))


def _rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).mean()))


def _camera(side: str, fit: CameraFit) -> list[Finding]:
    m, n, error = fit.model, len(fit.views), _rms(fit.errors)
    views = _kept(f"{side}views", n, fit.dropped)
    if n < _FEW_VIEWS:
        fix = f"film the board in at least {_FEW_VIEWS} different places and directions"
        views = Finding(views.check, "fault", f"{views.measured}, too few", fix)
    facing = np.abs(fit.T_camera_board[:, 2, 2])  # cosine of the angle
    tilted = int(np.count_nonzero(facing < np.cos(np.radians(_TILT))))
    cells = _cells_of_corners(fit)
    full = np.bincount(cells, minlength=_CELLS[0] * _CELLS[1]).reshape(_CELLS) > 0
    share = float(full.mean())
    parts = {"left": full[:2], "right": full[-2:], "top": full[:, :2], "bottom": full[:, -2:]}
    emptiest = min(parts, key=lambda name: float(parts[name].mean()))
    shared = _systematic_share(cells, np.concatenate(fit.residuals))
    return [
        views,
        judge(
            f"{side}tilt", bool(tilted < _FEW_TILTED),
            f"{tilted} views are tilted by more than {_TILT:.0f} degrees",
            "film the board tilted by 20 to 45 degrees in all directions",
        ),
        judge(
            f"{side}coverage", share < _COVERED, f"corners in {share:.0%} of the image",
            f"film the board in all parts of the image, above all on the {emptiest}",
        ),
        judge(
            f"{side}residuals", error > _LARGE_PX * max(1.0, m.width / _COMMON_WIDTH),
            f"{error:.3f} px RMS",
            "check --size, --square and --marker, and film the board flat, sharp and still",
        ),
        judge(
            f"{side}lens", shared > _SHARED,
            f"{m.lens}; {shared:.0%} of the squared residuals depend on the position in the image",
            f"try --lens {'pinhole' if m.lens == 'fisheye' else 'fisheye'}",
        ),
    ]  # fmt: skip


def _kept(check: str, n: int, dropped: Sequence[tuple[str, float]]) -> Finding:
    measured = f"{n} {check.split()[-1]}"
    if dropped:
        named = ", ".join(f"{name} ({error:.1f} px)" for name, error in dropped)
        measured += f"; dropped because they do not fit: {named}"
    fix = "film the board again in good light, flat and still"
    return judge(check, len(dropped) > _MOST_DROPPED * (n + len(dropped)), measured, fix)


def _cells_of_corners(fit: CameraFit) -> NDArray[np.int64]:
    """Divide the image into cells, and return the cell number of each detected board corner.

    The corners of all views of the board are included. Cells are numbered column by column.
    """
    xy = np.concatenate([view.xy for view in fit.views]) / (fit.model.width, fit.model.height)
    x, y = (xy * _CELLS).astype(np.int64).clip(0, np.subtract(_CELLS, 1)).T
    return np.asarray(x * _CELLS[1] + y, np.int64)


def _systematic_share(cells: NDArray[np.int64], residuals: Array) -> float:
    """Return the systematic fraction of the squared reprojection errors, from 0 to 1.

    It is the fraction that is explained by the mean error in each cell of the image. It is about 0
    for noise, and close to 1 for a camera model that does not fit the lens.
    """
    n = np.bincount(cells)
    sums = np.stack([np.bincount(cells, weights=column) for column in residuals.T], axis=1)
    common = (sums[n > 0] ** 2 / n[n > 0, None]).sum() / (residuals**2).sum()
    by_chance = np.count_nonzero(n) / len(cells)
    return float(max(0.0, (common - by_chance) / (1.0 - by_chance)))


def _drawings(found: Estimate) -> Iterator[Drawing]:
    for side, fit in _sides(found):
        m, name = fit.model, side.strip() or "camera"
        figure, axes = new_figure(f"Corners and residuals: {name}", "x (px)", "y (px)", LOW + 0.8)
        times = _ARROW * m.width / _rms(fit.errors)
        axes.quiver(
            *np.concatenate([view.xy for view in fit.views]).T,
            *(times * np.concatenate(fit.residuals).T),
            angles="xy", scale_units="xy", scale=1, color=BLUE, width=0.002,
        )  # fmt: skip
        axes.set(xlim=(0, m.width), ylim=(m.height, 0), aspect="equal")
        yield (
            f"corners-{name}",
            f"Every corner of all views with its residual, enlarged {times:.0f} times. In a good "
            "calibration, arrows point in all directions, and corners fill the image.",
            figure,
        )
        figure, axes = new_figure(f"Error of each view: {name}", "view", "RMS (px)", LOW)
        errors = [*fit.errors, *(error for _, error in fit.dropped)]
        colours = [BLUE] * len(fit.views) + [RED] * len(fit.dropped)
        axes.bar(np.arange(len(errors)), errors, color=colours)
        axes.axhline(float(np.median(fit.errors)), color=GREY)
        yield f"errors-{name}", "The line is the median. Red views were dropped.", figure
