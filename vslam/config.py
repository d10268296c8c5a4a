"""All thresholds of the pipeline, with one class for each stage.

docs/reference/thresholds.md is generated from these classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vslam.support.errors import InputError, did_you_mean, plain_reason

_Model = TypeVar("_Model", bound=BaseModel)


class Section(BaseModel):
    """A frozen group of thresholds. The docstring below each field describes the field.

    ``tools/threshold_table.py`` reads these docstrings from the source. Pydantic could do so itself
    (``use_attribute_docstrings``), but that would take 0.1 s at the start of every run.

    Each docstring ends with the source of the threshold in brackets. [own] means that both the rule
    and the value are our own. Otherwise, the brackets name the paper and section that give the
    rule, and then the source of the value. *Printed* values are printed in that section of the
    paper. *Customary* values are those of the programs of the ORB-SLAM family. *Own* values were
    chosen for vslam.

    OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017. ZS:
    Zhou and Sun, Sci Rep 15, 7644 (2025).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")


class OrbConfig(Section):
    """ORB extraction."""

    n_features: int = Field(2000, ge=100)
    """Number of features to extract from each image. More features make tracking more robust, but
    slower. [OS1 V-A, printed]"""
    n_levels: int = Field(8, ge=2, le=16)
    """Number of levels of the image pyramid. With more levels, a landmark can be matched over a
    larger range of distances. [OS1 V-A, printed]"""
    scale_factor: float = Field(1.2, gt=1.0, le=2.0)
    """Scale factor from one pyramid level to the next. [OS1 V-A, printed]"""
    fast_threshold: int = Field(12, ge=1, le=255)
    """FAST threshold, in grey levels. A larger threshold finds fewer, stronger corners.
    [OS1 V-A, customary]"""
    fast_threshold_min: int = Field(7, ge=1, le=255)
    """FAST threshold in cells where `fast_threshold` finds no corner, in grey levels.
    [OS1 V-A, customary]"""


class WeakImageConfig(Section):
    """Images with much noise or little contrast (docs/research/stress.md)."""

    noise_from: float = Field(5.0, ge=0)
    """An image is blurred if the standard deviation of its noise is at least this value, in grey
    levels. Images without added noise have at most 2.5. [own]"""
    spikes_from: float = Field(0.04, ge=0, le=1)
    """A median filter is applied if more than this fraction of the pixels are spikes. A spike is a
    pixel that is much brighter or much darker than both of its neighbours. [own]"""
    few_features: float = Field(0.5, ge=0, le=1)
    """Contrast is measured only in images that yield fewer features than this fraction of
    `orb.n_features`. [own]"""
    low_contrast: float = Field(6.0, ge=0)
    """The contrast of an image is raised if it is below this value, in grey levels. With 0, the
    contrast is never raised. To measure the contrast, the image is divided into blocks of 16 x 16
    pixels, and the standard deviation of the grey values is computed for each block. The contrast
    is the median of these standard deviations. [own]"""


class StereoConfig(Section):
    """Stereo matching [OS2, III-A]."""

    clipped_from: int = Field(250, ge=1, le=255)
    """A pixel counts as overexposed if its grey level is at least this value. Overexposed pixels
    are ignored when the gain is measured. Video of limited range (16 to 235) needs about 230.
    [own]"""
    black_below: float = Field(6.0, gt=0, le=255)
    """An image of a stereo pair counts as black if the 95 % quantile of its pixels is below this
    value, in grey levels, and the other image has contrast. A black image is not used. Video of
    limited range (16 to 235) needs about 22. [own]"""
    close_depth_baselines: float = Field(40.0, gt=0)
    """A stereo point is close if its depth is below this value, in baselines. Close points are
    mapped from a single stereo pair. Most far points are triangulated from several keyframes. [OS2
    III-A, printed]"""
    offset_sigma: float = Field(0.2, ge=0)
    """Prior standard deviation of an offset that all disparities have in common, in pixels. The
    offset is estimated from the motion of the camera (docs/research/motorway.md). A larger value
    corrects disparities more. With 0, no offset is estimated. [own]"""


