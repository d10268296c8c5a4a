"""The page of a diagnosis: a table of findings, and pictures."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2

from vslam.doctor.examine import Diagnosis, Picture
from vslam.errors import ResultsError
from vslam.report.page import Row, Table, render_page

HEAD = ("check", "verdict", "measured", "fix")


def write_page(diagnosis: Diagnosis, title: str, path: Path) -> None:
    """Write the page as self-contained HTML.

    Raises:
        ResultsError: the file cannot be written.
    """
    rows: list[Row] = [(f.check, f.verdict, f.measured, f.fix) for f in diagnosis.findings]
    page = render_page(
        "doctor.html.jinja",
        title=title,
        table=Table("Findings", HEAD, rows, HEAD),
        faults=len(diagnosis.faults),
        pictures=[(_jpeg(picture), picture.caption) for picture in diagnosis.pictures],
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ResultsError(
            f"{path}: cannot be written ({error.strerror}); name another file with --out."
        ) from error


def _jpeg(picture: Picture) -> str:
    data = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return base64.b64encode(data.tobytes()).decode()
