"""Converts poses and landmarks to ROS 2 messages and bags. ROS need not be installed.

The frames follow REP 105: ``map`` -> ``odom`` -> ``base_link`` -> ``camera_optical``. Their axes
follow REP 103. In ``map``, ``odom`` and ``base_link``, x points forward, y left and z up. In
``camera_optical``, x points right, y down and z forward, as everywhere else in vslam. ``base_link``
is at the left camera, unless `Frames` places it elsewhere. ``map`` and ``odom`` are at the first
pose of ``base_link``. Lengths are in metres, or in the unit of a monocular map.

If an IMU has measured gravity, ``level`` -> ``map`` turns ``map`` until z points up. The turn
has no other part, and ``map`` itself never turns.

The argument ``types`` is a function that returns the message class for the name of a message. Files
are written with classes of the package rosbags. A ROS node uses the classes of ROS
(``examples/ros2``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vslam.maps.level import level_world
from vslam.support.errors import InputError
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import Matrix, adjoint, inverse, inverses, se3_log
from vslam.types.trajectory import Trajectory, quaternions

LEVEL = "level"
Types = Callable[[str], Any]

T_BASE_OPTICAL = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_LAST_SECOND = 2**31  # builtin_interfaces/Time counts seconds as a signed 32-bit number
_FLOAT32 = 7  # sensor_msgs/PointField
_VERSION: Literal[8] = 8  # bag version of ROS 2 Humble; later releases read it, too
# The message type of each topic, and whether the topic is latched. A latched topic has a single
# message, which subscribers that connect later also receive.
TOPICS = {
    "/tf_static": ("tf2_msgs/msg/TFMessage", True),
    "/map_points": ("sensor_msgs/msg/PointCloud2", True),
    "/path": ("nav_msgs/msg/Path", True),
    "/tf": ("tf2_msgs/msg/TFMessage", False),
    "/odom": ("nav_msgs/msg/Odometry", False),
}


@dataclass(frozen=True, eq=False)
class Frames:
    """The names of the frames, and where the camera is on the robot.

    Attributes:
        map, odom, base, camera: names. ``camera`` is the frame of the rectified left camera.
        T_base_camera: ``(4, 4)`` float64, maps points of ``camera`` to ``base``.
    """

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    camera: str = "camera_optical"
    T_base_camera: Matrix = field(default_factory=T_BASE_OPTICAL.copy)

    def of_base(self, T: Matrix) -> Matrix:
        """Convert a ``(4, 4)`` pose of the camera in its first frame to the pose of ``base`` in the
        first frame of ``base``."""
        pose: Matrix = self.T_base_camera @ T @ inverse(self.T_base_camera)
        return pose


@dataclass(frozen=True, eq=False)
class FramePose:
    """The pose of a frame, split into odometry and correction as in REP 105.

    Attributes:
        stamp: time of the image in nanoseconds.
        T_odom_camera: ``(4, 4)`` pose of the camera in the odometry frame.
        T_map_odom: ``(4, 4)`` transformation from the odometry frame to the map frame.
        near: ``(6, 6)`` covariance of the pose relative to the landmarks around the camera. None if
            it is unknown.
        covariance: ``(6, 6)`` covariance of the pose relative to the start of the drive. None if it
            is unknown.
        gravity: ``(3,)`` acceleration of free fall in the world frame of vslam. None if it is
            unknown.
    """

    stamp: int
    T_odom_camera: Matrix
    T_map_odom: Matrix
    near: Matrix | None = None
    covariance: Matrix | None = None
    gravity: Matrix | None = None

    @classmethod
    def of(cls, result: TrackResult, stamp: int) -> FramePose:
        """Create the pose of a frame from the result of ``Slam.step``.

        ``stamp`` is in nanoseconds, because ROS looks up transforms by exact times. Unix time in
        float64 seconds has a resolution of only 0.2 us.
        """
        uncertainty, T = result.uncertainty, result.T_odom_camera
        return cls(
            stamp,
            result.T_wc if T is None else T,
            result.T_map_odom,
            None if uncertainty is None else uncertainty.local,
            None if uncertainty is None else uncertainty.covariance,
            result.gravity,
        )


_FRAMES = Frames()


def in_ros_axes(T: Matrix) -> Matrix:
    """Convert ``(..., 4, 4)`` transformations between camera frames to the axes of ROS (x forward,
    z up)."""
    result: Matrix = T_BASE_OPTICAL @ T @ T_BASE_OPTICAL.T
    return result


def odometry_message(
    types: Types, pose: FramePose, before: FramePose | None, frames: Frames = _FRAMES
) -> Any:
    """Create ``nav_msgs/Odometry`` with the pose of ``base_link`` in the frame ``odom``.

    The velocity is in the axes of ``base_link``. It is the mean velocity since the earlier frame
    ``before``, or zero if ``before`` is None.
    """
    T_odom_base, twist, A = frames.of_base(pose.T_odom_camera), np.zeros(6), _adjoint(frames)
    if before is not None:
        motion = inverse(frames.of_base(before.T_odom_camera)) @ T_odom_base
        twist = se3_log(motion) / _seconds_between(before, pose)
    linear, angular = (_xyz(types, "Vector3", part) for part in (twist[:3], twist[3:]))
    return types("nav_msgs/msg/Odometry")(
        header=_header(types, pose.stamp, frames.odom),
        child_frame_id=frames.base,
        pose=types("geometry_msgs/msg/PoseWithCovariance")(
            pose=_pose(types, T_odom_base),
            covariance=_covariance(pose.covariance, _both(T_odom_base[:3, :3]) @ A),
        ),
        twist=types("geometry_msgs/msg/TwistWithCovariance")(
            twist=types("geometry_msgs/msg/Twist")(linear=linear, angular=angular),
            covariance=_covariance(_velocity_covariance(pose, before), A),
        ),
    )


def pose_message(types: Types, pose: FramePose, frames: Frames = _FRAMES) -> Any:
    """Create ``geometry_msgs/PoseWithCovarianceStamped`` with the pose of ``base_link`` in the
    frame ``map``.

    Its covariance is that of the odometry, which does not know that loops reduce the error.
    """
    T_map_base = frames.of_base(pose.T_map_odom @ pose.T_odom_camera)
    return types("geometry_msgs/msg/PoseWithCovarianceStamped")(
        header=_header(types, pose.stamp, frames.map),
        pose=types("geometry_msgs/msg/PoseWithCovariance")(
            pose=_pose(types, T_map_base),
            covariance=_covariance(pose.covariance, _both(T_map_base[:3, :3]) @ _adjoint(frames)),
        ),
    )


def tf_message(types: Types, pose: FramePose, frames: Frames = _FRAMES) -> Any:
    """Create ``tf2_msgs/TFMessage`` with ``map`` -> ``odom`` and ``odom`` -> ``base_link``, and
    with ``level`` -> ``map`` if gravity is known."""
    names, T_map_odom = (frames.map, frames.odom), frames.of_base(pose.T_map_odom)
    T_odom_base = frames.of_base(pose.T_odom_camera)
    transforms = [
        _transform(types, pose.stamp, *names, T_map_odom),
        _transform(types, pose.stamp, frames.odom, frames.base, T_odom_base),
    ]
    if pose.gravity is not None:
        T_base_camera = np.eye(4)
        T_base_camera[:3, :3] = frames.T_base_camera[:3, :3]
        T_level_map = level_world(pose.gravity, T_base_camera) @ T_base_camera.T
        transforms.append(_transform(types, pose.stamp, LEVEL, frames.map, T_level_map))
    return types("tf2_msgs/msg/TFMessage")(transforms=transforms)


def static_tf_message(types: Types, stamp: int, frames: Frames = _FRAMES) -> Any:
    """Create ``tf2_msgs/TFMessage`` with ``base_link`` -> ``camera_optical``."""
    transform = _transform(types, stamp, frames.base, frames.camera, frames.T_base_camera)
    return types("tf2_msgs/msg/TFMessage")(transforms=[transform])


def status_message(types: Types, stamp: int, result: TrackResult, frames: Frames = _FRAMES) -> Any:
    """Create ``diagnostic_msgs/DiagnosticArray`` with the state of a frame as its message.

    Its level is OK if the images gave a pose with enough inliers, ERROR if the pose is only
    predicted, and WARN otherwise. Its values are the number of inliers, the part of the map
    (``TrackResult.part``), and gravity along the axes of ``map`` in m/s^2, or "unknown".

    Args:
        stamp: time of the image in nanoseconds.
    """
    status = types("diagnostic_msgs/msg/DiagnosticStatus")
    level = {
        TrackingState.OK: status.OK,
        TrackingState.LOST: status.ERROR,
        TrackingState.DROPPED: status.ERROR,
    }.get(result.state, status.WARN)
    gravity = "unknown"
    if result.gravity is not None:
        xyz = frames.T_base_camera[:3, :3] @ result.gravity
        gravity = " ".join(f"{one:.4f}" for one in xyz)
    values = {"inliers": str(result.n_inliers), "part": str(result.part), "gravity": gravity}
    pair = types("diagnostic_msgs/msg/KeyValue")
    return types("diagnostic_msgs/msg/DiagnosticArray")(
        header=_header(types, stamp, ""),
        status=[
            status(
                level=level,
                name="vslam: tracking",
                message=str(result.state),
                hardware_id="",
                values=[pair(key=key, value=value) for key, value in values.items()],
            )
        ],
    )


def path_message(types: Types, trajectory: Trajectory) -> Any:
    """Create ``nav_msgs/Path`` with the poses of ``base_link`` in ``map``."""
    stamps = [nanoseconds(timestamp) for timestamp in trajectory.timestamps.tolist()]
    poses = [
        types("geometry_msgs/msg/PoseStamped")(
            header=_header(types, stamp, _FRAMES.map), pose=_pose(types, T)
        )
        for stamp, T in zip(stamps, in_ros_axes(trajectory.T_wc), strict=True)
    ]
    return types("nav_msgs/msg/Path")(header=_header(types, stamps[0], _FRAMES.map), poses=poses)


def points_message(types: Types, stamp: int, xyz: NDArray[np.float64]) -> Any:
    """Create ``sensor_msgs/PointCloud2`` in the frame ``map`` from ``(N, 3)`` points in the world
    frame of vslam."""
    points = (xyz @ T_BASE_OPTICAL[:3, :3].T).astype("<f4")
    fields = [
        types("sensor_msgs/msg/PointField")(name=name, offset=4 * k, datatype=_FLOAT32, count=1)
        for k, name in enumerate("xyz")
    ]
    return types("sensor_msgs/msg/PointCloud2")(
        header=_header(types, stamp, _FRAMES.map),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=True,
    )


def nanoseconds(timestamp: float) -> int:
    """Convert a timestamp in seconds to nanoseconds.

    Raises:
        InputError: ROS cannot represent the time.
    """
    if not 0 <= timestamp < _LAST_SECOND:
        raise InputError(
            f"ROS cannot represent the time {timestamp:.0f} s; give the images times between 0 and "
            "2^31 seconds."
        )
    return round(1e9 * timestamp)


def save_bag(
    path: Path, poses: Sequence[FramePose], trajectory: Trajectory, xyz: NDArray[np.float64]
) -> None:
    """Write an MCAP file with the topics of ``TOPICS``.

    Args:
        poses: the poses to write to the topics ``/tf`` and ``/odom``. At least one pose is needed.
        trajectory: the final poses of the camera, to write to the topic ``/path``.
        xyz: ``(N, 3)`` landmarks in the world frame of the trajectory.

    Raises:
        InputError: rosbags is not installed, or ROS cannot represent a time of the trajectory.
        OSError: the file cannot be written.
    """
    try:
        from rosbags import interfaces
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise InputError(
            f"{path}: writing a bag needs rosbags, which is not installed; run "
            "pip install 'vslam[bag]'."
        ) from error
    forever = interfaces.QosTime(9223372036, 854775807)
    latched = interfaces.Qos(
        interfaces.QosHistory.KEEP_LAST,
        1,
        interfaces.QosReliability.RELIABLE,
        interfaces.QosDurability.TRANSIENT_LOCAL,
        forever,
        forever,
        interfaces.QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types.__getitem__
    with TemporaryDirectory(dir=path.parent) as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = {
                topic: writer.add_connection(
                    topic, name, typestore=store, offered_qos_profiles=[latched] if once else []
                )
                for topic, (name, once) in TOPICS.items()
            }

            def write(topic: str, stamp: int, message: Any) -> None:
                data = store.serialize_cdr(message, TOPICS[topic][0])
                writer.write(topics[topic], stamp, data)

            start = poses[0].stamp
            write("/tf_static", start, static_tf_message(types, start))
            write("/map_points", start, points_message(types, start, xyz))
            write("/path", start, path_message(types, trajectory))
            before = None
            for pose in poses:
                write("/tf", pose.stamp, tf_message(types, pose))
                write("/odom", pose.stamp, odometry_message(types, pose, before))
                before = pose
        next(bag.glob("*.mcap")).replace(path)


def frame_poses(
    odometry: Trajectory,
    trajectory: Trajectory,
    covariances: dict[str, tuple[Matrix, Matrix]],
    gravity: Matrix | None = None,
) -> list[FramePose]:
    """Combine the trajectories and covariances of a run into one pose for each frame.

    Args:
        odometry: poses of the camera in the odometry frame.
        trajectory: poses of the camera in the map frame, for the same frames as in ``odometry``.
        covariances: the two covariances of each frame by timestamp (``read_covariances``).
        gravity: ``(3,)`` acceleration of free fall in the map frame. None if it is unknown.

    Raises:
        InputError: ROS cannot represent a time.
    """
    times = odometry.timestamps.tolist()
    corrections = trajectory.T_wc @ inverses(odometry.T_wc)
    found = []
    for timestamp, T_odom_camera, T_map_odom in zip(times, odometry.T_wc, corrections, strict=True):
        near, covariance = covariances.get(f"{timestamp:.6f}", (None, None))
        stamp = nanoseconds(timestamp)
        found.append(FramePose(stamp, T_odom_camera, T_map_odom, near, covariance, gravity))
    return found


def _covariance(matrix: Matrix | None, A: Matrix) -> NDArray[np.float64]:
    """Return the covariance of the errors ``A xi``, as ``(36,)`` row by row, from the covariance of
    the errors ``xi = [x, y, z, rx, ry, rz]``.

    An unknown covariance (None) becomes all zeros, which is the convention of ``sensor_msgs``.
    """
    if matrix is None:
        return np.zeros(36)
    moved: NDArray[np.float64] = (A @ matrix @ A.T).ravel()
    return moved


def _both(R: Matrix) -> Matrix:
    """Return the ``(6, 6)`` matrix that rotates ``[v, w]`` by ``R``."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = R
    return both


