"""The schema of ``report.json``: what scripts may rely on.

``Record`` and ``Document`` are the base of all files of results.
"""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from vslam.errors import InputError


class Record(BaseModel):
    """A part of a document; a field that is not known is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Document(Record):
    """A JSON file of results. A subclass sets ``schema_version`` to the version that it reads."""

    schema_version: int

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file that ``to_json`` wrote.

        Raises:
            InputError: the file is missing, damaged or of another version.
        """
        known = cls.model_fields["schema_version"].default
        try:
            content = json.loads(path.read_bytes())
            found = content["schema_version"]
            if found == known:
                return cls.model_validate(content)
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise InputError(f"{path}: missing or damaged; name the folder of a run.") from error
        raise InputError(
            f"{path}: report schema {found}, this version reads {known}; repeat the run with it."
        )

    def to_json(self) -> str:
        """The text of the file."""
        return self.model_dump_json(indent=2) + "\n"


class StageTime(Record):
    """Milliseconds of one stage over the frames that went through it."""

    mean: float
    median: float
    p95: float
    p99: float = 0.0


class LoopEntry(Record):
    """One loop candidate, accepted or not, in frames of this run.

    ``query_frame`` is None for a frame that was not in the map, ``match_frame`` for one of an
    earlier drive. ``right`` says whether the relative pose agrees with the ground truth, None where
    that is unknown. ``moved_m`` is the largest distance that the correction moved a keyframe,
    ``correction_s`` the time it took; None if rejected. ``matched_by`` names the descriptors that
    the relative pose comes from, ``orb`` or ``learned``, ``proposed_by`` the detector that found
    the candidate, or several joined by ``+``.
    """

    query_frame: int | None
    match_frame: int | None
    score: float
    matches: int
    inliers: int
    matched_by: Literal["orb", "learned"] = "orb"
    proposed_by: str = ""
    accepted: bool
    right: bool | None
    reason: str
    moved_m: float | None
    correction_s: float | None


class RevisitEntry(Record):
    """Frames where the camera drives along an earlier stretch, according to the ground truth.

    ``loop_frame`` is the first frame with a right loop that was closed on it, None if missed.
    """

    first_frame: int
    last_frame: int
    first_match_frame: int
    last_match_frame: int
    length_m: float
    loop_frame: int | None


class Measures(Record):
    """What is measured of a run, and of each detector that is compared with it.

    Errors are None without ground truth, and KITTI's drift also on paths shorter than 100 m.
    ``causal_ate_rmse_m`` is of the poses as they were given at the time
    (``trajectory_causal.tum``), after their own alignment. ``loops_closed`` counts candidates,
    ``loops_wrong`` those of them that are wrong; ``loops_found`` and ``loops_missed`` count
    stretches where the camera revisits a place. The last three are None without ground truth.
    ``interrupted`` says why the run ended early.
    """

    lost_frames: int
    interrupted: str | None
    ate_rmse_m: float | None
    causal_ate_rmse_m: float | None = None
    rpe_m: float | None
    rpe_deg: float | None
    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    loops_closed: int
    loops_found: int | None
    loops_missed: int | None
    loops_wrong: int | None


class DetectorFigures(Measures):
    """One of the detectors that were compared on the same frames.

    ``seconds`` is the wall time of the detector's own steps: tracking, waiting for its mapping, and
    completing the map at the end. It excludes reading images and extracting features, which all
    detectors share.
    """

    detector: str
    seconds: float


class MapFigures(Record):
    """How a run was localised in the map that it continued.

    ``in_map_percent`` of the frames are placed in the map at the end; these include
    ``weak_percent``, which have few inliers (WEAK). ``first_fix_s`` is the time from the first
    frame to the first one that was found in the map, None if none was. The whole map was searched
    at ``sought`` frames, successfully at ``found`` of them. ``error_m`` is the RMSE of the
    positions of the frames in the map after the alignment of the drives that made the map, so that
    an error in the place of the whole run counts; None where the map does not lie in the world of
    the ground truth.
    """

    in_map_percent: float
    weak_percent: float = 0.0
    first_fix_s: float | None
    sought: int
    found: int
    error_m: float | None


