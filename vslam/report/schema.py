"""The schema of ``report.json``, which scripts may rely on.

``Record`` and ``Document`` are the base classes of all result files.
"""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from vslam.method.gaps import GapKind
from vslam.support.errors import InputError, counted


class Record(BaseModel):
    """A part of a JSON document of results. Unknown fields are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Document(Record):
    """A JSON document of results. A subclass sets ``schema_version`` to the version that it
    reads."""

    schema_version: int

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a document from a JSON file.

        Raises:
            InputError: the file is missing or damaged, or has another schema version.
        """
        known = cls.model_fields["schema_version"].default
        try:
            content = json.loads(path.read_bytes())
            found = content["schema_version"]
            if found == known:
                return cls.model_validate(content)
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            raise InputError(f"{path}: missing or damaged; give the folder of a run.") from error
        raise InputError(
            f"{path}: report schema {found}, but this version of vslam reads {known}; repeat the "
            "run with this version."
        )

    def to_json(self) -> str:
        """Return the document as JSON text."""
        return self.model_dump_json(indent=2) + "\n"


class StageTime(Record):
    """Time that one stage takes per frame, in milliseconds. Only frames that went through the stage
    are included."""

    mean: float
    median: float
    p95: float
    p99: float = 0.0


class LoopEntry(Record):
    """A loop candidate that was accepted or rejected. Frames are numbered as in this run.

    - ``query_frame``: index of the frame for which the detector searched for loops. None if this
      frame did not become a keyframe.
    - ``match_frame``: index of the earlier frame that shows the same place. None if it belongs to
      an earlier drive.
    - ``right``: whether the relative pose agrees with the ground truth. None if this is unknown.
    - ``moved_m``: the largest distance by which the correction moved a keyframe, in metres. In a
      monocular map, it is in map units. None for rejected candidates.
    - ``correction_s``: the duration of the correction in seconds. None for rejected candidates.
    - ``matched_by``: the descriptors from which the relative pose was computed.
    - ``proposed_by``: the names of the detectors that found the candidate, joined by ``+``.
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
    """A range of frames in which, according to the ground truth, the camera travels along an
    earlier part of its path again.

    ``loop_frame`` is the first frame of the range in which a correct loop was closed, or None if
    there is no such frame.
    """

    first_frame: int
    last_frame: int
    first_match_frame: int
    last_match_frame: int
    length_m: float
    loop_frame: int | None


class Measures(Record):
    """The results of a run, or of another detector on the frames of the run (``--compare``).

    All errors are None if there is no ground truth. KITTI's drift is also None if the path is
    shorter than 100 m. ``causal_ate_rmse_m`` is the ATE of the poses at the time of tracking
    (``trajectory_causal.tum``). These poses are aligned with the ground truth separately.

    ``loops_closed`` is the number of accepted candidates. ``loops_wrong`` is the number of wrong
    loops among them. ``loops_found`` is the number of revisited stretches with a correct loop, and
    ``loops_missed`` is the number of revisited stretches without a correct loop. Without ground
    truth, ``loops_wrong``, ``loops_found`` and ``loops_missed`` are None.

    ``inertial_frames`` is the number of frames that the IMU alone carried. ``metric_since_s`` is
    the time from the first frame until an IMU made a monocular map metric. It is None for other
    maps.

    ``interrupted`` is the reason why the run ended early, or None if it did not end early.
    """

    lost_frames: int
    inertial_frames: int = 0
    metric_since_s: float | None = None
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
    """The results of one detector, in a run that compares detectors on the same frames.

    ``seconds`` is the wall time that this detector alone took. It includes tracking, waiting for
    mapping, and completing the map at the end. It excludes reading images and extracting features,
    which is done only once for all detectors.
    """

    detector: str
    seconds: float


class GapEntry(Record):
    """A stretch of frames whose final poses relative to the world frame were not measured.

    The fields are those of ``vslam.method.gaps.Gap``.
    """

    kind: GapKind
    first: int
    last: int
    seconds: float
    sigma_m: float | None
    sigma_deg: float | None
    scale: float


class MapFigures(Record):
    """The results of localisation in the map that a run continued.

    - ``in_map_percent``: percentage of frames whose final pose is in the map.
    - ``weak_percent``: percentage of frames that were tracked in the map, but with few inliers
      (tracking state WEAK).
    - ``first_fix_s``: seconds from the first frame to the first frame that was localised in the
      map. None if no frame was localised.
    - ``sought``: number of frames for which vslam searched the whole map for the pose.
    - ``found``: number of these searches that found a pose.
    - ``error_m``: RMSE of the positions in the map, in metres, after the alignment of the map with
      the ground truth. The run itself is not aligned, so a constant offset of all positions counts
      as an error. None if the map was not aligned with a ground truth.
    """

    in_map_percent: float
    weak_percent: float = 0.0
    first_fix_s: float | None
    sought: int
    found: int
    error_m: float | None


class GpsFigures(Record):
    """Results of georeferencing a trajectory with GPS. They are also written to ``gps.json``.

    - ``datum``: origin of the local east-north-up frame, as latitude and longitude in degrees and
      altitude in metres. The origin is the first GPS fix.
    - ``antenna``: position of the antenna in the frame of the left camera (x right, y down, z
      forward), in metres.
    - ``fixes``: number of GPS fixes that were measured between tracked frames.
    - ``refused``: number of these fixes that failed the chi-square test.
    - ``residual_m``: root mean square distance of the other fixes from the trajectory, in metres.
    - ``metres_per_unit``: mean length of a map unit, in metres.
    - ``ate_rmse_m``: ATE of ``trajectory_enu.tum`` after SE3 alignment. None without ground truth.
    - ``level``: False if the drive is so straight that GPS does not determine the rotation about
      its direction.
    """

    datum: tuple[float, float, float]
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fixes: int
    refused: int
    residual_m: float
    metres_per_unit: float
    ate_rmse_m: float | None
    level: bool


class ImuFigures(Record):
    """What a run learnt from an IMU. Frames that it carried are counted in ``inertial_frames``.

    - ``refused``: why the IMU was not used, or no longer, as a sentence. Empty if it was used.
    - ``gravity_since_s``: time from the first frame until gravity was known. None if it never was.
    - ``gravity_sigma_deg``: standard deviation of its direction at the last keyframe, along each
      axis.
    - ``gyro_bias``, ``accel_bias``: the biases at the end in rad/s and m/s^2, in the frame of the
      IMU. None if they are unknown.
    - ``gyro_bias_sigma``, ``accel_bias_sigma``: their standard deviations.
    - ``time_offset_s``: offset of the clocks according to the calibration.
    - ``carried_s``, ``longest_s``: seconds for which the IMU alone carried the camera, in total and
      at a stretch.
    - ``carried_error_m``, ``carried_error_deg``: the largest errors of carried poses, since the
      camera was last tracked. None without ground truth, or if no frame was carried.
    - ``carried_nees``: mean of the normalised estimation errors squared of these poses, divided by
      their degrees of freedom. It is 1 if the covariances are right.
    """

    refused: str = ""
    gravity_since_s: float | None = None
    gravity_sigma_deg: float | None = None
    gyro_bias: tuple[float, float, float] | None = None
    gyro_bias_sigma: tuple[float, float, float] | None = None
    accel_bias: tuple[float, float, float] | None = None
    accel_bias_sigma: tuple[float, float, float] | None = None
    time_offset_s: float = 0.0
    carried_s: float = 0.0
    longest_s: float = 0.0
    carried_error_m: float | None = None
    carried_error_deg: float | None = None
    carried_nees: float | None = None


class Machine(Record):
    """The machine of the run. ``cores`` is the number of cores that the process may use."""

    cpu: str
    cores: int
    python: str
    platform: str

    def __str__(self) -> str:
        return f"{self.cpu}, {counted(self.cores, 'core')}"


class ReportJson(Measures, Document):
    """The content of ``report.json``, which describes one run in numbers.

    - ``frames``: number of processed frames.
    - ``skipped_frames``: number of frames with an image that could not be read.
    - ``left_out_frames``: number of images that the reader left out, because they have no partner
      or because their times are repeated or out of order. They are no frames of the run.
    - ``dropped_frames``: number of frames that were replaced by a newer frame in a real-time run.
    - ``lost_before_map``: number of lost frames before the first tracked frame. Only a run that
      begins a new map counts these frames.
    - ``later_frames``: number of frames that were lost, and whose poses were found when a monocular
      map began afterwards. They are no lost frames.
    - ``longest_loss_s``: longest time in seconds from a lost frame to the next tracked frame, or to
      the end.
    - ``warnings``: sentences about problems of the images or the rig that the run has detected,
      and about ``gaps``.
    - ``gaps``: stretches of frames whose final poses relative to the world frame were not measured.
    - ``gravity``: acceleration of free fall in the world frame of the trajectory and the map, in
      m/s^2. None if no IMU has measured it.
    - ``evaluation_remark``: the reason why no errors were computed, or the number of frames that
      the errors cover.
    - ``latency_ms``: milliseconds from an image to its pose in a real-time run. None for other
      runs.
    - ``loops_rejected``: number of rejected candidates.
    - ``revisit_stretches``: sum of ``loops_found`` and ``loops_missed``.
    - ``detectors``: the results of all detectors of a run with ``--compare``. The run's own
      detector comes first. The speed, CPU time and memory of such a run cover all detectors
      together. The list is empty in a resumed run, because the maps of the other detectors are not
      saved.
    - ``thresholds``: the thresholds that differ from the defaults, by dotted name.
    """

    schema_version: int = 5

    lost_before_map: int = 0
    longest_loss_s: float | None = None
    later_frames: int = 0
    weak_frames: int
    skipped_frames: int
    skipped_messages: list[str]
    left_out_frames: int = 0
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
    gaps: tuple[GapEntry, ...] = ()
    gravity: tuple[float, float, float] | None = None
    loops_rejected: int
    revisit_stretches: int | None
    revisits: list[RevisitEntry]
    loops: list[LoopEntry]
    detectors: tuple[DetectorFigures, ...] = ()
    in_map: MapFigures | None = None
    gps_track: GpsFigures | None = None
    imu: ImuFigures | None = None

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
