"""The schema of ``loops.json``, on which scripts may rely."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from vslam.report.schema import Document, Record


class Curve(Record):
    """A precision-recall curve at selected thresholds, beginning with the lowest threshold."""

    precision: list[float]
    recall: list[float]


class Verified(Record):
    """The result of verifying the most similar gallery image of each query.

    - ``right``: share of the queries for which the image passes verification and shows the same
      place. Only queries whose place is in the gallery are counted.
    - ``wrong``: number of queries for which the image passes verification but shows another place.
    """

    right: float
    wrong: int


class Score(Record):
    """The figures of one loop detector on one set of images under one condition.

    A *condition* is a change of the query images.

    - ``figures``: figures without verification, as returned by
      `vslam.loopclosure.precision_recall.summary`.
    - ``accuracy``: balanced accuracy for several thresholds on the probability p. None for
      detectors that compute no probability.
    - ``accepted``: precision and recall if pairs with a probability of at least 0.9 are accepted.
      None for detectors that compute no probability, and in older files.
    - ``queries``: number of queries whose place is in the gallery.
    - ``first_right``: share of these queries for which the most similar image shows the same place.
    - ``sequence_right``: the same share if sequences of images are compared instead of single
      images. None for images without an order.
    - ``verified``: results by kind of verification: ORB descriptors (``orb``), learned local
      descriptors (``learned``), and at least one of the two (``both``). Empty without verification.
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
    """A precision-recall curve over the images of a drive, at selected thresholds.

    The thresholds are in ascending order.
    """

    threshold: list[float]
    precision: list[float]
    recall: list[float]


class OnlineScore(Record):
    """The figures of one loop detector on one drive, with one decision per image.

    `vslam.lab.loopbench.online` defines the figures.

    - ``window``: the images just before a query, which are not searched for a match.
    - ``verified_by``: kind of verification. It is ``nothing``, ``orb``, ``learned`` (local
      descriptors), or ``both``, which means that one of the two is sufficient.
    - ``answerable``: number of images that have a true match before their window.
    - ``right``: number of matches that are marked as the same place, at the lowest threshold.
    - ``near``: number of matches that were taken near the place but are not marked as the same
      place, at the lowest threshold.
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
    """Difference between the average precision (AP) of two detectors: ``second`` minus ``first``.

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
    """Median costs of one loop detector, measured in a separate process with one thread.

    - ``image_ms``: CPU time per image in milliseconds. The extraction of ORB features is not
      included, because tracking needs these features in any case.
    - ``query_ms``: CPU time per query in milliseconds, by number of keyframes.
    """

    detector: str
    load_s: float
    image_ms: float
    query_ms: dict[str, float]
    parameters: int
    memory_mb: float


class LoopsJson(Document):
    """The results of ``vslam loops bench``, as in ``loops.json``.

    ``kind`` distinguishes this file from reports of runs. With the protocol ``retrieval``, the
    results are in ``cells``, ``gains`` and ``costs``. With the protocol ``online``, they are in
    ``online``.
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
