"""A ROS 2 node that receives rectified stereo images and publishes poses (README.md)."""

from __future__ import annotations

import sys
import time
from collections import deque
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from camera import LOOKS_AHEAD, camera_of, pose_of
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from imu_input import LONGEST_WAIT_S, ImuInput
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, Imu
from tf2_msgs.msg import TFMessage

from vslam import Camera, Slam
from vslam.datasets.bag_messages import grey_of, levels_of_messages, stamp_of
from vslam.datasets.grey_levels import Levels
from vslam.datasets.image_files import read_grey
from vslam.maps.ros import (
    FramePose,
    Frames,
    odometry_message,
    pose_message,
    static_tf_message,
    status_message,
    tf_message,
)
from vslam.support.errors import InputError
from vslam.types.features import TrackingState, TrackResult

TOPICS = {
    "left/image_rect": Image,
    "right/image_rect": Image,
    "left/camera_info": CameraInfo,
    "right/camera_info": CameraInfo,
}
MOST_WAITING = 5  # stereo pairs; if tracking is too slow, older pairs are dropped
MOST_SAMPLES = 2000  # messages of the IMU that arrive while a frame is tracked
APART_S = 0.005  # seconds; largest difference between the timestamps of a pair


def message_type(name: str) -> Any:
    """Return the class of a message, such as ``nav_msgs/msg/Odometry``."""
    package, _, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)


class SlamNode(Node):
    """Tracks each stereo pair, and publishes its pose with the timestamp of the left image.

    With an IMU, a pair waits until a sample that is not before it has come.

    Raises:
        InputError: a parameter is wrong, or the mask cannot be read.
    """

    def __init__(self) -> None:
        super().__init__("vslam")
        self.slam: Slam | None = None
        self.levels: Levels | None = None
        self.mask: NDArray[np.uint8] | None = None
        self.before: FramePose | None = None
        self.said: set[str] = set()
        self.detector, self.map_file, self.first_map, mask, *names = (
            self.declare_parameter(name, default).value
            for name, default in (
                ("detector", "both"),
                ("save_map", ""),
                ("load_map", ""),
                ("mask", ""),
                ("map_frame", "map"),
                ("odom_frame", "odom"),
                ("base_frame", "base_link"),
            )
        )
        mounted = self.declare_parameter("base_to_camera", LOOKS_AHEAD).value
        self.frames = Frames(*names, T_base_camera=pose_of(mounted))
        self.localize = self.declare_parameter("localize", False).value
        self.publishes_tf = self.declare_parameter("publish_tf", True).value
        if mask:
            self.mask = read_grey(Path(mask))
        self.imu = self.subscribe_to_imu()
        self.odometry = self.create_publisher(Odometry, "odom", 10)
        self.pose = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        self.status = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.static_tf = self.create_publisher(TFMessage, "/tf_static", kept)
        subscribers = [
            Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
            for topic, kind in TOPICS.items()
        ]
        self.waiting: deque[tuple[float, tuple[Any, ...]]] = deque(maxlen=MOST_WAITING)
        self.pairs = ApproximateTimeSynchronizer(subscribers, MOST_WAITING, APART_S)
        self.pairs.registerCallback(self.receive)

    def subscribe_to_imu(self) -> ImuInput | None:
        topics, files = (
            [word for word in self.declare_parameter(name, "").value.split(",") if word]
            for name in ("imu_topics", "calibration")
        )
        if not topics:
            return None
        imu = ImuInput(topics, files)
        kept = QoSProfile(depth=MOST_SAMPLES, reliability=ReliabilityPolicy.BEST_EFFORT)
        for topic in topics:
            self.create_subscription(Imu, topic, partial(self.receive_sample, topic), kept)
        self.create_timer(LONGEST_WAIT_S / 2, self.track_waiting)
        return imu

    def receive_sample(self, topic: str, message: Imu) -> None:
        self.imu.add(topic, message)
        self.track_waiting()

    def receive(self, *pair: Any) -> None:
        self.waiting.append((time.monotonic(), pair))
        self.track_waiting()

    def track_waiting(self) -> None:
        while self.waiting:
            arrived, pair = self.waiting[0]
            timestamp, waited_s = stamp_of(pair[0]) / 1e9, time.monotonic() - arrived
            if self.imu is not None and self.imu.is_awaited(timestamp, waited_s):
                return
            self.waiting.popleft()
            self.track(*pair)

    def track(self, left: Image, right: Image, *infos: CameraInfo) -> None:
        stamp = stamp_of(left)
        try:
            if self.slam is None:
                self.slam = self.begin(camera_of(*infos), infos[0])
                self.levels = levels_of_messages((left, right))
                if self.publishes_tf:
                    self.static_tf.publish(static_tf_message(message_type, stamp, self.frames))
            if self.imu is not None:
                self.warn_once(*filter(None, [self.imu.complaint(stamp / 1e9)]))
                self.slam.add_imu(self.imu.samples(stamp / 1e9))
            publish = partial(self.publish, stamp)
            images = (grey_of(image, self.levels) for image in (left, right))
            self.slam.step(*images, stamp / 1e9, mask=self.mask, on_pose=publish)
            self.warn_once(*self.slam.problems)
        except ValueError as error:  # a wrong camera, or a clock that was set back
            self.get_logger().warning(f"a pair of images is left out: {error}")

    def begin(self, camera: Camera, left: CameraInfo) -> Slam:
        imu = None if self.imu is None else self.imu.calibration(left)
        if not self.first_map:
            return Slam(camera, detector=self.detector, imu=imu, realtime=True)
        slam = Slam.load(self.first_map, localize=self.localize, imu=imu, realtime=True)
        if slam.context.camera != camera:
            raise ValueError(
                f"{self.first_map} was made with another camera: {slam.context.camera}"
            )
        return slam

    def warn_once(self, *sentences: str) -> None:
        for sentence in sentences:
            if sentence not in self.said:
                self.get_logger().warning(sentence)
        self.said.update(sentences)

    def publish(self, stamp: int, result: TrackResult) -> None:
        """Publish the pose of a frame before the frame may become a keyframe.

        Until the second frame of the map, the covariances are zero, which a filter would take for
        certainty. A lost frame has no pose in the map.
        """
        pose, frames = FramePose.of(result, stamp), self.frames
        is_known = pose.covariance is not None and pose.covariance.any()
        if is_known:
            self.odometry.publish(odometry_message(message_type, pose, self.before, frames))
        if is_known and result.state != TrackingState.LOST:
            self.pose.publish(pose_message(message_type, pose, frames))
        if self.publishes_tf:
            self.tf.publish(tf_message(message_type, pose, frames))
        self.status.publish(status_message(message_type, stamp, result, frames))
        self.before = pose

    def close(self) -> None:
        if self.slam is None:
            return
        self.slam.finish()
        if self.map_file:
            self.slam.save(self.map_file)


def main() -> None:
    rclpy.init()
    try:
        node = SlamNode()
        try:
            rclpy.spin(node)
        except KeyboardInterrupt:
            pass
        finally:
            try:
                node.close()  # fails again if mapping has failed
            finally:
                node.destroy_node()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