class DepthConfig(Section):
    """Depth images [OS2, III-A]."""

    min_metres: float = Field(0.1, gt=0)
    """A measured depth below this value, in metres, counts as unknown. [own]"""
    max_metres: float = Field(100.0, gt=0)
    """A measured depth above this value, in metres, counts as unknown. [own]"""
    edge_radius: float = Field(4.0, ge=0)
    """A keypoint gets a depth only if the depths within this radius agree, in pixels at octave 0.
    The default is one pixel more than the radius of FAST's circle. [own]"""
    edge_ratio: float = Field(0.07, gt=0)
    """A keypoint lies on a depth edge if the depths around it differ by more than this fraction of
    the nearest depth. Such a keypoint gets no depth. [own]"""


class AlignmentConfig(Section):
    """Alignment of matches to sub-pixel accuracy (Forster et al., ICRA 2014, III-B)."""

    min_correlation: float = Field(0.85, gt=0, le=1)
    """A match is aligned only if the normalised cross-correlation of its patch with the image is at
    least this value. [own]"""
    certainty: int = Field(4, ge=1, le=255)
    """Ratio of the variance of a keypoint's position to the variance of an aligned match. A larger
    ratio gives aligned matches more weight. [own]"""
    keyframes: int = Field(5, ge=1)
    """Patches are kept for this many of the newest keyframes. Except at a known place, landmarks
    that only older keyframes observe are not aligned. [own]"""


class TrackingConfig(Section):
    """Frame-to-map tracking."""

    method: Literal["auto", "orb", "patches"] = "auto"
    """How frames are tracked. `orb` matches ORB features in every frame. `patches` looks for image
    patches of the landmarks (Forster et al., T-RO 2017), and extracts features only when a keyframe
    is due or when too few patches are found. `auto` selects `patches` for stereo cameras and `orb`
    for the other cameras. RGB-D cameras are never tracked by patches. [own]"""
    patch_min_inliers: int = Field(40, ge=10)
    """Features are extracted for a frame if fewer patches than this agree with its pose. [own]"""
    patch_min_inlier_ratio: float = Field(0.8, ge=0, le=1)
    """Features are extracted for a frame if less than this fraction of its patches agree with its
    pose. This fraction falls below 0.8 among moving vehicles, but not in static scenes. [own]"""
    patch_retry_ratio: float = Field(0.86, ge=0, le=1)
    """If less than this fraction of the patches agree with the pose of a frame, the patches are
    searched for a second time. The first search begins at a pose that sparse image alignment has
    refined, and this alignment may have followed moving objects. The second search begins at the
    predicted pose. The result with more inliers is used. [own]"""
    motion_window: float = Field(7.0, gt=0)
    """Search radius when the points of the previous frame are matched, in pixels at octave 0.
    [OS1 V-B, customary]"""
    local_window: float = Field(2.5, gt=0)
    """Search radius when the local map is matched, in pixels at octave 0. [OS1 V-D, customary]"""
    sudden_min_inlier_ratio: float = Field(0.4, ge=0, le=1)
    """At least this fraction of the matches in `sudden_window` must be inliers, so that the camera
    is not tracked against a moving object. [own]"""
    local_keyframes: int = Field(80, ge=1)
    """Upper bound of the number of keyframes in the local map. The keyframes that share the most
    landmarks with the reference keyframe are chosen. [OS1 V-D, customary]"""
    min_stereo_start: int = Field(100, ge=10)
    """Number of stereo features that a frame needs to start a map. [OS2 III-B, own]"""
    min_inlier_ratio: float = Field(0.3, ge=0, le=1)
    """A frame is also tracked from the reference keyframe if less than this fraction of the matches
    with the previous frame are inliers. [own]"""
    min_inliers: int = Field(30, ge=3)
    """A frame with fewer inliers than this in the local map is WEAK. Its pose is used, but it is
    reported as uncertain. [OS1 V-D, customary]"""
    lost_frames_before_restart: int = Field(3, ge=1)
    """A stereo or RGB-D camera starts a sub-map at the predicted pose after this many lost frames.
    [own]"""
    young_keyframes: int = Field(5, ge=0)
    """A map with at most this many keyframes is young. In a young map, a stereo or RGB-D camera
    starts a sub-map after a single lost frame. [own]"""
    monocular_lost_frames: int = Field(4, ge=1)
    """A monocular camera starts a sub-map from two new views after this many lost frames. [own]"""


