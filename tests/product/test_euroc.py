"""The reader of EuRoC's layout: pairs, ground truth, rectification and invalid input."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import StereoSequence
from scipy.spatial.transform import Rotation

from vslam.datasets import open_sequence
from vslam.datasets.association import poses_at
from vslam.datasets.euroc import _pair, open_euroc, open_raw_euroc
from vslam.datasets.imu import ImuFeed
from vslam.datasets.perturbation import Perturbation
from vslam.run.options import RunOptions
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam
from vslam.support.errors import InputError, UnreadableImageError
from vslam.types.features import TrackingState
from vslam.types.geometry import se3_exp
from vslam.types.trajectory import Trajectory

REAL = Path(__file__).parents[3] / "shared/data/euroc/V1_01_start"
FRAMES = 6
START = 1403715273262142976
STEP = 100_000_000  # ns
T_BODY_LEFT = se3_exp(np.array([0.3, -0.2, 0.1, 0.1, 0.2, 1.5]))


def numbers(array) -> str:
    return ", ".join(repr(float(x)) for x in np.ravel(array))


def sensor(T: np.ndarray, camera) -> str:
    return (
        f"%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers(T)}]\n"
        f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{camera.fx}, {camera.fy}, {camera.cx}, {camera.cy}]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )


@pytest.fixture
def root(corridor: StereoSequence, tmp_path: Path) -> Path:
    """The beginning of the corridor in EuRoC's layout.

    Right images are 1 ms late. The ground truth is the pose of the body.
    """
    base = tmp_path / "V9_01" / "mav0"
    T_left_right = np.eye(4)
    T_left_right[0, 3] = corridor.camera.baseline
    for side, (images, T) in enumerate(
        ((corridor.left, T_BODY_LEFT), (corridor.right, T_BODY_LEFT @ T_left_right))
    ):
        (base / f"cam{side}/data").mkdir(parents=True)
        lines = ["#timestamp [ns],filename\r\n"]
        for k in range(FRAMES):
            stamp = START + k * STEP + side * 1_000_000
            assert cv2.imwrite(str(base / f"cam{side}/data/{stamp}.png"), images[k])
            lines.append(f"{stamp},{stamp}.png\r\n")
        (base / f"cam{side}/data.csv").write_text("".join(lines))
        (base / f"cam{side}/sensor.yaml").write_text(sensor(T, corridor.camera))
    (base / "state_groundtruth_estimate0").mkdir()
    rows = ["#timestamp, p_RS_R_x [m], ...\n"]
    for k, T in enumerate(corridor.T_wc[:FRAMES]):
        T_wb = T @ np.linalg.inv(T_BODY_LEFT)
        q = Rotation.from_matrix(T_wb[:3, :3]).as_quat(scalar_first=True)
        rows.append(f"{START + k * STEP},{numbers(T_wb[:3, 3])},{numbers(q)},0,0,0\n")
    (base / "state_groundtruth_estimate0/data.csv").write_text("".join(rows))
    return tmp_path


def refused(root: Path, *parts: str, **options) -> None:
    with pytest.raises(InputError) as caught:
        open_euroc(root, "V9_01", **options)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    for part in parts:
        assert part in message


def drop_lines(path: Path, keep) -> None:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for k, line in enumerate(lines) if keep(k)))


def test_reads_a_sequence(root, corridor):
    sequence = open_sequence("euroc", root, "V9_01")
    assert (sequence.dataset, sequence.name, len(sequence)) == ("euroc", "V9_01", FRAMES)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.1, atol=1e-6)
    assert sequence.timestamps[0] == pytest.approx(START * 1e-9, abs=1e-6)
    assert sequence.camera.baseline == pytest.approx(0.5)
    left, right = sequence.read(3)
    np.testing.assert_array_equal(left, corridor.left[3])
    np.testing.assert_array_equal(right, corridor.right[3])
    np.testing.assert_allclose(sequence.ground_truth, corridor.T_wc[:FRAMES], atol=1e-9)


@pytest.mark.parametrize("name", [None, "V9_01"])
@pytest.mark.parametrize("inner", ["", "V9_01", "V9_01/mav0"])
def test_the_folder_itself_can_be_named(root, inner, name):
    sequence = open_euroc(root / inner, name)
    assert (sequence.name, len(sequence)) == ("V9_01", FRAMES)


@pytest.mark.parametrize("inner", ["V9_01", "V9_01/mav0"])
def test_the_folder_of_another_sequence_is_refused(root, inner):
    with pytest.raises(InputError, match=r"--seq MH_05: .* is itself the sequence V9_01; leave"):
        open_euroc(root / inner, "MH_05")


def test_one_of_several_sequences_must_be_named(root):
    (root / "V9_02").symlink_to(root / "V9_01")
    with pytest.raises(InputError, match="several sequences; choose one with --seq: V9_01, V9_02"):
        open_euroc(root)


def test_selection_and_the_left_camera_alone(root, corridor):
    sequence = open_euroc(root, "V9_01", start=1, every=2, max_frames=2, monocular=True)
    assert len(sequence) == 2
    assert sequence.camera.monocular
    left, right = sequence.read(1)
    np.testing.assert_array_equal(left, corridor.left[3])
    assert right is None
    np.testing.assert_allclose(sequence.ground_truth, corridor.T_wc[[1, 3]], atol=1e-9)


def test_frames_without_a_partner_are_left_out(root, corridor, caplog):
    drop_lines(root / "V9_01/mav0/cam1/data.csv", lambda k: k not in (1, 4, 6))
    sequence = open_euroc(root, "V9_01")
    assert len(sequence) == 3
    assert not caplog.messages
    (said,) = sequence.pairing.warnings()
    assert said.startswith(f"{root / 'V9_01/mav0'}: 3 of 6 images are left out because no right ")
    assert "restore the missing images" in said
    assert open_raw_euroc(root).pairing.warnings() == [said]
    np.testing.assert_array_equal(sequence.read(2)[0], corridor.left[4])
    np.testing.assert_array_equal(sequence.read(2)[1], corridor.right[4])
    np.testing.assert_allclose(sequence.ground_truth, corridor.T_wc[[1, 2, 4]], atol=1e-9)


@pytest.mark.parametrize(("late", "paired"), [(5_000_000, 6), (5_000_001, 5)])
def test_partners_are_at_most_five_milliseconds_apart(late, paired):
    times = 1_403_715_273_262_142_976 + 50_000_000 * np.arange(6)
    right = times + np.where(np.arange(6) == 3, late, 0)
    assert len(_pair([Path("cam0"), Path("cam1")], [times, right])) == paired


def test_partners_of_a_fast_camera_are_nearer_than_the_next_frame():
    times = 1_403_715_273_262_142_976 + 5_000_000 * np.arange(60)
    sides = [np.delete(times, 12), np.delete(times, 38)]
    paired = _pair([Path("cam0"), Path("cam1")], sides)
    assert np.array_equal(sides[0][paired[:, 0]], sides[1][paired[:, 1]])
    assert len(paired) == 58


def test_a_constant_difference_between_the_clocks(root):
    path = root / "V9_01/mav0/cam1/data.csv"
    lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
    late = [f"{int(stamp) + 8_000_000},{name}" for stamp, name in lines]
    path.write_text("\n".join(["#timestamp [ns],filename", *late]))
    sequence = open_euroc(root, "V9_01")
    assert len(sequence) == FRAMES
    (said,) = sequence.pairing.warnings()
    assert "the times of the right images are 0.009 s later than those of their images" in said


def test_a_right_image_is_the_partner_of_one_left_image():
    left = 1_403_715_273_262_142_976 + 4_000_000 * np.arange(3)
    paired = _pair([Path("cam0"), Path("cam1")], [left, left[1:2] + 1_000_000])
    assert paired.tolist() == [[1, 0]]  # the nearest one


def test_no_partners_at_all(root):
    path = root / "V9_01/mav0/cam1/data.csv"
    path.write_text(path.read_text().replace("14037", "15037"))
    refused(root, "none of its 6 images has the time of an image")


def test_ground_truth_of_some_frames(root, corridor):
    path = root / "V9_01/mav0/state_groundtruth_estimate0/data.csv"
    drop_lines(path, lambda k: k not in (1, 2))
    found = open_euroc(root, "V9_01").ground_truth
    assert np.isnan(found[:2]).all()
    np.testing.assert_allclose(found[2:], corridor.T_wc[2:FRAMES], atol=1e-9)
    path.write_text(path.read_text().replace("14037", "15037"))
    source = open_euroc(root, "V9_01")
    assert source.ground_truth is None
    assert "covers none of the frames: the times of the frames are from" in source.warnings[0]
    path.unlink()
    assert open_euroc(root, "V9_01").ground_truth is None


def test_ground_truth_between_measurements():
    """Poses are interpolated, but not in a gap or beyond the ends, where one frame has a pose."""
    T_wc = np.tile(np.eye(4), (4, 1, 1))
    T_wc[:, 0, 3] = 0.0, 1.0, 2.0, 3.0
    T_wc[1, :3, :3] = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix()
    measured = Trajectory(np.array([0.0, 0.1, 0.2, 0.6]), T_wc)
    times = np.array([-0.01, 0.0, 0.05, 0.2, 0.3, 0.595, 0.599, 0.7])
    found, interpolated = poses_at(measured, times)
    missing = [True, False, False, False, True, True, False, True]
    assert np.isnan(found).all((1, 2)).tolist() == missing
    assert np.flatnonzero(interpolated).tolist() == [2]
    np.testing.assert_array_equal(found[[1, 3, 6]], T_wc[[0, 2, 3]])
    np.testing.assert_allclose(found[2, :3, 3], [0.5, 0.0, 0.0])
    np.testing.assert_allclose(Rotation.from_matrix(found[2, :3, :3]).as_rotvec(), [0.0, 0.1, 0.0])


def test_a_calibration_of_ones_own(root, corridor):
    c = corridor.camera
    one = f"{{focal: [{c.fx}, {c.fy}], centre: [{c.cx}, {c.cy}], distortion: [-0.1, 0, 0, 0]}}"
    path = root / "own.yaml"
    path.write_text(f"left: {one}\nright: {one}\nbaseline: 0.4\n")
    sequence = open_euroc(root, "V9_01", calib=[path])
    assert sequence.camera.baseline == 0.4
    assert not np.array_equal(sequence.read(0)[0], corridor.left[0])
    path.write_text(f"left: {one[:-1]}, size: [640, 480]}}\nright: {one}\nbaseline: 0.4\n")
    refused(root, "own.yaml", "made for 640x480 pixels but the images have 480x160", calib=[path])


def test_own_calibration_replaces_the_missing_one(root):
    missing, own = root / "V9_01/mav0/cam0/sensor.yaml", root / "own.yaml"
    missing.rename(own)
    sequence = open_euroc(root, "V9_01", calib=[own, root / "V9_01/mav0/cam1/sensor.yaml"])
    assert sequence.ground_truth is None
    assert f"the ground truth is not used because there is no {missing}" in sequence.warnings[0]


def test_swapped_cameras(root):
    base = root / "V9_01/mav0"
    left, right = base / "cam0/sensor.yaml", base / "cam1/sensor.yaml"
    text = left.read_text()
    left.write_text(right.read_text())
    right.write_text(text)
    refused(root, "to the left of the left one; swap")


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("cam0/data.csv", "#\n", "empty"),
        ("cam0/data.csv", "5\n", "line 1 is not a time in nanoseconds and a file name"),
        ("cam0/data.csv", "6,a.png\n6,b.png\n", "1 of 2 times are not later"),
        ("cam0/data.csv", "9223372036854775808,a.png\n", "line 1 is not a time in nanoseconds"),
        ("cam1/data.csv", None, "left camera alone with --sensor mono"),
        ("cam0/sensor.yaml", None, "the calibration is missing"),
        ("state_groundtruth_estimate0/data.csv", "5,1,2\n", "line 1 has 3 numbers"),
        ("state_groundtruth_estimate0/data.csv", "", "is empty"),
    ],
)
def test_damaged_files(root, file, text, words):
    path = root / "V9_01/mav0" / file
    path.unlink()
    if text is not None:
        path.write_text(text)
    refused(root, path.name, words)


def test_missing_data_and_images(root):
    refused(root / "none", "holds no data in EuRoC's layout", "--data")
    with pytest.raises(InputError, match="choose one with --seq: V9_01"):
        open_euroc(root, "V9_02")
    images = sorted((root / "V9_01/mav0/cam1/data").iterdir())
    images[2].write_bytes(b"no image")
    sequence = open_euroc(root, "V9_01")
    with pytest.raises(UnreadableImageError, match="cannot be decoded"):
        sequence.read(2)
    shutil.copy(images[2], images[0])
    with pytest.raises(UnreadableImageError, match="cannot be decoded"):
        open_euroc(root, "V9_01")
    images[3].unlink()
    refused(root, images[3].name, "no such file")


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="EuRoC clip absent")
def test_the_real_vehicle_stands_still_through_the_dark_by_its_imu():
    """At rest, the IMU starts without motion, and a second without images moves nothing."""
    sequence = open_euroc(REAL, "", max_frames=60)
    assert sequence.imu is not None
    rest, camera = ImuFeed(sequence.imu), sequence.camera
    slam = Slam(camera, detector="none", threads=1, imu=sequence.imu.calibration)
    results = []
    for k, frame in enumerate(sequence.frames()):
        left, right = frame.read(map)
        light = np.uint8(not 35 <= k < 55)
        samples = rest.until(frame.timestamp)
        results.append(slam.step(light * left, light * right, frame.timestamp, imu=samples))
    slam.finish()
    assert {result.state for result in results[35:55]} == {TrackingState.INERTIAL}
    moved = [np.linalg.norm(result.T_wc[:3, 3]) for result in results]
    assert max(moved) < 0.05
    assert np.linalg.norm(results[-1].gravity) == pytest.approx(9.81)


@pytest.mark.skipif(not REAL.is_dir(), reason="EuRoC clip absent")
def test_the_real_vehicle_stands_still():
    sequence = open_euroc(REAL, "", start=21, max_frames=25)
    assert sequence.ground_truth is not None
    outcome = run_sequence(
        begin(sequence, RunOptions(detector="none")), Perturbation("none"), Recorder()
    )
    moved = np.linalg.norm(outcome.trajectory.T_wc[:, :3, 3], axis=1)
    assert moved.max() < 0.005
