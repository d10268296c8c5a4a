"""The schema of ``stress.json``.

The file contains no times and does not name the machine, so that equal runs produce byte-identical
files.
"""

from __future__ import annotations

from vslam.report.schema import Document, Record


class Tested(Record):
    """One run of a stress test, at one strength of a perturbation.

    - ``verdict``: why the run failed; empty if it did not fail.
    - ``absolute``: why the run exceeded the absolute limits, which do not depend on the run on
      unperturbed images; empty if it did not exceed them.
    """

    strength: float
    verdict: str
    absolute: str = ""
    lost_percent: float | None = None
    ate_rmse_m: float | None = None
    causal_ate_rmse_m: float | None = None
    loops_closed: int | None = None


class BoundaryEntry(Record):
    """The result of one search: the strength of a perturbation at which a system fails.

    `vslam_lab.stress.search.Boundary` describes the attributes.
    """

    dataset: str
    sequence: str
    law: str
    unit: str
    system: str
    seed: int
    holds_to: float | None
    fails_at: float | None
    reason: str
    also_failed: tuple[float, ...]
    tested: list[Tested]


class CleanEntry(Record):
    """The run of a system on unperturbed images.

    ``ate_limit_m`` is the ATE above which the runs of this system on perturbed images fail.
    """

    dataset: str
    sequence: str
    system: str
    frames: int
    lost_frames: int
    ate_rmse_m: float | None
    causal_ate_rmse_m: float | None
    ate_limit_m: float | None
    loops_found: int | None


class CorruptionEntry(Record):
    """The errors under one corruption of a preset such as ``kitti-c``, by system.

    A value is None if vslam cannot apply the corruption, or if a run has no ATE.

    - ``ate_sum_m``: sum of the ATE over the severities. The ATE of a severity is the median over
      the seeds.
    - ``error_percent``: ``ate_sum_m`` in percent of the ``ate_sum_m`` of the baseline.
    - ``lost_percent``: mean percentage of lost frames.
    """

    sequence: str
    corruption: str
    specs: tuple[str, ...]
    note: str
    ate_sum_m: dict[str, float | None]
    error_percent: dict[str, float | None]
    lost_percent: dict[str, float | None]


class StressJson(Document):
    """The results of a stress test, as in ``stress.json``."""

    kind: str = "stress"
    schema_version: int = 1
    criterion: str
    steps: int
    max_frames: int | None
    notes: list[str]
    clean: list[CleanEntry]
    boundaries: list[BoundaryEntry]
    preset: str | None = None
    baseline: str | None = None
    corruptions: tuple[CorruptionEntry, ...] = ()
