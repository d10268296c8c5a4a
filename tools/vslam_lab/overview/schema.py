"""The schema of the ``report.json`` of many runs, on which scripts may rely."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from vslam.report.schema import Document, Record

Measure = tuple[str, str, str, int]
# For each measure: the name in the JSON file, the title, the unit and the number of decimals.
MEASURES: tuple[Measure, ...] = (
    ("lost_frames", "lost frames", "", 0),
    ("ate_rmse_m", "ATE RMSE", "m", 3),
    ("causal_ate_rmse_m", "causal ATE", "m", 3),
    ("rpe_m", "RPE", "m", 4),
    ("rpe_deg", "RPE", "°", 4),
    ("t_rel_percent", "t_rel", "%", 3),
    ("r_rel_deg_per_100m", "r_rel", "°/100 m", 3),
    ("loops_found", "loops found", "", 0),
    ("loops_missed", "missed", "", 0),
    ("loops_wrong", "wrong", "", 0),
    ("fps", "fps", "", 1),
)
DECIMALS = {name: decimals for name, _, _, decimals in MEASURES}
ALL = "all"  # value of ``Comparison.perturb`` for a comparison over all perturbations


class Drive(Record):
    """A sequence with a perturbation, on which systems are compared.

    ``excerpt`` states which part of the sequence is used; empty for the whole sequence.
    """

    dataset: str
    sequence: str
    excerpt: str
    perturb: str

    @property
    def place(self) -> str:
        """The sequence or excerpt, without the perturbation."""
        return f"{self.sequence}, {self.excerpt}" if self.excerpt else self.sequence


class RunEntry(Record):
    """One run of a system on a drive, with its results.

    - ``system``: the name of vslam's loop detector or of another SLAM system. If runs of vslam have
      different settings, these settings follow in brackets.
    - ``settings``: thresholds and options that differ from the defaults, and the version of vslam's
      method.
    - ``seed``: seed of the perturbation; None for other systems.
    - ``town``: seed of a rendered town. Runs on the same route in different towns have the same
      drive.
    - ``alignment``: the transformation that is fitted before errors are computed. It is ``se3``, or
      ``sim3`` for a monocular run, whose scale is arbitrary.
    - ``measures``: results of the run by the names in ``MEASURES``; None if unknown.
    - ``source``: the folder of the run. For another SLAM system, and for a detector that was added
      to a run with ``--compare``, it is the trajectory file instead.
    """

    drive: Drive
    system: str
    settings: dict[str, Any] = Field(default_factory=dict)
    seed: int | None
    town: int | None = None
    alignment: str = "se3"
    frames: int
    measures: dict[str, float | None]
    source: str
    machine: str | None


class Spread(Record):
    """Median, smallest and largest value of a measure over the ``n`` runs whose value is known."""

    n: int
    median: float
    least: float
    greatest: float


class Row(Record):
    """A summary of all runs of one system on one drive.

    A measure is None if its value is unknown for all runs.
    """

    drive: Drive
    system: str
    alignment: str = "se3"
    runs: int
    frames: int
    measures: dict[str, Spread | None]


class Pair(Record):
    """Median errors of two systems on one drive. ``difference`` is the second minus the first."""

    drive: Drive
    first: float
    second: float
    difference: float


class Comparison(Record):
    """A comparison of the errors of two systems under one perturbation, paired by sequence.

    - ``perturb``: the perturbation, or ``all``. With ``all``, the error on a sequence is the mean
      over the perturbations for which there are runs of both systems.
    - ``p_value``: p-value of the two-sided Wilcoxon signed-rank test, without ties. None if there
      are too few differences.
    - ``winner``: the system with significantly smaller errors; None if there is no such system.
    - ``words``: the result in sentences.
    """

    measure: str
    perturb: str
    first: str
    second: str
    pairs: list[Pair]
    second_better: int
    first_better: int
    ties: int
    median_difference: float
    p_value: float | None
    winner: str | None
    words: str


class OverviewJson(Document):
    """The ``report.json`` of many runs.

    ``kind`` distinguishes this file from the ``report.json`` of a single run. ``systems`` begins
    with the baseline.
    """

    kind: Literal["overview"] = "overview"
    schema_version: int = 4

    notes: list[str]
    systems: list[str]
    rows: list[Row]
    comparisons: list[Comparison]
    runs: list[RunEntry]

    versions: dict[str, str]
    created: datetime
