"""Depth cameras, whose packages are replaced with small mocks that play back recorded frames."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import corridor_depth
from source_files import open_from, run_source, write_calibration

from vslam.datasets import depth_cameras
from vslam.datasets.imu import SplitSamples
from vslam.slam import Slam
from vslam.support.errors import BrokenSourceError, InputError
from vslam.types.geometry import se3_exp
from vslam.types.source_options import SourceOptions

FRAMES = 8
PACKAGES = {"realsense": "pyrealsense2", "oakd": "depthai"}


T_IMU_CAMERA = se3_exp(np.array([0.01, -0.02, 0.03, 0.4, -0.7, 1.1]))


def measured(hz: int, base: float) -> np.ndarray:
    """Return ``(N, 4)`` times and vectors that change linearly, so that interpolation is exact."""
    times = 49.9 + np.arange(0.0, 1.1, 1.0 / hz)
    return np.column_stack([times, base + times, 0.1 * times, 0.2 * times])


@dataclass
class Recorded:
    """The frames that a device has recorded, and how the device fails."""

    camera: Any
    left: list[np.ndarray]
    right: list[np.ndarray]
    depth: list[np.ndarray]  # uint16, units of `unit` metres
    unit: float = 0.001
    lens: tuple[float, ...] = (0.0,) * 5
    shown: int = 0
    log: list[Any] = field(default_factory=list)
    gone: type[Exception] | None = None  # raised after the last frame, instead of a time-out
    imu: bool = True
    T_imu_camera: np.ndarray = field(default_factory=lambda: T_IMU_CAMERA)
    rates: np.ndarray = field(default_factory=lambda: measured(200, 0.0))
    forces: np.ndarray = field(default_factory=lambda: measured(100, 9.8))

    def following(self) -> int | None:
        if self.shown == len(self.left):
            if self.gone is not None:
                raise self.gone("the device was disconnected")
            return None
        self.shown += 1
        return self.shown - 1


def colours(grey: np.ndarray) -> np.ndarray:
    """Make ``(H, W, 3)`` RGB pixels of different colours with this grey value."""
    rgb = np.repeat(grey[..., None], 3, axis=2).astype(int)
    rgb[..., 2] = np.clip(rgb[..., 2] + 3, 0, 255)  # blue has a weight of 0.114
    return rgb.astype(np.uint8)


def realsense(recorded: Recorded, serials: tuple[str, ...] = ("817", "918")) -> SimpleNamespace:
    """Mock the part of pyrealsense2 that vslam uses. Only ``align`` registers depth to colour."""
    r, c = recorded, recorded.camera
    names = ("color", "depth", "infrared", "gyro", "accel")
    option = SimpleNamespace(
        emitter_enabled="emitter", stereo_baseline="baseline", global_time_enabled="global time"
    )

    def frame(image: np.ndarray, k: int) -> SimpleNamespace:
        return SimpleNamespace(
            get_data=lambda: image, get_timestamp=lambda: 1000.0 * (50 + 0.1 * k)
        )

    class Sensor:
        is_motion_sensor = staticmethod(lambda: False)
        supports = staticmethod(lambda name: True)
        get_option = staticmethod(lambda name: {"baseline": 1000.0 * c.baseline}[name])
        get_depth_scale = staticmethod(lambda: r.unit)
        set_option = staticmethod(lambda name, value: r.log.append((name, value)))

    class MotionProfile:
        def __init__(self, kind: str, hz: int) -> None:
            self.stream_type, self.fps = lambda: kind, lambda: hz

    class MotionSensor(Sensor):
        is_motion_sensor = staticmethod(lambda: True)
        close = staticmethod(lambda: r.log.append("close motion"))
        stop = staticmethod(lambda: r.log.append("stop motion"))

        @staticmethod
        def get_stream_profiles() -> list[MotionProfile]:
            kinds = (("gyro", 400), ("gyro", 200), ("accel", 63), ("accel", 250))
            return [MotionProfile(*kind) for kind in kinds]

        @staticmethod
        def open(profiles: list[MotionProfile]) -> None:
            if r.gone is PermissionError:
                raise RuntimeError("failed to open the HID device")
            r.log.append([(p.stream_type(), p.fps()) for p in profiles])

        @staticmethod
        def start(callback: Any) -> None:
            for kind, rows in (("gyro", r.rates), ("accel", r.forces)):
                for t, *xyz in rows.tolist():
                    motion = SimpleNamespace(**dict(zip("xyz", xyz, strict=True)))
                    callback(
                        SimpleNamespace(
                            as_motion_frame=lambda m=motion: SimpleNamespace(
                                get_motion_data=lambda: m
                            ),
                            get_profile=lambda k=kind: MotionProfile(k, 200),
                            get_timestamp=lambda t=t: 1000.0 * t,
                        )
                    )

    def device(serial: str) -> SimpleNamespace:
        sensors = [Sensor(), MotionSensor()] if r.imu else [Sensor()]
        return SimpleNamespace(
            get_info=lambda what: serial, first_depth_sensor=Sensor, query_sensors=lambda: sensors
        )

    class Config:
        def enable_device(self, serial: str) -> None:
            r.log.append(serial)

        def enable_stream(self, *what: Any) -> None:
            r.log.append(what)

    class Stream:
        def __init__(self, side: int) -> None:
            self.side = side

        def as_video_stream_profile(self) -> Stream:
            return self

        def get_intrinsics(self) -> SimpleNamespace:
            return SimpleNamespace(
                fx=c.fx, fy=c.fy, ppx=c.cx, ppy=c.cy, width=c.width, height=c.height,
                model="inverse_brown_conrady", coeffs=list(r.lens),
            )  # fmt: skip

        def get_extrinsics_to(self, other: Stream | MotionProfile) -> SimpleNamespace:
            if isinstance(other, MotionProfile):
                R, t = r.T_imu_camera[:3, :3], r.T_imu_camera[:3, 3]
                return SimpleNamespace(rotation=R.ravel(order="F").tolist(), translation=t.tolist())
            along = c.baseline * (self.side - other.side)
            return SimpleNamespace(rotation=np.eye(3).ravel().tolist(), translation=[along, 0, 0])

    class Frames:
        def __init__(self, k: int, aligned: bool = False) -> None:
            self.k, self.aligned = k, aligned

        def get_infrared_frame(self, side: int) -> Any:
            return frame((r.left, r.right)[side - 1][self.k], self.k)

        def get_color_frame(self) -> Any:
            return frame(colours(r.left[self.k]), self.k)

        def get_depth_frame(self) -> Any:
            depth = r.depth[self.k]
            return frame(depth if self.aligned else np.roll(depth, 9, axis=1), self.k)

    class Pipeline:
        def start(self, config: Config) -> SimpleNamespace:
            r.log.append("start")
            return SimpleNamespace(
                get_stream=lambda name, side=0: Stream(side), get_device=lambda: device("817")
            )

        def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, Any]:
            k = r.following()
            return k is not None, None if k is None else Frames(k)

        def stop(self) -> None:
            r.log.append("stop")

    return SimpleNamespace(
        stream=SimpleNamespace(**{name: name for name in names}),
        format=SimpleNamespace(y8="y8", rgb8="rgb8", z16="z16"), option=option,
        camera_info=SimpleNamespace(serial_number="serial"),
        distortion=SimpleNamespace(
            brown_conrady="brown_conrady", inverse_brown_conrady="inverse_brown_conrady"
        ),
        context=lambda: SimpleNamespace(query_devices=lambda: [device(s) for s in serials]),
        config=Config, pipeline=Pipeline,
        align=lambda to: SimpleNamespace(process=lambda frames: Frames(frames.k, aligned=True)),
    )  # fmt: skip


def depthai(recorded: Recorded, platform: str = "RVC2") -> SimpleNamespace:
    """Mock the part of depthai that vslam uses, which is a graph of nodes."""
    r, c = recorded, recorded.camera

    class Frame:
        def __init__(self, image: np.ndarray, k: int, lens: tuple[float, ...]) -> None:
            self.image, self.k, self.lens = image, k, lens

        def getFrame(self) -> np.ndarray:
            return self.image.copy()

        def getTimestamp(self) -> timedelta:
            return timedelta(seconds=50 + 0.1 * self.k)

        def getWidth(self) -> int:
            return self.image.shape[1]

        def getHeight(self) -> int:
            return self.image.shape[0]

        def getTransformation(self) -> SimpleNamespace:
            K = [[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]]
            return SimpleNamespace(
                getIntrinsicMatrix=lambda: K, getDistortionCoefficients=lambda: list(self.lens)
            )

    class Input:
        source: Output

    class Output:
        def __init__(self, frame: Any) -> None:
            self.frame = frame

        def link(self, other: Input) -> None:
            other.source = self

        def createOutputQueue(self, maxSize: int, blocking: bool) -> SimpleNamespace:
            def get(timeout: timedelta) -> Any:
                k = r.following()
                return None if k is None else self.frame(k)

            return SimpleNamespace(get=get)

    class Imu:
        def __init__(self) -> None:
            self.out = SimpleNamespace(createOutputQueue=self._queue)

        def enableIMUSensor(self, sensors: list[str], reportRate: int) -> None:
            r.log.append((sorted(sensors), reportRate))

        def setBatchReportThreshold(self, packets: int) -> None:
            assert packets == 1

        def setMaxBatchReports(self, packets: int) -> None:
            assert packets >= 1

        def _queue(self, maxSize: int, blocking: bool) -> SimpleNamespace:
            assert not blocking
            # As the driver does it, a packet repeats the last force until there is a new one.
            nearest = np.searchsorted(r.forces[:, 0], r.rates[:, 0], side="right").clip(1) - 1
            packets = [
                SimpleNamespace(gyroscope=report(rate), acceleroMeter=report(force))
                for rate, force in zip(r.rates, r.forces[nearest], strict=True)
            ]
            waiting = [
                [SimpleNamespace(packets=packets[k : k + 3]) for k in range(0, len(packets), 3)]
            ]

            def tryGetAll() -> list[SimpleNamespace]:
                if r.gone is not None and not waiting:
                    raise r.gone("the device was disconnected")
                return waiting.pop() if waiting else []

            return SimpleNamespace(tryGetAll=tryGetAll)

    def report(row: np.ndarray) -> SimpleNamespace:
        t, x, y, z = row.tolist()
        return SimpleNamespace(x=x, y=y, z=z, getTimestamp=lambda: timedelta(seconds=t))

    class Camera:
        def build(self, socket: str) -> Camera:
            self.socket = socket
            return self

        def requestOutput(self, size, type, *, fps, enableUndistortion) -> Output:
            images = {"A": [colours(i) for i in r.left], "B": r.left, "C": r.right}[self.socket]
            assert type in (None, "RGB888i" if self.socket == "A" else "GRAY8")
            lens = r.lens if enableUndistortion else (0.3,)
            return Output(lambda k: Frame(images[k], k, lens))

    class StereoDepth:
        def build(self, left: Output, right: Output) -> StereoDepth:
            self.inputAlignTo = Input()
            self.depth = Output(self._measured)
            return self

        def _measured(self, k: int) -> Frame:
            aligned = hasattr(self.inputAlignTo, "source")
            return Frame(r.depth[k] if aligned else np.roll(r.depth[k], 9, axis=1), k, ())

    class ImageAlign:
        def __init__(self) -> None:
            self.input, self.inputAlignTo = Input(), Input()
            self.outputAligned = Output(lambda k: Frame(r.depth[k], k, ()))

    class Sync:
        def __init__(self) -> None:
            self.inputs = {"left": Input(), "second": Input()}
            self.out = Output(
                lambda k: {
                    name: i.source.frame(k)
                    for name, i in self.inputs.items()
                    if hasattr(i, "source")
                }
            )

        def setSyncThreshold(self, threshold: timedelta) -> None:
            assert threshold < timedelta(seconds=0.02)

    class Device:
        def __init__(self, name: str = "1844") -> None:
            if name != "1844":
                raise RuntimeError("Cannot find any device with given deviceInfo")

        def getDeviceId(self) -> str:
            return "1844"

        def getPlatform(self) -> str:
            return platform

        def getConnectedIMU(self) -> str:
            return "BMI270" if r.imu else "NONE"

        def readCalibration(self) -> SimpleNamespace:
            def getCameraExtrinsics(source: str, to: str) -> list[list[float]]:
                T = np.eye(4)
                T[0, 3] = 100.0 * c.baseline * (1 if (source, to) == ("C", "B") else -1)
                return T.tolist()

            def getCameraToImuExtrinsics(camera: str) -> list[list[float]]:
                if r.T_imu_camera is None:
                    raise RuntimeError("IMU calibration data is not available on device yet.")
                T = r.T_imu_camera.copy()
                T[:3, 3] *= 100.0
                return T.tolist()

            return SimpleNamespace(
                getCameraExtrinsics=getCameraExtrinsics,
                getCameraToImuExtrinsics=getCameraToImuExtrinsics,
            )

        def close(self) -> None:
            r.log.append("close")

    class Pipeline:
        def __init__(self, device: Device) -> None:
            self.getDefaultDevice = lambda: device

        def create(self, node: type) -> Any:
            r.log.append(node.__name__)
            return node()

        def start(self) -> None:
            r.log.append("start")

        def stop(self) -> None:
            r.log.append("stop")

    return SimpleNamespace(
        Device=Device, Pipeline=Pipeline, Platform=SimpleNamespace(RVC4="RVC4"),
        node=SimpleNamespace(
            Camera=Camera, StereoDepth=StereoDepth, ImageAlign=ImageAlign, Sync=Sync, IMU=Imu
        ),
        IMUSensor=SimpleNamespace(ACCELEROMETER_RAW="accel", GYROSCOPE_RAW="gyro"),
        CameraBoardSocket=SimpleNamespace(CAM_A="A", CAM_B="B", CAM_C="C"),
        ImgFrame=SimpleNamespace(Type=SimpleNamespace(GRAY8="GRAY8", RGB888i="RGB888i")),
        MessageQueue=SimpleNamespace(QueueException=QueueGoneError),
    )  # fmt: skip


class QueueGoneError(Exception):
    """An error that is not a RuntimeError, like the error of depthai."""


FAKES = {"realsense": realsense, "oakd": depthai}


@pytest.fixture
def recorded(corridor) -> Recorded:
    poses = corridor.T_wc[:FRAMES]
    metres = [corridor_depth(corridor.camera, T_wc) for T_wc in poses]
    depth = [np.rint(1000 * m).clip(0, 65535).astype(np.uint16) for m in metres]
    return Recorded(corridor.camera, corridor.left[:FRAMES], corridor.right[:FRAMES], depth)


def connect(monkeypatch, dataset: str, recorded: Recorded, *more: Any) -> None:
    monkeypatch.setitem(sys.modules, PACKAGES[dataset], FAKES[dataset](recorded, *more))


def taken(source) -> list[Any]:
    """Return the frames of a source until the device stops."""
    frames = []
    with pytest.raises(BrokenSourceError, match="stopped after"):
        frames.extend(source.frames())  # extend keeps the frames before the error
    return frames


@pytest.mark.parametrize("dataset", ["realsense", "oakd"])
@pytest.mark.parametrize("sensor", ["stereo", "rgbd", "mono", None])
def test_the_frames_and_the_calibration_are_those_of_the_device(
    dataset, sensor, recorded, monkeypatch
):
    connect(monkeypatch, dataset, recorded)
    source = open_from(dataset, "", sensor=sensor)
    sensor = sensor or {"realsense": "rgbd", "oakd": "stereo"}[dataset]
    wanted = recorded.camera
    assert (source.dataset, source.name) == (dataset, {"realsense": "817", "oakd": "1844"}[dataset])
    assert source.live
    assert source.camera.sensor == sensor
    assert (source.camera.fx, source.camera.cx) == (wanted.fx, wanted.cx)
    assert source.camera.baseline == pytest.approx(0.0 if sensor == "mono" else wanted.baseline)
    first = recorded.shown  # the first image of an OAK camera was used to find the image size
    frames = taken(source)
    assert len(frames) == FRAMES - first
    assert [f.timestamp for f in frames] == pytest.approx(
        [50 + 0.1 * k for k in range(first, FRAMES)]
    )
    for k, frame in enumerate(frames, first):
        left, second = frame.read(map)
        assert np.abs(left.astype(int) - recorded.left[k]).max() <= (frame.colour is not None)
        if sensor == "stereo":
            assert np.array_equal(second, recorded.right[k])
        elif sensor == "rgbd":
            assert second.dtype == np.float32
            np.testing.assert_allclose(second, recorded.depth[k] / 1000, rtol=1e-6)
        else:
            assert second is None
        if frame.colour is not None:
            assert np.array_equal(frame.colour(), colours(recorded.left[k]))
    assert "stop" in recorded.log


@pytest.mark.parametrize("sensor", ["stereo", "rgbd"])
@pytest.mark.parametrize("dataset", ["realsense", "oakd"])
def test_the_samples_of_the_imu_reach_each_step(dataset, sensor, recorded, monkeypatch):
    connect(monkeypatch, dataset, recorded)
    source = open_from(dataset, "", sensor=sensor)
    assert source.imu is not None
    assert source.imu.live
    assert source.imu.calibration is not None
    np.testing.assert_allclose(source.imu.calibration.T_imu_camera, T_IMU_CAMERA, atol=1e-9)
    passed: list[np.ndarray] = []
    monkeypatch.setattr(Slam, "add_imu", lambda self, samples: passed.append(np.array(samples)))
    run_source(source)
    rows = np.concatenate(passed)
    between = recorded.rates[:, 0] <= recorded.forces[-1, 0]  # later rates wait for a force
    np.testing.assert_allclose(rows[:, :4], recorded.rates[between], atol=1e-6)
    np.testing.assert_allclose(rows[:, 4], 9.8 + rows[:, 0], atol=1e-6)
    if dataset == "realsense":
        assert [("gyro", 200), ("accel", 250)] in recorded.log
        assert ("global time", 1.0) in recorded.log
        assert recorded.log[-3:] == ["stop motion", "close motion", "stop"]
    else:
        assert (["accel", "gyro"], 200) in recorded.log


@pytest.mark.parametrize("dataset", ["realsense", "oakd"])
def test_a_device_without_an_imu_or_without_its_calibration(dataset, recorded, monkeypatch):
    recorded.T_imu_camera = np.zeros((4, 4))  # as devices hold it that were never calibrated
    connect(monkeypatch, dataset, recorded)
    imu = open_from(dataset, "", sensor="stereo").imu
    assert imu is not None
    assert imu.calibration is None
    if dataset == "oakd":
        recorded.T_imu_camera, recorded.shown = None, 0
        assert open_from(dataset, "", sensor="stereo").imu.calibration is None
    recorded.imu, recorded.shown = False, 0
    assert open_from(dataset, "", sensor="stereo").imu is None


def test_an_imu_that_cannot_be_started_costs_no_images(recorded, monkeypatch):
    recorded.gone = PermissionError
    connect(monkeypatch, "realsense", recorded)
    source = open_from("realsense", "", sensor="stereo")
    assert source.imu is None
    assert source.warnings == (
        "realsense 817: the IMU is not used, because it cannot be started "
        "(failed to open the HID device).",
    )


def test_rates_wait_for_the_next_force_and_old_samples_are_dropped():
    samples = SplitSamples()
    for t in (0.0, 0.005, 0.01, 0.015):
        samples.add_rate(t, t, 0.0, 0.0)
    assert len(samples.read()) == 0
    samples.add_force(0.0, 0.0, 0.0, 1.0)
    assert len(samples.read()) == 0
    samples.add_force(0.01, 0.0, 0.0, 2.0)
    rows = samples.read()
    np.testing.assert_allclose(rows[:, [0, 1, 6]], [(0.005, 0.005, 1.5), (0.01, 0.01, 2.0)])
    samples.add_force(0.02, 0.0, 0.0, 4.0)
    np.testing.assert_allclose(samples.read()[:, [0, 6]], [(0.015, 3.0)])
    for k in range(30_000):
        samples.add_rate(1.0 + k, 0.0, 0.0, 0.0)
    samples.add_force(30_000.98, 0.0, 0.0, 0.0)
    samples.add_force(30_001.02, 0.0, 0.0, 0.0)
    assert samples.read()[:, 0].tolist() == []


def test_depth_of_the_newer_oak_cameras_is_registered_by_a_node(recorded, monkeypatch):
    connect(monkeypatch, "oakd", recorded, "RVC4")
    frame = taken(open_from("oakd", "", sensor="rgbd"))[0]
    np.testing.assert_allclose(frame.read(map)[1], recorded.depth[1] / 1000, rtol=1e-6)
    assert "ImageAlign" in recorded.log


@pytest.mark.parametrize(("sensor", "on"), [("stereo", 0.0), ("mono", 0.0), ("rgbd", 1.0)])
def test_the_projector_is_set_before_the_first_image(sensor, on, recorded, monkeypatch):
    connect(monkeypatch, "realsense", recorded)
    open_from("realsense", "918", sensor=sensor)
    assert recorded.log.index(("emitter", on)) < recorded.log.index("start")
    assert "918" in recorded.log


def test_a_lens_and_another_depth_unit(recorded, monkeypatch):
    recorded.lens, recorded.unit = (-0.055, 0.065, 0.0, 0.0, -0.02), 0.0001
    connect(monkeypatch, "realsense", recorded)
    source = open_from("realsense", "")
    assert source.rectify_mask is not None
    left, depth = taken(source)[0].read(map)
    middle = tuple(n // 2 for n in left.shape)
    assert depth[middle] == pytest.approx(recorded.depth[0][middle] / 1e4, rel=0.05)
    assert not np.array_equal(left, recorded.left[0])


def test_a_calibration_file_replaces_that_of_the_device(recorded, monkeypatch, tmp_path):
    connect(monkeypatch, "oakd", recorded)
    other = SimpleNamespace(**{**vars(recorded.camera), "fx": 250.0, "fy": 250.0})
    calib = write_calibration(tmp_path / "stereo.yaml", other)
    assert open_from("oakd", "", SourceOptions(calib=(calib,))).camera.fx == 250.0


@pytest.mark.parametrize(
    ("dataset", "gone"),
    [("realsense", None), ("realsense", RuntimeError), ("oakd", None), ("oakd", QueueGoneError)],
)
def test_a_run_keeps_what_a_device_gave_before_it_stopped(dataset, gone, recorded, monkeypatch):
    recorded.gone = gone
    connect(monkeypatch, dataset, recorded)
    outcome = run_source(open_from(dataset, "", sensor="stereo"))
    n = FRAMES - (dataset == "oakd")
    assert len(outcome.trajectory) == n
    assert f"stopped after {n} images; check its cable" in outcome.interrupted


def test_what_is_missing_is_said_in_one_sentence(recorded, monkeypatch, call):
    def refused(match: str, *words: str) -> None:
        code, _, err = call("run", *words)
        assert code == 2
        assert re.search(match, " ".join(err.split()))

    for dataset, package in PACKAGES.items():
        monkeypatch.setitem(sys.modules, package, None)
        refused(rf"pip install 'vslam\[{dataset}\]'", "--dataset", dataset)

    def broken(name: str) -> None:
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    with monkeypatch.context() as patched:
        patched.setattr(depth_cameras.importlib, "import_module", broken)
        refused("libusb-1.0.so.0: cannot open .* install the libraries", "--dataset", "realsense")
    connect(monkeypatch, "realsense", recorded, ())
    refused("no RealSense camera is connected", "--dataset", "realsense")
    connect(monkeypatch, "realsense", recorded)
    refused("connected are 817, 918", "--dataset", "realsense", "--data", "77")
    connect(monkeypatch, "oakd", recorded)
    refused("oakd 77: Cannot find any device", "--dataset", "oakd", "--data", "77")
    refused("--seq 05: only for data sets", "--dataset", "oakd", "--seq", "05")


def test_a_calibration_that_cannot_be_used_is_refused(recorded, monkeypatch):
    recorded.lens = (0.1, 0.2)
    connect(monkeypatch, "oakd", recorded)
    with pytest.raises(InputError, match="the device cannot undistort"):
        open_from("oakd", "")
    assert recorded.log[-2:] == ["stop", "close"]
    fake = realsense(recorded)
    fake.distortion = SimpleNamespace(brown_conrady="other", inverse_brown_conrady="another")
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    with pytest.raises(InputError, match=r"the lens model .* is not supported; .* --calib"):
        open_from("realsense", "")
    assert recorded.log[-1] == "stop"


def test_a_device_without_images_is_closed(recorded, monkeypatch):
    recorded.shown = FRAMES
    connect(monkeypatch, "oakd", recorded)
    with pytest.raises(InputError, match="it returns no image"):
        open_from("oakd", "")
    assert recorded.log[-2:] == ["stop", "close"]


@pytest.mark.parametrize("dataset", ["realsense", "oakd"])
def test_the_package_has_the_names_that_its_fake_has(dataset, recorded):
    package = pytest.importorskip(PACKAGES[dataset], exc_type=ImportError)

    def compare(fake: Any, real: Any) -> None:
        for name in vars(fake):
            assert hasattr(real, name), name
            inner = getattr(fake, name)
            if isinstance(inner, SimpleNamespace):
                compare(inner, getattr(real, name))
            elif isinstance(inner, type):
                public = [n for n, f in vars(inner).items() if callable(f) and n[0] != "_"]
                assert all(hasattr(getattr(real, name), n) for n in public), public

    compare(FAKES[dataset](recorded), package)