class GpsFigures(Record):
    """The drive on the Earth, also written as ``gps.json``.

    ``datum`` is the origin of the local east-north-up frame: latitude and longitude in degrees and
    altitude in metres, those of the first fix. ``fixes`` counts those of tracked frames,
    ``refused`` those of them that failed the chi-square test. ``residual_m`` is the root mean
    square distance of the others from the trajectory, ``metres_per_unit`` the mean scale of the
    map. ``ate_rmse_m`` is the error of ``trajectory_enu.tum`` after its SE3 alignment, None without
    ground truth. ``level`` is False where the drive is straight, so that the rotation about it is
    unknown.
    """

    datum: tuple[float, float, float]
    fixes: int
    refused: int
    residual_m: float
    metres_per_unit: float
    ate_rmse_m: float | None
    level: bool


class Machine(Record):
    """Where the times were measured; ``cores`` counts those that the process may use."""

    cpu: str
    cores: int
    python: str
    platform: str


class ReportJson(Measures, Document):
    """One run in numbers.

    ``thresholds`` are those that differ from the defaults, by dotted name.
    ``evaluation_remark`` says why there are no errors, or of how many frames they are.
    ``warnings`` are sentences about faults of the rig that the run has shown.
    ``detectors`` has a row for each detector, the run's own first, where others were run beside it
    (``--compare``): speed, CPU time and memory are then those of all together. It is empty in a run
    that was resumed, since the maps of the others are not saved.
    ``lost_before_map`` counts those of the lost frames that came before the first tracked one, in a
    run that began a new map.
    ``longest_loss_s`` is the longest time from a lost frame to the next tracked one, or to the end.
    ``frames`` counts the frames that were processed; of them ``skipped_frames`` had an unreadable
    image and ``dropped_frames`` were overtaken by a newer one in a real-time run, whose
    ``latency_ms`` is from the time of an image to its pose (None in any other run).
    ``loops_rejected`` counts candidates; ``loops_found`` and ``loops_missed`` add up to
    ``revisit_stretches``. See :mod:`vslam.evaluation.loops`.
    """

    schema_version: int = 5

    lost_before_map: int = 0
    longest_loss_s: float | None = None
    weak_frames: int
    skipped_frames: int
    skipped_messages: list[str]
    dropped_frames: int = 0
    frames: int
    warnings: tuple[str, ...] = ()

    alignment: Annotated[str, StringConstraints(pattern="^(se3|sim3|none)$")] | None
    ate_mean_m: float | None = None
    ate_max_m: float | None = None
    evo_command: str | None
    evaluation_remark: str | None = None

    fps: float
    cpu_ms_per_frame: float
    startup_s: float
    peak_memory_mb: float
    stage_ms: dict[str, StageTime]
    latency_ms: StageTime | None = None

    keyframes: int
    landmarks: int
    submaps: int
    loops_rejected: int
    revisit_stretches: int | None
    revisits: list[RevisitEntry]
    loops: list[LoopEntry]
    detectors: tuple[DetectorFigures, ...] = ()
    in_map: MapFigures | None = None
    gps_track: GpsFigures | None = None

    dataset: str
    sequence: str
    perturb: str
    detector: str
    sensor: str
    seed: int
    threads: int
    start: int
    every: int
    max_frames: int | None
    weights: Path | None = None
    local_weights: Path | None = None
    realtime: bool = False
    calib: tuple[Path, ...] = ()
    mask: Path | None = None
    gps: Path | None = None
    map: Path | None = None
    localize: bool = False
    compare: tuple[str, ...] = ()
    thresholds: dict[str, Any] = Field(default_factory=dict)

    machine: Machine
    versions: dict[str, str]
    created: datetime
