"""The schema of the ``report.json`` of many runs: what scripts may rely on."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from vslam.report.schema import Document, Record

Measure = tuple[str, str, str, int]
# Name in the JSON, title, unit, decimals.
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
ALL = "all"  # in the place of a perturbation: over all of them


class Drive(Record):
    """Images on which systems are compared; drives that differ only in a seed are one.

    ``excerpt`` is empty for a whole sequence.
    """

    dataset: str
    sequence: str
    excerpt: str
    perturb: str

    @property
    def place(self) -> str:
        """The sequence without its perturbation."""
        return f"{self.sequence}, {self.excerpt}" if self.excerpt else self.sequence


class RunEntry(Record):
    """One run. ``measures`` has the names of ``MEASURES``; None where a run has no such value.

    ``settings`` are the thresholds and options that differ from the defaults. ``system`` is the
    loop detector, followed in brackets by the settings that not all runs share, or the name of
    another system; ``source`` the folder of the run, or the file of the trajectory of another
    system or of a detector that ran beside another (``--compare``); ``seed`` is None
    for other systems. ``town`` is the seed of a rendered town: the same route in another town
    counts as the same drive with another seed. ``alignment`` is what was fitted before errors were
    computed: ``se3``, or ``sim3`` for a monocular run, whose scale is arbitrary.
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
    """Median and extremes over the ``n`` runs that have a value."""

    n: int
    median: float
    least: float
    greatest: float


class Row(Record):
    """All runs of one system on one drive, which share an ``alignment``; None for a measure that no
    run has."""

    drive: Drive
    system: str
    alignment: str = "se3"
    runs: int
    frames: int
    measures: dict[str, Spread | None]


class Pair(Record):
    """Medians of two systems on one drive, and ``difference``, the second minus the first."""

    drive: Drive
    first: float
    second: float
    difference: float


class Comparison(Record):
    """Two systems under one perturbation, paired by sequence.

    ``perturb`` is ``all`` for a comparison over all perturbations: a sequence then counts once,
    with its mean over the perturbations under which both systems have run on it. ``p_value`` is
    two-sided, of Wilcoxon's signed-rank test on the differences that are not ties; None where there
    are too few of them for the test. ``winner`` is the system with the smaller errors by that test,
    None where the test does not decide.
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
    """``kind`` distinguishes this file from the ``report.json`` of one run. ``systems`` are in the
    order in which they are compared, the baseline first."""

    kind: Literal["overview"] = "overview"
    schema_version: int = 4

    notes: list[str]
    systems: list[str]
    rows: list[Row]
    comparisons: list[Comparison]
    runs: list[RunEntry]

    versions: dict[str, str]
    created: datetime
