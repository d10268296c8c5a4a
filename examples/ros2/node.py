"""A ROS 2 node that receives rectified stereo images and publishes poses (README.md)."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

import rclpy
from camera import camera_of
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from tf2_msgs.msg import TFMessage

from vslam import Slam
from vslam.datasets.bag_messages import grey_of, levels_of_messages, stamp_of
from vslam.datasets.grey_levels import Levels
from vslam.maps.ros import FramePose, odometry_message, static_tf_message, tf_message
from vslam.types.features import TrackResult

TOPICS = {
    "left/image_rect": Image,
    "right/image_rect": Image,
    "left/camera_info": CameraInfo,
    "right/camera_info": CameraInfo,
}
MOST_WAITING = 5  # stereo pairs; if tracking is too slow, older pairs are dropped
APART_S = 0.005  # seconds; largest difference between the timestamps of a pair


def message_type(name: str) -> Any:
    """Return the class of a message, such as ``nav_msgs/msg/Odometry``."""
    package, _, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)


class SlamNode(Node):
    """Tracks each stereo pair, and publishes its pose with the timestamp of the left image."""

    def __init__(self) -> None:
        super().__init__("vslam")
        self.slam: Slam | None = None
        self.levels: Levels | None = None
        self.before: FramePose | None = None
        self.detector = self.declare_parameter("detector", "both").value
        self.map_file = self.declare_parameter("save_map", "").value
        self.odometry = self.create_publisher(Odometry, "odom", 10)
        self.tf = self.create_publisher(TFMessage, "/tf", 100)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.static_tf = self.create_publisher(TFMessage, "/tf_static", kept)
        subscribers = [
            Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
            for topic, kind in TOPICS.items()
        ]
        self.pairs = ApproximateTimeSynchronizer(subscribers, MOST_WAITING, APART_S)
        self.pairs.registerCallback(self.track)

    def track(self, left: Image, right: Image, *infos: CameraInfo) -> None:
        stamp = stamp_of(left)
        try:
            if self.slam is None:
                self.slam = Slam(camera_of(*infos), detector=self.detector)
                self.static_tf.publish(static_tf_message(message_type, stamp))
                self.levels = levels_of_messages((left, right))
            publish = partial(self.publish, stamp)
            images = (grey_of(image, self.levels) for image in (left, right))
            self.slam.step(*images, stamp / 1e9, on_pose=publish)
        except ValueError as error:  # a wrong camera, or a clock that was set back
            self.get_logger().warning(f"a pair of images is left out: {error}")

    def publish(self, stamp: int, result: TrackResult) -> None:
        """Publish the pose of a frame before the frame may become a keyframe."""
        pose = FramePose.of(result, stamp)
        self.odometry.publish(odometry_message(message_type, pose, self.before))
        self.tf.publish(tf_message(message_type, pose))
        self.before = pose

    def close(self) -> None:
        if self.slam is None:
            return
        self.slam.finish()
        if self.map_file:
            self.slam.save(self.map_file)


def main() -> None:
    rclpy.init()
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
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()
