"""Runs as ROS 2 messages, read by Foxglove's library, and the conversions of the example."""

from __future__ import annotations

import math
import re
import runpy
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from test_pipeline import run as run_pipeline
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.datasets.imu import Imu, ImuFeed
from vslam.maps.ros import (
    T_BASE_OPTICAL,
    TOPICS,
    FramePose,
    Frames,
    in_ros_axes,
    nanoseconds,
    odometry_message,
    tf_message,
)
from vslam.maps.storage import load_map
from vslam.report.folder import write_results
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.geometry import inverse, se3_exp
from vslam.types.imu import GRAVITY, ImuCalibration
from vslam.types.odometry import PoseUncertainty
from vslam.types.trajectory import read_trajectory
from vslam_lab.towns.inertial import samples_along

ROOT = Path(__file__).parents[2]
TRANSIENT_LOCAL = 1  # value in rmw's enum rmw_qos_durability_policy_t
AHEAD = se3_exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
T_ROBOT_CAMERA = se3_exp(np.array([0.4, -0.2, 0.9, 0.0, 0.3, 0.0])) @ T_BASE_OPTICAL
RIGHT_TURN = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))


@pytest.fixture(scope="module")
def folder(kitti_tree, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ros")
    write_results(folder, run_pipeline(kitti_tree), pages=False)
    return folder


def export(*words: object) -> str:
    done = CliRunner().invoke(every_command(), ["export", "ros", *map(str, words)])
    if done.exception is not None:
        raise done.exception
    return done.output


def types_of_ros():
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY).types.__getitem__