class InitializationConfig(Section):
    """The first two keyframes of a monocular map [OS1, IV]."""

    min_features: int = Field(200, ge=20)
    """A frame can become the first view if it has at least this many features. [own]"""
    min_matches: int = Field(100, ge=8)
    """If the two views have fewer matches than this, the second view replaces the first.
    [OS1 IV, customary]"""
    min_parallax_deg: float = Field(1.0, gt=0)
    """At least `min_points` points must have this parallax, in degrees. With a larger value, the
    map starts only after a longer motion of the camera. [OS1 IV, customary]"""
    min_landmarks: int = Field(100, ge=8)
    """At least this many landmarks must remain after the first bundle adjustment.
    [OS1 IV, customary]"""
    median_depth: float = Field(15.0, gt=0)
    """The first landmarks are scaled to this median depth, in map units. [own]"""
    max_seconds: float = Field(1.5, gt=0)
    """Longest time between the two views, in seconds. After this time, the next frame replaces the
    first view. [own]"""


class KeyframeConfig(Section):
    """Keyframe decision [OS2, III-E]."""

    max_interval_s: float = Field(1.0, gt=0)
    """A keyframe is inserted if the last keyframe is at least this old, in seconds. [OS1 V-E,
    customary]"""
    depth_max_interval_s: float = Field(0.3, gt=0)
    """Replaces `max_interval_s` for an RGB-D camera, in seconds. It is shorter, because such a
    camera is usually hand-held. [own]"""
    min_tracked_close: int = Field(100, ge=0)
    """A keyframe is inserted if the frame tracks fewer close points than this, and could add more
    than `min_new_close` new close points. [OS2 III-E, printed]"""
    min_new_close: int = Field(70, ge=0)
    """If a frame tracks too few close points, it becomes a keyframe only if it could add more new
    close points than this. [OS2 III-E, printed]"""
    patch_kept_close: float = Field(0.4, ge=0, le=1)
    """A frame that was tracked by patches becomes a keyframe if it tracks less than this fraction
    of the close points that the first frame after the last keyframe tracked. [own]"""
    max_tracked_ratio: float = Field(0.75, gt=0, le=1)
    """A keyframe is inserted if the frame tracks less than this fraction of the landmarks of the
    reference keyframe. A larger fraction inserts keyframes more often. [OS1 V-E, customary]"""
    monocular_ratio: float = Field(0.9, gt=0, le=1)
    """Replaces `max_tracked_ratio` for a monocular camera. [OS1 V-E, printed]"""
    known_after_s: float = Field(30.0, gt=0)
    """A keyframe is old after this time, in seconds. If the camera returns to a known place, an old
    keyframe becomes the reference again, and no new keyframe is inserted. [own]"""
    known_ratio: float = Field(0.5, gt=0)
    """A place is known if the frame tracks at least this fraction of the landmarks of an old
    keyframe. With a larger fraction, more new keyframes are inserted at old places. [own]"""
    known_min_inliers: int = Field(50, ge=0)
    """A place is known only if the frame tracks at least this many landmarks. [own]"""
    publish_after_frames: int = Field(2, ge=1)
    """Tracking uses the result of local mapping this many frames after the keyframe. If the next
    keyframe comes earlier, tracking uses the result there. With a smaller value, tracking waits for
    mapping more often. [own]"""


class MappingConfig(Section):
    """Local mapping and bundle adjustment."""

    neighbours: int = Field(10, ge=1)
    """New landmarks are triangulated between a new keyframe and this many covisible keyframes.
    [OS1 VI-C, customary]"""
    epipolar_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance when features are matched for triangulation, in bits.
    [OS1 VI-C, customary]"""
    fuse_distance: int = Field(50, ge=0, le=256)
    """Upper bound of the descriptor distance between duplicate landmarks, in bits.
    [OS1 VI-C, customary]"""
    min_stereo_points: int = Field(100, ge=0)
    """If a keyframe has fewer close stereo features than this, its nearest stereo features are
    mapped, up to this number. [OS2 III-E, printed]"""
    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe is culled if more than this fraction of its landmarks are redundant. A landmark is
    redundant if at least three other keyframes observe it. With a larger fraction, more keyframes
    are kept. [OS1 VI-E, printed]"""
    max_ba_keyframes: int = Field(60, ge=2)
    """Upper bound of the number of keyframes that local bundle adjustment optimises.
    [OS1 VI-D, own]"""
    ba_iterations: int = Field(10, ge=1)
    """Upper bound of the number of iterations of local bundle adjustment. The first pass, before
    outliers are removed, has half as many. [OS1 VI-D, customary]"""


