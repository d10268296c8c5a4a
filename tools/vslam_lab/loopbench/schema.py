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
    """The geometric verification of the most similar gallery image of each query.

    - ``right``: share of the queries whose most similar image passes verification and shows the
      same place. Only queries whose place is in the gallery are counted.
    - ``wrong``: number of queries whose most similar image passes verification but shows another
      place.
    """

    right: float
    wrong: int


class Score(Record):
    """The metrics of one loop detector on one set of images under one condition.

    A *condition* is a change that is applied to the query images.

    - ``figures``: metrics without geometric verification, as returned by
      `vslam_lab.precision_recall.summary`.
    - ``accuracy``: balanced accuracy for several thresholds on the probability. None for detectors
      that compute no probability.
    - ``accepted``: precision and recall if pairs with a probability of at least 0.9 are accepted.
      None for detectors that compute no probability, and in older files.
    - ``queries``: number of queries whose place is in the gallery.
    - ``first_right``: share of these queries whose most similar image shows the same place.
    - ``sequence_right``: the same share if sequences of images are compared instead of single
      images. None if the images are not in the order of a drive.
    - ``verified``: results by kind of verification. ``orb`` uses ORB descriptors, and ``learned``
      uses learned local descriptors. With ``both``, an image is accepted if at least one of these
      two accepts it. Empty without verification.
    - ``top_average_precision``: average precision over the K most similar images of each query, for
      K = 1, 2, ... `vslam_lab.precision_recall.top_k_precision_recall` defines precision
      and recall. Empty in older files.
    - ``top_curve``: precision-recall curve for the largest of these K. None in older files.
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
    top_average_precision: tuple[float, ...] = ()
    top_curve: Curve | None = None


class DecisionCurve(Record):
    """A precision-recall curve over the images of a drive, at selected thresholds.

    The thresholds are in ascending order.
    """

    threshold: list[float]
    precision: list[float]
    recall: list[float]


class OnlineScore(Record):
    """The metrics of one loop detector on one drive.

    The detector makes one decision for each image of the drive: it selects the most similar earlier
    image (the match), or none. `vslam_lab.loopbench.online` defines the metrics.

    - ``window``: length of the window before an image. The images in this window cannot be its
      match.
    - ``verified_by``: how matches are verified. ``nothing`` accepts every match. ``orb`` uses ORB
      descriptors, and ``learned`` uses learned local descriptors. With ``both``, a match is
      accepted if at least one of these two accepts it.
    - ``answerable``: number of images for which an image before the window shows the same place.
    - ``right``: number of matches that show the same place as the image, according to the ground
      truth. For this number and for the next two, all verified matches are counted, whatever their
      score is.
    - ``near``: number of matches that were taken near the image, but that the ground truth does not
      mark as the same place.
    - ``far``: number of matches that show another place.
    - Metrics whose names end in ``_far`` leave out the near matches. The other metrics count near
      matches as wrong.
    - ``max_f1_threshold``: threshold on the score at which the F1 score is largest. None if no
      image has a match.
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

    The 95 % confidence interval is computed by a bootstrap over the queries.
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

    - ``image_ms``: CPU time per image in milliseconds, without the extraction of ORB features,
      which tracking needs in any case.
    - ``query_ms``: CPU time per query in milliseconds. The key is the number of keyframes in the
      map.
    """

    detector: str
    load_s: float
    image_ms: float
    query_ms: dict[str, float]
    parameters: int
    memory_mb: float


class LoopsJson(Document):
    """The results of ``vslam loops bench``, as in ``loops.json``.

    With ``--protocol retrieval``, the results are in ``cells``, ``gains`` and ``costs``. With
    ``--protocol online``, the results are in ``online``.
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