def read(path: Path) -> dict[str, list]:
    """Return the messages of each topic, with the times at which they were written."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        bag = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert bag.get_header().profile == "ros2"
        for schema, channel, record, message in bag.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((record.log_time, message))
            name, latched = TOPICS[channel.topic]
            assert (schema.name, schema.encoding) == (name, "ros2msg")
            assert channel.message_encoding == "cdr"
            profiles = yaml.safe_load(channel.metadata["offered_qos_profiles"]) or []
            assert [qos["durability"] for qos in profiles] == [TRANSIENT_LOCAL] * latched
    return found


def matrix(translation, rotation) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = translation.x, translation.y, translation.z
    return T


def of_transform(stamped) -> np.ndarray:
    return matrix(stamped.transform.translation, stamped.transform.rotation)


def of_pose(pose) -> np.ndarray:
    return matrix(pose.position, pose.orientation)


def stamp(header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


@pytest.mark.slow
@pytest.mark.parametrize("online", [False, True])
def test_a_bag_says_what_the_files_of_the_run_say(folder, tmp_path, online):
    said = export(folder, "--out", tmp_path / "run.mcap", *["--online"] * online)
    assert said.startswith(f"{tmp_path / 'run.mcap'}: 28 poses, ")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]
    bag = read(tmp_path / "run.mcap")
    name = "trajectory_causal.tum" if online else "trajectory.tum"
    in_map = read_trajectory(folder / name)
    odometry = read_trajectory(folder / "trajectory_odom.tum")
    assert {topic: len(messages) for topic, messages in bag.items()} == {
        "/tf_static": 1, "/map_points": 1, "/path": 1, "/tf": 28, "/odom": 28,
    }  # fmt: skip

    ((_, static),) = bag["/tf_static"]
    (fixed,) = static.transforms
    assert (fixed.header.frame_id, fixed.child_frame_id) == ("base_link", "camera_optical")
    # The pose of the camera in the map, computed along the tree of frames.
    for k, (time, tf) in enumerate(bag["/tf"]):
        names = [(one.header.frame_id, one.child_frame_id) for one in tf.transforms]
        assert names == [("map", "odom"), ("odom", "base_link")]
        assert time == stamp(tf.transforms[0].header) == round(1e9 * in_map.timestamps[k])
        T_map_odom, T_odom_base = map(of_transform, tf.transforms)
        T_map_optical = T_map_odom @ T_odom_base @ of_transform(fixed)
        wanted = T_BASE_OPTICAL @ in_map.T_wc[k]
        np.testing.assert_allclose(T_map_optical, wanted, atol=1e-7)
        message = bag["/odom"][k][1]
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        np.testing.assert_allclose(of_pose(message.pose.pose), T_odom_base, atol=1e-9)
        np.testing.assert_allclose(
            T_odom_base @ of_transform(fixed), T_BASE_OPTICAL @ odometry.T_wc[k], atol=1e-7
        )
    ((_, path),) = bag["/path"]
    assert path.header.frame_id == "map"
    last = of_pose(path.poses[-1].pose)
    np.testing.assert_allclose(last, in_ros_axes(in_map.T_wc[-1]), atol=1e-9)

    ((_, cloud),) = bag["/map_points"]
    map_ = load_map(folder / "map.npz").map
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    fields = [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields]
    assert fields == [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]  # 7: FLOAT32
    assert (cloud.header.frame_id, cloud.width, cloud.row_step) == (
        "map",
        len(points),
        12 * len(points),
    )
    right, down, ahead = map_.arrays.xyz[map_.living_landmarks()].T
    np.testing.assert_allclose(points, np.stack([ahead, -right, -down], axis=1), rtol=1e-6)


@pytest.mark.slow
def test_a_robot_that_drives_ahead_has_the_speed_ahead_and_is_less_and_less_sure(folder, tmp_path):
    export(folder, "--out", tmp_path / "run.mcap")
    odometry = [message for _, message in read(tmp_path / "run.mcap")["/odom"]]
    trajectory = read_trajectory(folder / "trajectory_odom.tum")
    speed = np.linalg.norm(np.diff(trajectory.T_wc[:, :3, 3], axis=0), axis=1) / np.diff(
        trajectory.timestamps
    )
    linear = np.array([[getattr(m.twist.twist.linear, axis) for axis in "xyz"] for m in odometry])
    assert np.array_equal(linear[0], np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(linear[1:], axis=1), speed, rtol=1e-3)
    assert (linear[1:, 0] > 0.95 * speed).all()
    assert not np.any(odometry[0].twist.covariance)  # there is no velocity yet
    for message in odometry[1:]:
        for covariance in (message.pose.covariance, message.twist.covariance):
            assert (np.linalg.eigvalsh(np.reshape(covariance, (6, 6))) > 0).all()
    first, last = (np.trace(np.reshape(odometry[k].pose.covariance, (6, 6))) for k in (1, -1))
    assert last > first


def track(T: np.ndarray, local: np.ndarray | None) -> TrackResult:
    known = None if local is None else PoseUncertainty(local, np.zeros((6, 6)), 0)
    return TrackResult(
        0, 0.0, T, TrackingState.OK, 0, 0, 0, 0, False, T_odom_camera=T, uncertainty=known
    )


def test_the_axes_are_those_of_rep_103():
    """The camera moves ahead, turns right and moves ahead. First x increases, then y decreases."""
    types = types_of_ros()
    before, now = AHEAD, AHEAD @ RIGHT_TURN @ AHEAD
    poses = [FramePose.of(track(T, None), t) for T, t in ((before, 10**9), (now, 3 * 10**9))]
    message = odometry_message(types, poses[1], poses[0])
    position, twist = message.pose.pose.position, message.twist.twist
    assert position.x == pytest.approx(1.0 + math.cos(0.3))
    assert position.y == pytest.approx(-math.sin(0.3))
    assert position.z == pytest.approx(0.0)
    assert twist.angular.z == pytest.approx(-0.15)  # to the right, in two seconds
    assert not message.pose.covariance.any()
    assert not message.twist.covariance.any()


@pytest.mark.parametrize("frames", [Frames(), Frames(T_base_camera=T_ROBOT_CAMERA)])
def test_covariances_are_those_of_errors_in_the_axes_of_ros(frames):
    """Errors are drawn as ``vslam.types.odometry`` defines them, and measured as ROS defines them.

    Errors of position and rotation are in the axes of odom. Errors of velocity are in the axes of
    base_link.
    """
    rng = np.random.default_rng(0)
    near = np.diag([1.0, 4.0, 9.0, 0.01, 0.04, 0.09]) * 1e-6
    local = near / PoseUncertainty(np.eye(6), np.zeros((6, 6)), 0).local[0, 0]
    T_1 = AHEAD @ RIGHT_TURN
    T_2 = T_1 @ se3_exp(np.array([0.1, 0.0, 1.0, 0.0, 0.03, 0.0]))
    types = types_of_ros()
    poses = [FramePose.of(track(T, local), t) for T, t in ((T_1, 10**9), (T_2, 15 * 10**8))]
    message = odometry_message(types, poses[1], poses[0], frames)
    errors, velocities = [], []
    for one, two in rng.multivariate_normal(np.zeros(6), near, (4000, 2)):
        true = [
            FramePose(t, inverse(se3_exp(xi) @ inverse(T)), np.eye(4))
            for T, t, xi in ((T_1, 10**9, one), (T_2, 15 * 10**8, two))
        ]
        T, estimate = (frames.of_base(one.T_odom_camera) for one in (true[1], poses[1]))
        turn = Rotation.from_matrix(T[:3, :3] @ estimate[:3, :3].T).as_rotvec()
        errors.append([*(T[:3, 3] - estimate[:3, 3]), *turn])
        twist = odometry_message(types, true[1], true[0], frames).twist.twist
        velocities.append(
            [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]
        )
    for sample, given in ((errors, message.pose), (velocities, message.twist)):
        measured, promised = np.cov(np.array(sample).T), given.covariance.reshape(6, 6)
        scale = np.sqrt(np.diag(promised))
        np.testing.assert_allclose(
            measured / np.outer(scale, scale), promised / np.outer(scale, scale), atol=0.1
        )


def test_gravity_turns_the_map_until_z_points_up():
    """The camera looked down by 0.2 rad and was rolled by 0.1 rad at the first frame."""
    types = types_of_ros()
    gravity = GRAVITY * Rotation.from_rotvec([0.2, 0.0, 0.1]).inv().apply([0.0, 1.0, 0.0])
    unknown = FramePose.of(track(AHEAD, None), 10**9)
    assert len(tf_message(types, unknown).transforms) == 2
    pose = FramePose.of(replace(track(AHEAD, None), gravity=gravity), 10**9)
    *same, level = tf_message(types, pose).transforms
    assert same == tf_message(types, unknown).transforms
    assert (level.header.frame_id, level.child_frame_id) == ("level", "map")
    T_level_map = of_transform(level)
    np.testing.assert_allclose(
        T_level_map[:3, :3] @ T_BASE_OPTICAL[:3, :3] @ gravity, [0, 0, -GRAVITY], atol=1e-9
    )
    turn = Rotation.from_matrix(T_level_map[:3, :3]).as_rotvec()
    assert turn[2] == pytest.approx(0.0, abs=1e-9)  # no turn about the vertical axis
    assert not T_level_map[:3, 3].any()


@pytest.mark.parametrize("timestamp", [-0.1, 1.6e12, math.nan])
def test_times_that_ros_does_not_have_are_refused(timestamp):
    with pytest.raises(InputError, match="ROS cannot represent the time"):
        nanoseconds(timestamp)


def test_unix_times_keep_their_microseconds():
    assert nanoseconds(1764049567.123456) == pytest.approx(1764049567123456000, abs=500)


@pytest.mark.slow
def test_refusals(folder, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"run\.bag: must end in \.mcap"):
        export(folder, "--out", tmp_path / "run.bag")
    (tmp_path / "run.mcap").touch()
    with pytest.raises(InputError, match="exists already"):
        export(folder, "--out", tmp_path / "run.mcap")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(InputError, match=r"pip install 'vslam\[bag\]'"):
        export(folder, "--out", tmp_path / "other.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.slow
def test_a_run_that_only_localises_has_no_landmarks(folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    (run / "map.npz").unlink()
    assert export(run) == f"{run / 'ros.mcap'}: 28 poses, 0 landmarks\n"
    bag = read(run / "ros.mcap")
    assert len(bag["/odom"]) == 28
    ((_, cloud),) = bag["/map_points"]
    assert (cloud.width, len(cloud.data)) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("covariance.csv", None, "No such file"),
        ("trajectory.tum", None, "No such file"),
        ("covariance.csv", "timestamp\n0.1,1,2,three\n", "damaged"),
        ("covariance.csv", "timestamp\n0.1,1,2\n", "damaged"),
        ("trajectory_odom.tum", "0 0 0 0 0 0 0 1\n", "have different frames"),
    ],
)
def test_files_of_a_run_that_were_lost_or_changed(folder, tmp_path, name, text, why):
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    (run / name).unlink()
    if text is not None:
        (run / name).write_text(text)
    with pytest.raises(InputError, match=f"run.*{why}"):
        export(run)
    assert not (run / "ros.mcap").exists()


# -- examples/ros2 --------------------------------------------------------------------------------


def infos(baseline: float = 0.5, **changed: object) -> list[SimpleNamespace]:
    """Return the ``camera_info`` of a rectified pair, with ``changed`` fields on the right."""
    pair = []
    for side in (0, 1):
        P = [700.0, 0, 310, -side * 700 * baseline, 0, 710, 120, 0, 0, 0, 1, 0]
        pair.append(SimpleNamespace(p=np.array(P), width=640, height=240))
    vars(pair[1]).update(changed)
    return pair


@pytest.fixture
def camera_of():
    return runpy.run_path(str(ROOT / "examples" / "ros2" / "camera.py"))["camera_of"]


def test_the_camera_of_the_node_is_that_of_its_messages(camera_of):
    assert camera_of(*infos()) == Camera(700.0, 710.0, 310.0, 120.0, 0.5, 640, 240)


@pytest.mark.parametrize(
    ("pair", "why"),
    [
        (infos(-0.5), "baseline is -0.500 m"),
        (infos(width=320), "different sizes"),
        (infos(p=np.arange(12.0)), "P of the two cameras differs"),
        ([SimpleNamespace(p=np.zeros(12), width=640, height=240)] * 2, "calibrate the camera"),
    ],
)
def test_the_node_refuses_messages_of_no_rectified_pair(camera_of, pair, why):
    with pytest.raises(ValueError, match=why):
        camera_of(*pair)


class FakeRos:
    """The parts of ROS that the node uses. Messages are those of rosbags."""

    def __init__(self, parameters: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        self.published: dict[str, list] = {}
        self.subscribed: dict[str, tuple] = {}
        self.warnings: list[str] = []
        self.declared: list[str] = []
        self.now = 0.0
        self.timers: list = []
        ros, types = self, types_of_ros()

        class Node:
            def __init__(self, name: str) -> None:
                assert name == "vslam"

            def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
                ros.declared.append(name)
                return SimpleNamespace(value=parameters.get(name, default))

            def create_publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
                return SimpleNamespace(publish=ros.published.setdefault(topic, []).append)

            def create_subscription(self, kind: type, topic: str, callback, qos) -> None:
                ros.subscribed[topic] = (kind, callback, qos)

            def create_timer(self, period_s: float, callback) -> None:
                ros.timers.append(callback)

            def get_logger(self) -> SimpleNamespace:
                return SimpleNamespace(warning=ros.warnings.append)

        def synchroniser(subscribers: list, queue: int, slop: float) -> SimpleNamespace:
            return SimpleNamespace(registerCallback=lambda callback: setattr(ros, "pair", callback))

        def profile(**settings: object) -> SimpleNamespace:
            return SimpleNamespace(**settings)

        modules = {
            "rclpy": {},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {
                "QoSProfile": profile,
                "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL="transient local"),
                "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
                "qos_profile_sensor_data": profile(),
            },
            "message_filters": {"Subscriber": Mock(), "ApproximateTimeSynchronizer": synchroniser},
        }
        for package in ("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs",
                        "sensor_msgs", "std_msgs", "tf2_msgs"):  # fmt: skip
            modules[f"{package}.msg"] = AllTypes(package, types)
        for name, content in modules.items():
            module = content if isinstance(content, AllTypes) else SimpleNamespace(**content)
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.syspath_prepend(ROOT / "examples" / "ros2")
        for name in ("camera", "imu_input"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        program = runpy.run_path(str(ROOT / "examples" / "ros2" / "node.py"))
        program["SlamNode"].__init__.__globals__["time"] = SimpleNamespace(monotonic=self._time)
        self.node = program["SlamNode"]()

    def _time(self) -> float:
        return self.now

    def states(self) -> list[str]:
        return [array.status[0].message for array in self.published["/diagnostics"]]


class AllTypes:
    """The module ``package.msg``."""

    def __init__(self, package: str, types) -> None:
        self._package, self._types = package, types

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._types(f"{self._package}/msg/{name}")


def header_at(time: float) -> SimpleNamespace:
    seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds))


def image_at(time: float, image: np.ndarray) -> SimpleNamespace:
    height, width = image.shape
    return SimpleNamespace(
        header=header_at(time), encoding="mono8", height=height, width=width, step=width,
        is_bigendian=0, data=image.ravel(),
    )  # fmt: skip


def imu_at(row: np.ndarray) -> SimpleNamespace:
    rate, force = (SimpleNamespace(**dict(zip("xyz", v, strict=True))) for v in (row[1:4], row[4:]))
    return SimpleNamespace(
        header=header_at(row[0]), angular_velocity=rate, linear_acceleration=force
    )


T_IMU_CAMERA = se3_exp(np.array([0.1, -0.05, 0.02, 0.4, -0.3, 0.9]))
R_RECTIFIED_LEFT = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()


def infos_of(camera: Camera) -> list[SimpleNamespace]:
    pair = []
    for side in (0, 1):
        shift = -side * camera.fx * camera.baseline
        P = [camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        R = R_RECTIFIED_LEFT.ravel()
        pair.append(SimpleNamespace(p=np.array(P), r=R, width=camera.width, height=camera.height))
    return pair


@pytest.fixture
def calibration(corridor, tmp_path) -> Path:
    """Write where the IMU is on the left camera before rectification."""
    path = tmp_path / "calibration.yaml"
    T_rectified_left = np.eye(4)
    T_rectified_left[:3, :3] = R_RECTIFIED_LEFT
    one = corridor.camera
    camera = {
        "size": [one.width, one.height],
        "focal": [one.fx, one.fy],
        "centre": [one.cx, one.cy],
    }
    imu = {"T_imu_camera": (T_IMU_CAMERA @ T_rectified_left).tolist()}
    path.write_text(yaml.safe_dump({"left": camera, "imu": imu}))
    return path


def drive(ros: FakeRos, corridor, dark=(), rows=(), sent_before_image=0.0) -> None:
    """Send images and samples in the order of their times. Each sample arrives with its time, or
    later if ``sent_before_image`` is negative."""
    camera, light = infos_of(corridor.camera), np.ones(len(corridor.left), np.uint8)
    light[list(dark)] = 0
    events = [(t, 0, k) for k, t in enumerate(corridor.timestamps)]
    events += [(row[0] - sent_before_image, 1, row) for row in rows]
    for time, kind, what in sorted(events, key=lambda one: one[:2]):
        ros.now = time
        if kind:
            for topic, (_, callback, _) in ros.subscribed.items():
                assert topic in TOPICS_OF_IMU
                callback(imu_at(what))
        else:
            sides = (corridor.left[what], corridor.right[what])
            ros.pair(*(image_at(time, light[what] * side) for side in sides), *camera)


TOPICS_OF_IMU = ("/imu", "/gyro", "/accel")
DARK = range(18, 21)


def exact_samples(corridor) -> np.ndarray:
    """Return the samples of the IMU without those at the times of images, so that rounding does
    not decide which sample is the first one after an image."""
    rows = samples_along(corridor.timestamps, corridor.T_wc, T_IMU_CAMERA)
    return rows[np.arange(len(rows)) % 20 > 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topics", "late_s"), [("/imu", 0.0), ("/imu", 0.03), ("/gyro,/accel", 0.0)]
)
def test_the_node_carries_the_camera_through_the_dark_with_the_samples_of_its_imu(
    corridor, calibration, monkeypatch, topics, late_s
):
    """Samples that arrive up to 0.1 s late give the same poses."""
    rows = exact_samples(corridor)
    parameters = {"detector": "none", "imu_topics": topics, "calibration": str(calibration)}
    ros = FakeRos(parameters, monkeypatch)
    assert {qos.reliability for _, _, qos in ros.subscribed.values()} == {"best effort"}
    drive(ros, corridor, DARK, rows, -late_s)
    n = len(corridor.timestamps)
    states = ["INERTIAL" if k in DARK else "OK" for k in range(n)]
    n -= 1  # no sample comes after the last image
    assert len(ros.states()) == n
    assert ros.states() == states[:n]
    assert ros.warnings == []
    levels = [array.status[0].level for array in ros.published["/diagnostics"]]
    assert levels == [int(state == "INERTIAL") for state in ros.states()]

    calibrated = ImuCalibration(T_IMU_CAMERA)
    slam, feed = (
        Slam(corridor.camera, detector="none", imu=calibrated),
        ImuFeed(Imu("imu", lambda: rows, calibrated)),
    )
    for k, time in enumerate(corridor.timestamps[:n]):
        left, right = (np.uint8(k not in DARK) * one[k] for one in (corridor.left, corridor.right))
        wanted = slam.step(left, right, time, imu=feed.until(time))
        sent = of_transform(ros.published["/tf"][k].transforms[1])
        assert wanted.T_odom_camera is not None
        np.testing.assert_allclose(sent, in_ros_axes(wanted.T_odom_camera), atol=1e-6)
    assert wanted.gravity is not None
    *_, level = ros.published["/tf"][-1].transforms
    assert (level.header.frame_id, level.child_frame_id) == ("level", "map")
    values = {one.key: one.value for one in ros.published["/diagnostics"][-1].status[0].values}
    np.testing.assert_allclose(
        np.array(values["gravity"].split(), float),
        T_BASE_OPTICAL[:3, :3] @ wanted.gravity,
        atol=1e-4,
    )


def test_no_image_waits_for_an_imu_that_is_silent_and_the_node_says_so_once(
    corridor, calibration, monkeypatch
):
    parameters = {"detector": "none", "imu_topics": "/imu", "calibration": str(calibration)}
    ros = FakeRos(parameters, monkeypatch)
    few = replace(corridor, left=corridor.left[:6], timestamps=corridor.timestamps[:6])
    camera = infos_of(few.camera)
    send = [partial(ros.pair, image_at(t, few.left[k]), image_at(t, few.right[k]), *camera)
            for k, t in enumerate(few.timestamps)]  # fmt: skip
    send[0]()
    (tick,) = ros.timers
    tick()
    assert ros.states() == []
    ros.now += 0.11
    tick()
    assert ros.states() == ["OK"]
    for one in send[1:4]:
        one()
    assert ros.states() == ["OK"] * 4
    (said,) = ros.warnings
    assert said == "No sample of the IMU has come from /imu; check the name of the topic."
    add_sample = ros.subscribed["/imu"][1]
    for time in few.timestamps[4] + np.array([-0.06, -0.03, 0.0]):
        assert len(ros.states()) == 4
        add_sample(imu_at(np.array([time, 0.0, 0.0, 0.0, 0.0, -9.8, 0.0])))
        if time == few.timestamps[4] - 0.03:
            send[4]()  # waits, because samples come again
    assert ros.states() == ["OK"] * 5
    assert len(ros.warnings) == 1


def test_wrong_parameters_are_refused(calibration, monkeypatch):
    for parameters, said in (
        ({"imu_topics": "/imu"}, "calibration must name a file with T_imu_camera"),
        ({"imu_topics": "/a,/b,/c", "calibration": str(calibration)}, "give one topic, or those"),
        ({"base_to_camera": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]}, "give x, y, z and a quaternion"),
    ):
        with pytest.raises(InputError, match=said):
            FakeRos(parameters, monkeypatch)


@pytest.mark.slow
def test_poses_are_those_of_the_robot_and_go_on_without_a_jump_while_the_camera_is_lost(
    corridor, monkeypatch
):
    quaternion = Rotation.from_matrix(T_ROBOT_CAMERA[:3, :3]).as_quat()
    mounted = [*T_ROBOT_CAMERA[:3, 3].tolist(), *quaternion.tolist()]
    parameters = {"detector": "none", "base_to_camera": mounted, "base_frame": "robot"}
    ros = FakeRos(parameters, monkeypatch)
    drive(ros, corridor, DARK)
    n = len(corridor.timestamps)
    assert ros.states() == ["LOST" if k in DARK else "OK" for k in range(n)]
    ((static,),) = [message.transforms for message in ros.published["/tf_static"]]
    assert (static.header.frame_id, static.child_frame_id) == ("robot", "camera_optical")
    np.testing.assert_allclose(of_transform(static), T_ROBOT_CAMERA, atol=1e-12)

    in_odom, in_map = [], []
    for message in ros.published["/tf"]:
        T_map_odom, T_odom_base = map(of_transform, message.transforms)
        in_odom.append(T_odom_base)
        in_map.append(T_map_odom @ T_odom_base)
    robot = T_ROBOT_CAMERA @ corridor.T_wc @ inverse(T_ROBOT_CAMERA)
    seen = [k for k in range(n) if k not in DARK]
    np.testing.assert_allclose(np.array(in_map)[seen], robot[seen], atol=0.05)
    steps = np.linalg.norm(np.diff(np.array(in_odom)[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.45  # the robot moves by 0.35 m per frame

    odometry = ros.published["odom"]
    assert [stamp(one.header) for one in odometry] == [
        stamp(message.transforms[0].header) for message in ros.published["/tf"][1:]
    ]
    for one, before, now in zip(odometry, in_odom, in_odom[1:], strict=False):
        assert (one.header.frame_id, one.child_frame_id) == ("odom", "robot")
        np.testing.assert_allclose(of_pose(one.pose.pose), now, atol=1e-9)
        ahead = (inverse(before) @ now)[0, 3] / 0.1
        assert one.twist.twist.linear.x == pytest.approx(ahead, rel=0.05)
        for covariance in (one.pose.covariance, one.twist.covariance):
            assert np.linalg.eigvalsh(covariance.reshape(6, 6)).min() > 0.0
    growth = [np.trace(one.pose.covariance.reshape(6, 6)) for one in odometry]
    first, last = DARK[0] - 1, DARK[-1] - 1  # the first frame has no message
    assert growth[first - 1] < growth[first] < growth[last]
    assert growth[-1] > growth[first]  # odom does not return to the map
    speeds = [np.trace(one.twist.covariance.reshape(6, 6)) for one in odometry]
    assert min(speeds[first : last + 1]) > 10.0 * np.median(speeds[: first - 1])

    poses = ros.published["pose"]
    assert [stamp(one.header) for one in poses] == [
        stamp(ros.published["/tf"][k].transforms[0].header) for k in seen[1:]
    ]
    np.testing.assert_allclose(of_pose(poses[-1].pose.pose), in_map[-1], atol=1e-9)
    for one in poses:
        assert np.linalg.eigvalsh(one.pose.covariance.reshape(6, 6)).min() > 0.0


def test_nothing_is_sent_to_a_filter_before_the_second_frame_of_the_map(corridor, monkeypatch):
    ros = FakeRos({"detector": "none"}, monkeypatch)
    few = replace(corridor, left=corridor.left[:6], timestamps=corridor.timestamps[:6])
    drive(ros, few, dark=range(3))
    assert ros.states() == ["LOST"] * 3 + ["OK"] * 3
    for topic in ("odom", "pose"):
        first = ros.published[topic][0]
        assert stamp(first.header) / 1e9 == pytest.approx(corridor.timestamps[4])
        assert np.linalg.eigvalsh(first.pose.covariance.reshape(6, 6)).min() > 0.0


@pytest.mark.slow
def test_the_node_localises_in_the_map_of_an_earlier_drive_without_tf(
    corridor, tmp_path, monkeypatch
):
    mask = np.full(corridor.left[0].shape, 255, np.uint8)
    mask[-30:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    given = {"mask": str(tmp_path / "mask.png"), "publish_tf": False}
    saved = str(tmp_path / "map.npz")
    first = FakeRos({"detector": "bow", "save_map": saved, **given}, monkeypatch)
    drive(first, corridor)
    frame = first.node.slam.frame
    assert frame.features.xy[:, 1].max() < len(mask) - 30
    first.node.close()
    assert first.published["/tf"] == first.published["/tf_static"] == []

    second = FakeRos({"load_map": saved, "localize": True, **given}, monkeypatch)
    later = replace(
        corridor,
        **{name: getattr(corridor, name)[15:] for name in ("left", "right", "timestamps", "T_wc")},
    )
    drive(second, later)
    assert second.warnings == []
    assert set(second.states()[1:]) == {"OK"}
    T_map_base = of_pose(second.published["pose"][-1].pose.pose)
    np.testing.assert_allclose(T_map_base, in_ros_axes(corridor.T_wc[-1]), atol=0.05)
    assert of_pose(second.published["odom"][-1].pose.pose)[0, 3] < 5.0  # since the second start

    other = FakeRos({"load_map": saved, **given}, monkeypatch)
    wide = replace(later, camera=replace(later.camera, fx=230.0))
    drive(other, replace(wide, timestamps=later.timestamps[:1]))
    assert "was made with another camera" in other.warnings[0]


def test_the_node_leaves_ros_although_mapping_has_failed(monkeypatch):
    ros = ("rclpy.node", "rclpy.qos", "message_filters", "nav_msgs.msg", "sensor_msgs.msg",
           "tf2_msgs.msg", "diagnostic_msgs.msg", "geometry_msgs.msg", "camera",
           "imu_input")  # fmt: skip
    for name in ros:
        monkeypatch.setitem(sys.modules, name, Mock(Node=object))
    monkeypatch.setitem(sys.modules, "rclpy", rclpy := Mock())
    main = runpy.run_path(str(ROOT / "examples" / "ros2" / "node.py"))["main"]
    main.__globals__["SlamNode"] = node = Mock()
    rclpy.spin.side_effect = node().close.side_effect = RuntimeError("mapping failed")
    with pytest.raises(RuntimeError, match="mapping failed"):
        main()
    node().destroy_node.assert_called_once_with()
    rclpy.try_shutdown.assert_called_once_with()


def test_the_pages_name_the_parameters_and_topics_of_the_node(monkeypatch):
    ros = FakeRos({}, monkeypatch)
    readme = (ROOT / "examples" / "ros2" / "README.md").read_text()
    table = readme[readme.index("| parameter |") :]
    rows = [row.split("|")[1] for row in table[: table.index("\n\n")].splitlines()[2:]]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == set(ros.declared)
    assert all(f"`{topic}`" in readme for topic in ros.published)

    page = (ROOT / "docs" / "howto" / "nav2.md").read_text()
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    for ekf in yaml.safe_load(text).values():
        given = ekf["ros__parameters"]
        inputs = {key: value for key, value in given.items() if re.fullmatch(r"\D+\d", key)}
        assert {f"{name}_config" for name in inputs} == {key for key in given if "_config" in key}
        assert set(inputs.values()) <= {"wheel/odometry", *ros.published}
        assert all(len(given[f"{name}_config"]) == 15 for name in inputs)
    assert set(re.findall(r"-p (\w+):=", page + readme)) <= set(ros.declared)


def test_the_node_is_a_program_of_at_most_250_lines():
    """The node cannot be imported without ROS."""
    text = (ROOT / "examples" / "ros2" / "node.py").read_text()
    compile(text, "node.py", "exec")
    assert len(text.splitlines()) <= 250