class VerificationConfig(Section):
    """Geometric verification of loop candidates [OS1, VII-B; OS2, III-C]."""

    descriptors: Literal["auto", "orb", "learned", "both"] = "auto"
    """The descriptors with which loop candidates are verified. `orb` uses ORB descriptors, and
    `learned` uses the local descriptors of the network. `both` uses the learned descriptors where
    ORB fails. `auto` selects `orb` for the detectors `bow` and `capsule-paper` and for plug-ins,
    and `both` for all other detectors. [own]"""
    min_inliers: int = Field(40, ge=6)
    """At least this many inliers must remain after guided search. [OS1 VII-B, customary]"""
    max_distance: float = Field(15.0, gt=0)
    """Upper bound of the distance between the cameras of query and match, in metres. [own]"""


class LearnedMatchingConfig(Section):
    """Verification of loop candidates using learned local descriptors, where ORB fails."""

    max_candidates: int = Field(2, ge=1)
    """Upper bound of the number of candidates that are tried for a keyframe or a lost frame.
    [own]"""
    max_compared: int = Field(5, ge=0)
    """If the detector has not compared its candidates using local descriptors, this many of the
    best candidates are compared before verification. [own]"""
    most_shared: float = Field(0.4, gt=0, le=1)
    """The image of a keyframe is not kept for the network if the keyframe shares at least this
    fraction of its landmarks with another keyframe whose image is kept. [own]"""
    min_similarity: float = Field(0.35, ge=0, le=1)
    """Two images are matched only if their similarity according to local descriptors is at least
    this value. [own]"""
    retry_interval: int = Field(8, ge=0)
    """After a failed attempt, `retry_factor` applies to this many keyframes. [own]"""
    retry_factor: float = Field(1.1, ge=1)
    """During the `retry_interval` keyframes after a failed attempt, a place is tried only if its
    similarity is at least this many times the similarity in the failed attempt. [own]"""
    min_inliers: int = Field(80, ge=6)
    """At least this many inliers must remain after guided search. [own]"""
    verified_memory: int = Field(10, ge=1)
    """With learned verification, `consistency.verified_memory` is raised to this number if it is
    smaller, because only some keyframes have an image with which a loop can be verified. [own]"""


class ConsistencyConfig(Section):
    """Test whether several keyframes agree on a loop [OS1, VII-A]."""

    min_keyframes: int = Field(2, ge=1)
    """At least this many consecutive keyframes must resemble the place. OS1 requires 3.
    [OS1 VII-A, own]"""
    max_gap: int = Field(1, ge=0)
    """Between two keyframes that resemble the place, up to this many keyframes need not resemble
    it. OS1 allows none. [OS1 VII-A, own]"""
    max_wrong: float = Field(3e-3, gt=0, le=0.5)
    """A loop is closed only if the probability that it is wrong is at most this value, according to
    its own evidence and that of a loop that agrees with it. [own]"""
    max_wrong_at_end: float = Field(1e-2, gt=0, le=0.5)
    """At the end of a drive, when no further evidence can come, a loop that waits is closed if this
    probability is at most this value. [own]"""
    verified_memory: int = Field(5, ge=1)
    """A verified loop is remembered for this many keyframes. [own]"""
    min_moved: float = Field(0.15, ge=0)
    """At the end of a drive, an earlier keyframe may confirm a loop only if its distance from the
    query is at least this fraction of the median depth of the matched landmarks. A nearer keyframe
    would only repeat the evidence of the query. [own]"""


class RelocalizationConfig(Section):
    """Relocalisation of a lost camera [OS1, V-C]."""

    min_inliers: int = Field(50, ge=6)
    """A frame is relocalised if it has at least this many inliers. [OS1 V-C, customary]"""
    min_elsewhere: int = Field(15, ge=0)
    """At least this many inliers must lie outside a vertical strip that is a third of the image
    wide. The strip is placed where it contains as many inliers as possible. [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the number of places that are tried for a lost frame. [own]"""
    doubtful_gap: float = Field(1.5, gt=1)
    """A frame counts as coming after a gap if the time since the last tracked frame exceeds the
    usual interval between frames by more than this factor. [own]"""
    doubtful_share: float = Field(0.5, ge=0, le=1)
    """A frame is doubtful if it tracks less than this fraction of the landmarks of the reference
    keyframe, and if there is a second reason for doubt. The second reason is that the frame comes
    after a gap, that its pose could not be predicted, or that it tracks less than this fraction of
    the number of landmarks in the previous frame. For a doubtful frame, vslam searches the whole
    map. [own]"""
    better: float = Field(1.5, ge=1)
    """For a doubtful frame, the pose that the search of the whole map finds is used only if it has
    more than this many times as many inliers as the tracked pose. [own]"""


