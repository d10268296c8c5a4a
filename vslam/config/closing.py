"""Thresholds of loop closing: the pose graph and global bundle adjustment."""

from __future__ import annotations

from pydantic import Field

from vslam.config.section import Section


class LoopConfig(Section):
    """Global bundle adjustment after a verified loop [OS1, VII]."""

    global_iterations: int = Field(10, ge=1)
    """Upper bound of the number of iterations of global bundle adjustment.
    [OS2 III-D, customary]"""
    observations_per_keyframe: int = Field(25000, ge=1)
    """The result of global bundle adjustment is merged one keyframe after its loop, and one more
    keyframe later for every this many observations in the problem. [own]"""


class PoseGraphConfig(Section):
    """The pose graph of a loop closure: how far each edge is trusted, and when a loop is refused.

    Drift is modelled as a random walk: its standard deviation grows with the square root of the
    distance travelled. With the default values it is 1.2 % after 400 m, nearly all of it caused by
    errors of rotation. A gap is an edge over frames in which tracking was lost and the motion was
    only predicted. Such an edge is weak if there was no prediction, or under the hypothesis that
    the camera was carried elsewhere meanwhile.
    """

    min_shared: int = Field(100, ge=1)
    """A covisibility edge belongs to the graph if its ends share at least this many landmarks.
    [OS1 III-D, printed]"""
    min_shared_tree: int = Field(15, ge=1)
    """An edge of the spanning tree across a restart of mapping is weak if its ends share fewer
    landmarks than this. [OS1 III-D, printed]"""
    translation_drift: float = Field(0.03, gt=0)
    """Standard deviation of odometry, in metres per square root of a metre. [own]"""
    rotation_drift: float = Field(0.001, gt=0)
    """Standard deviation of odometry, in radians per square root of a metre. [own]"""
    scale_drift: float = Field(0.01, gt=0)
    """Standard deviation of monocular odometry, in log scale per square root of a map unit.
    [own]"""
    min_length: float = Field(0.3, gt=0)
    """Shorter edges count as this long in the drift model, in metres. [own]"""
    loop_translation: float = Field(0.1, gt=0)
    """Standard deviation of a verified loop, in metres. [own]"""
    loop_rotation: float = Field(0.005, gt=0)
    """Standard deviation of a verified loop, in radians. [own]"""
    loop_scale: float = Field(0.02, gt=0)
    """Standard deviation of a verified loop, in log scale. [own]"""
    weak_scale: float = Field(3.0, gt=0)
    """Standard deviation of a weak edge, in log scale. [own]"""
    weak_translation: float = Field(100.0, gt=0)
    """Standard deviation of a weak edge, in metres. [own]"""
    weak_rotation: float = Field(1.0, gt=0)
    """Standard deviation of a weak edge, in radians. [own]"""
    gap_translation: float = Field(0.5, gt=0)
    """Standard deviation of a gap, as a share of the distance that was predicted. [own]"""
    gap_speed: float = Field(2.0, gt=0)
    """Lower bound of the standard deviation of a gap, in metres per second of its duration.
    [own]"""
    gap_rotation: float = Field(0.3, gt=0)
    """Standard deviation of a gap, in radians per second of its duration. [own]"""
    gap_scale: float = Field(0.3, gt=0)
    """Standard deviation of a gap, in log scale. [own]"""
    min_gap: float = Field(0.3, gt=0)
    """Shorter gaps count as this long, in seconds. [own]"""
    robust_scale: float = Field(3.0, gt=0)
    """Scale of the Cauchy loss on loops, in standard deviations. [own]"""
    iterations: int = Field(50, ge=1)
    """Upper bound of the number of Levenberg-Marquardt iterations. [own]"""
    max_loop_error: float = Field(30.0, gt=0)
    """A loop is refused if its chi-square after optimisation is above this. [own]"""
    max_strain: float = Field(60.0, gt=0)
    """A loop is refused if the chi-square of all other edges is above this times the number of
    closed loops. [own]"""
