"""The schema of ``loops.json``: what scripts may rely on."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import BaseModel, ConfigDict


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Curve(_Model):
    """Precision and recall from the lowest threshold on, thinned out."""

    precision: list[float]
    recall: list[float]


class Verified(_Model):
    """``right``: share of the queries that have a place in the gallery whose best image shows it
    and passes verification; ``wrong``: queries whose best image shows another place and passes."""

    right: float
    wrong: int


class Score(_Model):
    """One detector on one set of images under one condition.

    ``figures`` are those of :func:`vslam.loopclosure.precision_recall.summary`, of descriptors
    alone; ``accuracy`` is balanced, at thresholds on p, None for detectors without.
    ``first_right``: share of the ``queries`` that have a place in the gallery whose best image
    shows it. ``verified``: by ``orb``, by ``learned`` local descriptors, by ``both``, one of the
    two; empty where only descriptors are measured.
    """

    data: str
    condition: str
    detector: str
    figures: dict[str, float]
    accuracy: dict[str, float | None]
    queries: int
    first_right: float
    verified: dict[str, Verified]
    curve: Curve


class Gain(_Model):
    """AP of ``second`` minus that of ``first``, with the 95 % interval over the queries."""

    data: str
    condition: str
    first: str
    second: str
    difference: float
    low: float
    high: float


class Cost(_Model):
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


class LoopsJson(_Model):
    """``kind`` tells this file from those of runs."""

    kind: Literal["loops"] = "loops"
    schema_version: int = 2

    seed: int
    cells: list[Score]
    gains: list[Gain]
    costs: list[Cost]

    machine: str
    versions: dict[str, str]
    created: datetime