class LoopConfig(Section):
    """Closing a verified loop, and global bundle adjustment afterwards [OS1, VII]."""

    overwhelming: float = Field(1e-6, ge=0)
    """A loop that contradicts the odometry is closed nevertheless, and odometry is taken to be
    wrong, if the probability that the loop is wrong is at most this value. [own]"""

    global_iterations: int = Field(10, ge=1)
    """Upper bound of the number of iterations of global bundle adjustment.
    [OS2 III-D, customary]"""
    min_revisits: int = Field(5, ge=1)
    """The map is adjusted again when the camera leaves old places and at the end of the drive, if
    at least this many frames have measured old places since the last adjustment. These frames are
    new keyframes that observe an old place, and frames whose reference is an old keyframe. [own]"""
    revisits_share: float = Field(0.1, ge=0)
    """While the camera stays at old places, the map is adjusted again when the number of these
    frames reaches this fraction of the number of keyframes. [own]"""


class BowConfig(Section):
    """Loop candidates from a bag of words [OS1, III-E and VII-A]."""

    exclude_recent: int = Field(20, ge=1)
    """This many of the newest keyframes, including the query, are never candidates. [own]"""
    group_size: int = Field(10, ge=0)
    """A candidate forms a group with at most this many of its most covisible keyframes.
    [OS1 III-E, customary]"""
    max_groups: int = Field(30, ge=1)
    """Upper bound of the number of groups. Groups are formed around the candidates with the highest
    scores. [own]"""


class PoseGraphConfig(Section):
    """The pose graph of a loop closure: weights of the edges, and when a loop is rejected.

    An edge has less weight if its standard deviation is larger. Drift is modelled as a random walk:
    its standard deviation grows with the square root of the distance travelled. With the default
    values, the drift is 1.2 % after 400 m, and nearly all of it is caused by errors of rotation.

    An edge is a gap if tracking was lost between its two keyframes. The motion along a gap is only
    predicted. A gap gets a small weight if no prediction was possible. It also gets a small weight
    under the hypothesis that the camera was carried to another place while tracking was lost.
    """

    min_shared: int = Field(100, ge=1)
    """A covisibility edge belongs to the graph if its two keyframes share at least this many
    landmarks. [OS1 III-D, printed]"""
    translation_drift: float = Field(0.03, gt=0)
    """Standard deviation of the translational drift of odometry, in metres per square root of a
    metre. [own]"""
    rotation_drift: float = Field(0.001, gt=0)
    """Standard deviation of the rotational drift of odometry, in radians per square root of a
    metre. [own]"""
    loop_inflation: float = Field(1.5, gt=0)
    """Factor that multiplies the computed covariance of a verified loop, which does not contain the
    errors of the landmarks (docs/research/uncertainty.md). [own]"""
    robust_scale: float = Field(3.0, gt=0)
    """Scale of the Cauchy loss on loops, in standard deviations. A smaller scale reduces the
    influence of loops that contradict the other edges. [own]"""
    max_loop_error: float = Field(30.0, gt=0)
    """A loop is rejected if its chi-square after optimisation is above this value. [own]"""
    max_strain: float = Field(60.0, gt=0)
    """A loop is rejected if the chi-square of all other edges exceeds this number times the number
    of closed loops. [own]"""


