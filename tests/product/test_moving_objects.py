"""Vehicles that move in front of a standing camera do not move the camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from inertial import ADIS16448

from vslam.config import Config
from vslam.slam import Slam
from vslam.types.camera import Camera
from vslam.types.features import TrackingState, TrackResult
from vslam.types.imu import GRAVITY, ImuCalibration

CAMERA = Camera(240.0, 240.0, 239.5, 99.5, 0.5, 480, 200)
DISPARITY = 15  # of the vehicles, which are 8 m away
LONG = 540  # columns of a vehicle that can cover the whole image
MOVES_AT = 10  # frames at rest before the vehicle moves
APPROACH = np.array([0.35] * 5 + [0.2, 0.1])  # motion of the camera before it stands, m per frame
DEPARTURE = np.array([0.1, 0.2, 0.3] + [0.35] * 7)
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Street:
    """The image pairs of a camera that drives up, stands, and drives off again.

    ``z`` has the true positions of the camera on its way up, at rest, and on its way off.
    """

    up: list[Pair]
    rest: Pair
    off: list[Pair]
    z: np.ndarray


@pytest.fixture(scope="module")
def street() -> Street:
    mipmaps = corridor_mipmaps()

    def seen_from(z: float) -> Pair:
        T_left, T_right = np.eye(4), np.eye(4)
        T_left[2, 3] = T_right[2, 3] = z
        T_right[0, 3] = CAMERA.baseline
        return render(mipmaps, CAMERA, T_left), render(mipmaps, CAMERA, T_right)

    z = np.cumsum([0.0, *APPROACH, *DEPARTURE])
    pairs = [seen_from(one) for one in z]
    n = len(APPROACH)
    return Street(pairs[:n], pairs[n], pairs[n + 1 :], z)


@dataclass(frozen=True)
class Vehicle:
    """A textured rectangle that stands on the lower border of the image, 8 m away.

    Attributes:
        height: share of the image height.
        width: columns.
        starts, speed: its left column before it moves, and its motion to the right, pixels per
            frame.
        moves_at: number of frames at rest before it moves.
    """

    height: float
    speed: int
    width: int = LONG
    starts: int = DISPARITY - LONG
    moves_at: int = MOVES_AT

    def left_column(self, k: int) -> int:
        return self.starts + self.speed * max(0, k + 1 - self.moves_at)

    def covers(self, k: int) -> float:
        """Return the share of the left image that the vehicle covers in the frame k at rest."""
        first, end = self.left_column(k), self.left_column(k) + self.width
        columns = max(0, min(end, CAMERA.width) - max(first, 0))
        return self.height * columns / CAMERA.width

    def before(self, pair: Pair, k: int) -> Pair:
        rng = np.random.default_rng(3)
        shape = round(self.height * CAMERA.height), self.width
        texture = np.full(shape, 110.0)
        for block, contrast in ((4, 25.0), (12, 40.0), (40, 40.0)):
            rows, columns = (length // block + 1 for length in shape)
            grey = rng.uniform(-contrast, contrast, (rows, columns))
            texture += np.kron(grey, np.ones((block, block)))[: shape[0], : shape[1]]
        texture = np.clip(cv2.GaussianBlur(texture, (0, 0), 0.7), 0, 255).astype(np.uint8)
        images = []
        for image, column in zip(pair, (0, -DISPARITY), strict=True):
            column += self.left_column(k)
            first, end = max(column, 0), min(column + self.width, CAMERA.width)
            shown = image.copy()
            if end > first:
                shown[-shape[0] :, first:end] = texture[:, first - column : end - column]
            images.append(shown)
        return images[0], images[1]


def noisy(pair: Pair, k: int) -> Pair:
    """Add noise with a standard deviation of one grey value."""
    rng = np.random.default_rng(k)
    left, right = (
        np.clip(np.rint(image + rng.normal(0.0, 1.0, image.shape)), 0, 255).astype(np.uint8)
        for image in pair
    )
    return left, right


def at_rest(street: Street, vehicle: Vehicle, frames: int) -> list[Pair]:
    return [noisy(vehicle.before(street.rest, k), k) for k in range(frames)]


def up_rest_off(street: Street, vehicle: Vehicle, frames: int) -> tuple[list[Pair], np.ndarray]:
    """Return all pairs of a drive that rests for the given number of frames, and true ``(N, 3)``
    positions."""
    pairs = [*street.up, *at_rest(street, vehicle, frames), *street.off]
    z = np.insert(street.z, len(APPROACH), np.full(frames - 1, street.z[len(APPROACH)]))
    return [noisy(pair, 1000 + k) for k, pair in enumerate(pairs)], np.outer(z, [0.0, 0.0, 1.0])


def follow(slam: Slam, pairs: list[Pair], begin: int = 0) -> list[TrackResult]:
    """Track the pairs from the frame ``begin`` on, ten per second."""
    return [slam.step(*pairs[k], 0.1 * k) for k in range(begin, len(pairs))]


def new_slam(threads: int = 1) -> Slam:
    return Slam(CAMERA, Config(), "none", threads=threads)


def keyframes(results: list[TrackResult]) -> list[int]:
    return [result.index for result in results if result.is_keyframe]


def assert_in_one_part(slam: Slam, results: list[TrackResult]) -> None:
    slam.finish()
    assert slam.map.restarts == []
    assert {result.part for result in results} == {0}


def assert_lost_where_covered(results: list[TrackResult], vehicle: Vehicle) -> None:
    """``results`` are those of the frames at rest. A frame that is
    mostly covered may be lost, too."""
    for k, result in enumerate(results):
        if vehicle.covers(k) == 1.0:
            assert result.state == TrackingState.LOST
        if vehicle.covers(k) < 0.7:
            assert result.state == TrackingState.OK


def assert_stands(slam: Slam, results: list[TrackResult], vehicle: Vehicle) -> None:
    """Assert that a camera that stands from the first frame on is where it was, and knows it."""
    assert keyframes(results) == [0]
    assert_in_one_part(slam, results)
    positions = slam.trajectory().T_wc[:, :3, 3], np.array([r.T_wc[:3, 3] for r in results])
    for one in positions:
        assert np.linalg.norm(one, axis=1).max() < 0.02
    assert_lost_where_covered(results, vehicle)


@pytest.mark.parametrize(
    ("speed", "frames"), [(3, 35), pytest.param(12, 96, marks=pytest.mark.slow), (40, 38)]
)
@pytest.mark.parametrize("height", [1 / 3, 2 / 3, 1.0])
def test_a_vehicle_that_passes_a_standing_camera_does_not_move_it(street, height, speed, frames):
    vehicle = Vehicle(height, speed)
    if height < 1.0:
        frames = min(frames, 50)
    slam = new_slam()
    results = follow(slam, at_rest(street, vehicle, frames))
    assert_stands(slam, results, vehicle)


@pytest.mark.parametrize("speed", [3, 12, 40])
@pytest.mark.parametrize(("height", "width"), [(2 / 3, 320), (1.0, 250)])
def test_a_vehicle_that_was_at_rest_when_the_map_began_does_not_take_the_camera_along(
    street, height, width, speed
):
    """Most close landmarks of the map are those of the vehicle."""
    slam = new_slam()
    vehicle = Vehicle(height, speed, width, starts=CAMERA.width - width - 50)
    results = follow(slam, at_rest(street, vehicle, 25))
    assert_stands(slam, results, vehicle)


@pytest.mark.slow
@pytest.mark.parametrize(("height", "speed", "moves_at", "frames"), [
    (1.0, 40, 0, 36),
    (1.0, 40, 5, 38),
    (2 / 3, 12, 5, 40),
])  # fmt: skip
def test_a_camera_that_drove_up_stands_before_a_vehicle_and_drives_off(
    street, height, speed, moves_at, frames
):
    """The frame in which the camera is found to stand is the last one that may be a keyframe."""
    vehicle = Vehicle(height, speed, moves_at=moves_at)
    pairs, truth = up_rest_off(street, vehicle, frames)
    slam = new_slam()
    results = follow(slam, pairs)
    assert_in_one_part(slam, results)
    stands, leaves = len(APPROACH), len(APPROACH) + frames
    errors = np.linalg.norm(slam.trajectory().T_wc[:, :3, 3] - truth, axis=1)
    online = np.linalg.norm(np.array([r.T_wc[:3, 3] for r in results]) - truth, axis=1)
    assert errors[stands:leaves].max() < 0.02
    assert online[stands:leaves].max() < 0.02
    assert errors[leaves:].max() < 0.03
    made = keyframes(results)
    assert not any(stands + 1 < k < leaves for k in made)
    assert sum(k >= leaves for k in made) >= 2
    assert_lost_where_covered(results[stands:leaves], vehicle)
    assert all(result.state == TrackingState.OK for result in results[leaves:])


@pytest.fixture(scope="module")
def covered_drive(street) -> tuple[list[Pair], bytes]:
    """A vehicle of two thirds of the image height passes. Returns the pairs and the poses."""
    pairs, _ = up_rest_off(street, Vehicle(2 / 3, 40, moves_at=5), 25)
    slam = new_slam()
    follow(slam, pairs)
    slam.finish()
    return pairs, slam.trajectory().T_wc.tobytes()


@pytest.mark.slow
def test_two_threads_give_the_same_bytes(covered_drive):
    pairs, expected = covered_drive
    slam = new_slam(threads=2)
    follow(slam, pairs)
    slam.finish()
    assert slam.trajectory().T_wc.tobytes() == expected


@pytest.mark.slow
@pytest.mark.parametrize("cut", [len(APPROACH) + 4, len(APPROACH) + 15])
def test_a_run_that_is_resumed_at_a_standstill_gives_the_same_bytes(covered_drive, tmp_path, cut):
    pairs, expected = covered_drive
    slam = new_slam()
    follow(slam, pairs[:cut])
    stored = slam.stored_map()
    assert stored.checkpoint is not None
    assert stored.checkpoint.last.still is not None
    slam.save(tmp_path / "map.npz", resumable=True)
    again = Slam.load(tmp_path / "map.npz", Config(), "none", resume=True, threads=1)
    follow(again, pairs, cut)
    again.finish()
    assert again.trajectory().T_wc.tobytes() == expected


def test_an_imu_holds_a_standing_camera_before_a_lorry_that_stops_in_front_of_it(street):
    """Images tell that the camera stands, and the samples that it goes on to stand."""
    lorry = Vehicle(1.0, 40)
    pairs = at_rest(street, lorry, 26)
    covered = next(k for k in range(26) if lorry.covers(k) > 0.95)
    pairs[covered + 1 :] = [noisy(lorry.before(street.rest, covered), k) for k in range(60)]
    slam = Slam(CAMERA, Config(), "none", threads=1, imu=ImuCalibration(np.eye(4), ADIS16448))
    results = []
    for k, pair in enumerate(pairs):
        times = 0.1 * k + np.arange(-0.095, 0.001, 0.005)
        rows = np.column_stack([times, np.tile([0.0, 0.0, 0.0, 0.0, -GRAVITY, 0.0], (20, 1))])
        rng = np.random.default_rng(k)
        noise = np.repeat([ADIS16448.gyro, ADIS16448.accel], 3) / np.sqrt(0.005)
        rows[:, 1:] += noise * rng.standard_normal((20, 6)) + [0.01, -0.02, 0.05, 0.05, -0.1, 0.08]
        results.append(slam.step(*pair, 0.1 * k, imu=rows))
    slam.finish()
    moved = [np.linalg.norm(result.T_wc[:3, 3]) for result in results]
    assert max(moved) < 0.02
    lost = [result.state for result in results if result.state != TrackingState.OK]
    assert len(lost) > 40  # 4 s, longer than an IMU may carry a camera that moves
    assert set(lost) == {TrackingState.INERTIAL}
