"""The schema of ``loops.json``: what scripts may rely on."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from vslam.report.document import Document, Record


class Curve(Record):
    """Precision and recall from the lowest threshold on, thinned out."""

    precision: list[float]
    recall: list[float]


class Verified(Record):
    """``right``: share of the queries that have a place in the gallery whose best image shows it
    and passes verification; ``wrong``: queries whose best image shows another place and passes."""

    right: float
    wrong: int


class Score(Record):
    """One detector on one set of images under one condition.

    ``figures`` are those of :func:`vslam.loopclosure.precision_recall.summary`, of descriptors
    alone; ``accuracy`` is balanced, at thresholds on p, None for detectors without. ``accepted``:
    precision and recall of the pairs with p of at least 0.9, None likewise, and in older files.
    ``first_right``: share of the ``queries`` that have a place in the gallery whose best image
    shows it; ``sequence_right``: the same where scores are added along sequences, None of images
    without order. ``verified``: by ``orb``, by ``learned`` local descriptors, by ``both``, one
    of the two; empty where only descriptors are measured.
    """

    data: str
    condition: str
    detector: str
    figures: dict[str, float]
    accuracy: dict[str, float | None]
    accepted: tuple[float, float] | None = None
    queries: int
    first_right: float
    sequence_right: float | None = None
    verified: dict[str, Verified]
    curve: Curve


class DecisionCurve(Record):
    """Precision and recall over images at thresholds on the score, ascending, thinned out."""

    threshold: list[float]
    precision: list[float]
    recall: list[float]


class OnlineScore(Record):
    """One detector on one drive, one decision an image (:mod:`vslam.lab.loopbench.online`).

    ``window``: the youngest images, which are not searched. ``verified_by``: ``nothing``, ``orb``,
    ``learned`` local descriptors, ``both``, one of the two. Of the ``images``, ``answerable`` have
    a true match before the window. At the lowest threshold ``right`` images have a true match,
    ``near`` one that lies near the place but is not marked, ``far`` one of another place. Figures
    count near as wrong, those that end in ``_far`` leave it out. ``max_f1_threshold`` is None
    where nothing is found.
    """

    data: str
    detector: str
    window: str
    verified_by: Literal["nothing", "orb", "learned", "both"]
    images: int
    answerable: int
    right: int
    near: int
    far: int
    recall_at_100_precision: float
    recall_at_100_precision_far: float
    max_f1: float
    max_f1_far: float
    max_f1_threshold: float | None
    curve: DecisionCurve


class Gain(Record):
    """AP of ``second`` minus that of ``first``, with the 95 % interval over the queries."""

    data: str
    condition: str
    first: str
    second: str
    difference: float
    low: float
    high: float


class Cost(Record):
    """Of one detector in a process of its own, one thread; medians.

    ``image_ms``: what is needed of an image beyond the ORB features that tracking has anyway;
    ``query_ms``: by number of keyframes.
    """

    detector: str
    load_s: float
    image_ms: float
    query_ms: dict[str, float]
    parameters: int
    memory_mb: float


class LoopsJson(Document):
    """``kind`` distinguishes this file from those of runs.

    ``cells``, ``gains`` and ``costs`` are of the protocol retrieval, ``online`` of the other one.
    """

    kind: Literal["loops"] = "loops"
    schema_version: int = 3

    seed: int
    cells: list[Score]
    online: tuple[OnlineScore, ...] = ()
    gains: list[Gain]
    costs: list[Cost]

    machine: str
    versions: dict[str, str]
    created: datetime