class SiameseConfig(Section):
    """Loop candidates from a Siamese network [ZS]."""

    threshold: float = Field(0.9, ge=0, le=1)
    """A keyframe is a loop candidate if its similarity is at least this value. [ZS, printed]"""
    offered: float = Field(0.1, ge=0, le=1)
    """Replaces `threshold` if learned descriptors verify the candidates. A smaller value proposes
    more candidates. [own]"""
    max_candidates: int = Field(5, ge=1)
    """Upper bound of the number of candidates for a query. The best candidates are kept. [own]"""
    recent_keyframes: int = Field(10, ge=0)
    """This many of the newest keyframes are never candidates. [own]"""
    reach: float = Field(20.0, ge=0)
    """If learned descriptors verify the candidates, the query is compared only with keyframes
    within this distance, in metres. `reach_share` increases this distance. [own]"""
    reach_share: float = Field(0.05, ge=0)
    """This fraction of the distance travelled since the keyframe is added to `reach`. The default
    is several times the drift of a stereo camera in a street, which is about one per cent. [own]"""
    monocular_reach_share: float = Field(0.3, ge=0)
    """Replaces `reach` and `reach_share` in monocular maps, whose scale is unknown and drifts. The
    query is compared only with keyframes that are nearer than this fraction of the distance
    travelled since the keyframe. The default is twice the value that KITTI 00 needs, where the
    scale drifts by a factor of 2.3. [own]"""
    reach_angle: float = Field(60.0, gt=0, le=180)
    """The query is compared only with keyframes whose viewing direction differs from that of the
    query by at most this value, in degrees. The detectors do not recognise a place that is seen
    from behind or from the side. [own]"""
    reach_speedup: float = Field(5.0, ge=0)
    """While the camera is lost, its speed is assumed to be at most this many times the mean speed
    of the drive. If learned descriptors relocalise it, keyframes that it cannot have reached are
    not tried. [own]"""
    embedded_at_once: int = Field(8, ge=1)
    """Upper bound of the number of keyframes that the network processes for one query. The nearest
    keyframes are chosen. [own]"""
    fit: Literal["squash", "crop"] = "squash"
    """How an image is fitted to the network's input size. `squash` scales the whole image. `crop`
    cuts out its middle. [own]"""


class Config(Section):
    """All thresholds of the pipeline.

    Each run writes its thresholds to ``config.json``. The option ``--config`` reads such a file.

    A threshold can also be given by its dotted name: ``{"orb.n_features": 1000}`` means the same as
    ``{"orb": {"n_features": 1000}}``.
    """

    orb: OrbConfig = OrbConfig()
    weak_images: WeakImageConfig = WeakImageConfig()
    stereo: StereoConfig = StereoConfig()
    depth: DepthConfig = DepthConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    tracking: TrackingConfig = TrackingConfig()
    initialization: InitializationConfig = InitializationConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    verification: VerificationConfig = VerificationConfig()
    learned: LearnedMatchingConfig = LearnedMatchingConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    loops: LoopConfig = LoopConfig()
    bow: BowConfig = BowConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    siamese: SiameseConfig = SiameseConfig()

    @model_validator(mode="before")
    @classmethod
    def _nest(cls, given: Any) -> Any:
        """Move thresholds with dotted names into their sections."""
        if not isinstance(given, dict):
            return given
        nested = {name: value for name, value in given.items() if "." not in str(name)}
        for name in [name for name in given if name not in nested]:
            section, _, key = name.partition(".")
            values = nested.get(section, {})
            if isinstance(values, dict):
                nested[section] = {**values, key: given[name]}
            else:
                nested[name] = given[name]  # validation reports it as an unknown key
        return nested


PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {
        "orb.n_features": 1200,
        "keyframes.patch_kept_close": 0.3,
        "keyframes.publish_after_frames": 3,
        "mapping.neighbours": 5,
    }
}
"""Thresholds by the name of the preset, and by dotted name. ``fast`` trades accuracy for speed
(docs/research/performance.md)."""


def load_config(path: Path | str) -> Config:
    """Read thresholds from a JSON file. Keys that the file omits keep their defaults.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    return read_json(Config, Path(path), "configuration")


def as_config(given: Config | Mapping[str, Any] | str, where: str = "config") -> Config:
    """Check thresholds that are given as a dictionary, in the form of ``config.json``, or by the
    name of a preset.

    Args:
        given: thresholds by section or by dotted name, or a name from ``PRESETS``. Thresholds that
            are left out keep their defaults. A ``Config`` is returned unchanged.
        where: the file or argument that the thresholds come from, for error messages.

    Raises:
        InputError: a preset or a key is unknown, or a value is out of range.
    """
    if isinstance(given, str):
        given = preset(given, where)
    return checked(Config, given, where, "configuration")


def preset(name: str, where: str, sought: str = "preset") -> Mapping[str, Any]:
    """Return the thresholds of a preset, by dotted name.

    Args:
        where: the argument that contains the name, for error messages.
        sought: what the name may stand for, for error messages.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(
            f"{where}: there is no {sought} {name!r}{did_you_mean(name, PRESETS)}; the presets "
            f"are: {', '.join(PRESETS)}."
        )
    return PRESETS[name]


