"""The page of a diagnosis: a table of findings, and pictures."""

from __future__ import annotations

from pathlib import Path

import cv2

from vslam.doctor.examine import Diagnosis, Picture
from vslam.doctor.findings import sections
from vslam.errors import counted, write_file
from vslam.report.page import Figure, Page, Section
from vslam.report.render import html


def write_page(diagnosis: Diagnosis, title: str, path: Path) -> None:
    """Write the page as self-contained HTML: faults with their fixes first, then the other checks.

    Raises:
        ResultsError: the file cannot be written.
    """
    faults = len(diagnosis.faults)
    figures = [
        Figure(f"picture-{k}", picture.caption, _jpeg(picture))
        for k, picture in enumerate(diagnosis.pictures)
    ]
    page = Page(
        title,
        [counted(faults, "fault") if faults else "no faults"],
        [*sections(diagnosis.findings), Section("", figures)],
    )
    write_file(path, html(page), "name another file with --out")


def _jpeg(picture: Picture) -> bytes:
    data = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return bytes(data.tobytes())
