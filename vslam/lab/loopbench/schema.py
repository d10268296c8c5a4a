"""The schema of ``loops.json``, which scripts may rely on."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from vslam.report.schema import Document, Record


class Curve(Record):
    """Precision and recall at selected thresholds, from the lowest one upwards."""

    precision: list[float]
    recall: list[float]


class Verified(Record):
    """Queries whose best image passes verification.

    ``right``: share of the queries with a place in the gallery whose best image shows this place
    and is verified. ``wrong``: number of queries whose best image shows another place and is
    verified.
    """

    right: float
    wrong: int


class Score(Record):
    """One detector on one set of images under one condition.

    - ``figures``: see :func:`vslam.loopclosure.precision_recall.summary`; without verification.
    - ``accuracy``: balanced accuracy by threshold on the probability p; None for detectors that
      give no probability.
    - ``accepted``: precision and recall of the pairs with p of at least 0.9; None without p and in
      older files.
    - ``queries``: number of queries with a place in the gallery.
    - ``first_right``: share of these queries whose best image shows their place.
    - ``sequence_right``: the same for scores added along sequences; None for images without order.
    - ``verified``: the images verified by ``orb``, by ``learned`` local descriptors, or by at least
      one of the two (``both``); empty without verification.
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
    """Precision and recall over images at selected thresholds on the score, in ascending order."""

    threshold: list[float]
    precision: list[float]
    recall: list[float]


class OnlineScore(Record):
    """One detector on one drive, with one decision per image (:mod:`vslam.lab.loopbench.online`).

    - ``window``: the images just before a query, which are not searched.
    - ``verified_by``: ``nothing``, ``orb``, ``learned`` local descriptors, or ``both`` (at least
      one of the two).
    - ``answerable``: number of images that have a true match before the window.
    - ``right``, ``near``, ``far``: numbers of matches, at the lowest threshold, that are marked as
      the same place, that are near the place but not marked, and that show another place.
    - Figures whose names end in ``_far`` leave out near matches; the other figures count near
      matches as wrong.
    - ``max_f1_threshold``: None if no image has a match.
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
    """AP of ``second`` minus that of ``first``, with a 95 % bootstrap interval over the queries."""

    data: str
    condition: str
    first: str
    second: str
    difference: float
    low: float
    high: float


class Cost(Record):
    """Median costs of one detector in a separate process with one thread.

    ``image_ms``: time per image, without the ORB features, which tracking extracts anyway.
    ``query_ms``: time per query, by number of keyframes.
    """

    detector: str
    load_s: float
    image_ms: float
    query_ms: dict[str, float]
    parameters: int
    memory_mb: float


class LoopsJson(Document):
    """The results of ``vslam loops bench``. ``kind`` distinguishes this file from reports of runs.
    The protocol ``retrieval`` fills ``cells``, ``gains`` and ``costs``; the protocol ``online``
    fills ``online``.
    """

    kind: Literal["loops"] = "loops"
    schema_version: int = 3

    seed: int
    cells: tuple[Score, ...] = ()
    online: tuple[OnlineScore, ...] = ()
    gains: tuple[Gain, ...] = ()
    costs: tuple[Cost, ...] = ()

    machine: str
    versions: dict[str, str]
    created: datetime