def changed_thresholds(config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the thresholds that differ from the defaults, by dotted name.

    Args:
        config: the content of a ``config.json``, with thresholds by section. It may come from
            another version of vslam.
    """
    default = Config().model_dump()
    return {
        f"{section}.{name}": value
        for section, values in config.items()
        for name, value in values.items()
        if name not in default.get(section, {}) or value != default[section][name]
    }


def with_preset(changed: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the thresholds of a preset with one entry, such as ``{"preset": "fast"}``.

    Args:
        changed: thresholds by dotted name. If they do not contain a whole preset, they are returned
            as they are.
    """
    for name, thresholds in PRESETS.items():
        if thresholds.items() <= changed.items():
            others = {key: changed[key] for key in changed if key not in thresholds}
            return {"preset": name, **others}
    return dict(changed)


def thresholds_in_words(changed: Mapping[str, Any], most: int = 3) -> str:
    """Describe thresholds in a short text, such as ``orb.n_features=1000, 2 more in config.json``.

    Args:
        changed: thresholds by dotted name. A preset is described by its name.
        most: greatest number of thresholds that are listed. The others are only counted.
    """
    words = [f"{name}={value}" for name, value in with_preset(changed).items()]
    more = [f"{len(words) - most} more in config.json"] if len(words) > most else []
    return ", ".join(words[:most] + more)


def read_json(model: type[_Model], path: Path, what: str) -> _Model:
    """Read a JSON file of thresholds or settings. Keys that the file omits keep their defaults.

    Args:
        what: the name of the content in error messages, such as ``configuration``.

    Raises:
        InputError: the file is missing or is not JSON, a key is unknown, or a value is out of
            range.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the {what} ({error.strerror}).") from error
    return checked(model, text, str(path), what)


def checked(model: type[_Model], given: object, where: str, what: str) -> _Model:
    """Check thresholds or settings. Values that are left out keep their defaults.

    Args:
        given: JSON as bytes, a dictionary, or a model, which is returned unchanged.
        where: the file or argument that the values come from, for error messages.
        what: the name of the values in error messages, such as ``thresholds``.

    Raises:
        InputError: the JSON cannot be parsed, a key is unknown, or a value is out of range.
    """
    try:
        if isinstance(given, bytes):
            return model.model_validate_json(given)
        return model.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(model, error, what)}.") from None


def _fault(model: type[BaseModel], error: ValidationError, what: str) -> str:
    first = error.errors()[0]
    place = [str(name) for name in first["loc"]]
    if first["type"] == "json_invalid":
        return f"the {what} is not JSON ({first['ctx']['error']}); correct the file"
    if first["type"] == "model_type":
        name = ".".join(place) or f"the {what}"
        return f'{name} must map names to values, as in {{"name": 1}}'
    why = plain_reason(first["msg"])
    if first["type"] in ("extra_forbidden", "invalid_key"):
        meant = _without_section(model, place) or did_you_mean(place[-1], _keys(model, place[:-1]))
        why = f"unknown key{meant}; correct or remove it"
    return f"{'.'.join(place)}: {why}"


def _without_section(model: type[BaseModel], place: list[str]) -> str:
    """Suggest the full name of a key that was given without its section, if a section has it."""
    sections = [section for section in model.model_fields if place[-1] in _keys(model, [section])]
    if len(place) > 1 or not sections:
        return ""
    return f" (did you mean {' or '.join(f'{section}.{place[-1]}' for section in sections)}?)"


def _keys(model: type[BaseModel], place: list[str]) -> list[str]:
    """Return the names of the keys in the section of ``model`` at ``place``, if there is one."""
    for name in place:
        field = model.model_fields.get(name)
        if field is None or not isinstance(field.annotation, type):
            return []
        if not issubclass(field.annotation, BaseModel):
            return []
        model = field.annotation
    return list(model.model_fields)