def _adjoint(frames: Frames) -> Matrix:
    """Return the ``(6, 6)`` matrix that moves a twist from the camera to ``base_link``."""
    return adjoint(frames.T_base_camera)


def _velocity_covariance(pose: FramePose, before: FramePose | None) -> Matrix | None:
    """Return the ``(6, 6)`` covariance of the mean velocity between two frames, in the frame of the
    camera.

    The errors of the two poses relative to the landmarks are independent. The error in the
    positions of the landmarks is the same for both poses, and therefore cancels.
    """
    if before is None or before.near is None or pose.near is None:
        return None
    A = adjoint(inverse(pose.T_odom_camera) @ before.T_odom_camera)
    total: Matrix = (pose.near + A @ before.near @ A.T) / _seconds_between(before, pose) ** 2
    return total


def _seconds_between(before: FramePose, pose: FramePose) -> float:
    return (pose.stamp - before.stamp) / 1e9


def _header(types: Types, stamp: int, frame: str) -> Any:
    seconds, rest = divmod(stamp, 10**9)
    time = types("builtin_interfaces/msg/Time")(sec=seconds, nanosec=rest)
    return types("std_msgs/msg/Header")(stamp=time, frame_id=frame)


def _xyz(types: Types, name: str, xyz: NDArray[np.float64]) -> Any:
    x, y, z = xyz.tolist()
    return types(f"geometry_msgs/msg/{name}")(x=x, y=y, z=z)


def _rotation(types: Types, T: Matrix) -> Any:
    x, y, z, w = quaternions(T[None, :3, :3])[0].tolist()
    return types("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def _pose(types: Types, T: Matrix) -> Any:
    return types("geometry_msgs/msg/Pose")(
        position=_xyz(types, "Point", T[:3, 3]), orientation=_rotation(types, T)
    )


def _transform(types: Types, stamp: int, parent: str, child: str, T: Matrix) -> Any:
    return types("geometry_msgs/msg/TransformStamped")(
        header=_header(types, stamp, parent),
        child_frame_id=child,
        transform=types("geometry_msgs/msg/Transform")(
            translation=_xyz(types, "Vector3", T[:3, 3]), rotation=_rotation(types, T)
        ),
    )
