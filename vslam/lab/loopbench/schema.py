"""The schema of ``loops.json``. Scripts may rely on it."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from vslam.report.schema import Document, Record


class Curve(Record):
    """Precision and recall at selected thresholds, beginning with the lowest threshold."""

    precision: list[float]
    recall: list[float]


class Verified(Record):
    """Queries whose most similar gallery image passes verification.

    - ``right``: share of the queries whose verified image shows the same place. It is a share of
      the queries whose place is in the gallery.
    - ``wrong``: number of queries whose verified image shows another place.
    """

    right: float
    wrong: int


class Score(Record):
    """One detector on one set of images under one condition.

    - ``figures``: figures without verification, see `vslam.loopclosure.precision_recall.summary`.
    - ``accuracy``: balanced accuracy by threshold on the probability p. None for detectors that
      compute no probability.
    - ``accepted``: precision and recall of the pairs with a probability of at least 0.9. None for
      detectors that compute no probability, and in older files.
    - ``queries``: number of queries whose place is in the gallery.
    - ``first_right``: share of these queries whose most similar image shows their place.
    - ``sequence_right``: the same share for scores of sequences. None for images without an order.
    - ``verified``: results of verification by ``orb``, by ``learned`` local descriptors, and by at
      least one of them (``both``). Empty without verification.
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
    """Precision and recall over images, at selected thresholds on the score in ascending order."""

    threshold: list[float]
    precision: list[float]
    recall: list[float]


class OnlineScore(Record):
    """One detector on one drive, with one decision per image (`vslam.lab.loopbench.online`).

    - ``window``: the images just before a query, in which no match is searched for.
    - ``verified_by``: ``nothing``, ``orb``, ``learned`` local descriptors, or ``both`` if one of
      the two is sufficient.
    - ``answerable``: number of images that have a true match before the window.
    - ``right``: number of matches that are marked as the same place, at the lowest threshold.
    - ``near``: number of matches that are near the place but not marked, at the lowest threshold.
    - ``far``: number of matches that show another place, at the lowest threshold.
    - Figures whose names end in ``_far`` leave out near matches. The other figures count near
      matches as wrong.
    - ``max_f1_threshold``: threshold with the largest F1 score. None if no image has a match.
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
    """Average precision (AP) of ``second`` minus that of ``first``.

    The 95 % interval is computed by a bootstrap over the queries.
    """

    data: str
    condition: str
    first: str
    second: str
    difference: float
    low: float
    high: float


class Cost(Record):
    """Median costs of one detector in a separate process with one thread.

    - ``image_ms``: time per image. It does not include the ORB features, which tracking extracts
      anyway.
    - ``query_ms``: time per query, by number of keyframes.
    """

    detector: str
    load_s: float
    image_ms: float
    query_ms: dict[str, float]
    parameters: int
    memory_mb: float


class LoopsJson(Document):
    """The results of ``vslam loops bench``.

    ``kind`` distinguishes this file from reports of runs. The protocol ``retrieval`` writes
    ``cells``, ``gains`` and ``costs``. The protocol ``online`` writes ``online``.
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
