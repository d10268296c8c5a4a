"""RGB-D: depth as a virtual right image, TUM's layout, and runs with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import StereoSequence, corridor_depth
from source_files import run_source

from vslam.cli.main import every_command
from vslam.config import Config, DepthConfig, KeyframeConfig
from vslam.datasets import open_sequence
from vslam.datasets.association import Pairing, associate
from vslam.datasets.frames import TimedFrame
from vslam.datasets.perturbation import Perturbation, parse_perturbation
from vslam.datasets.perturbation.laws import perturbed
from vslam.datasets.tum import open_tum
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.frontend.depth import columns_of_depth
from vslam.frontend.extraction import FrameImages
from vslam.frontend.keyframes import KeyframeEvidence, needs_keyframe
from vslam.maps.storage import load_map, save_map
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam
from vslam.support.errors import InputError, UnreadableImageError
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.trajectory import Trajectory, write_kitti, write_tum
from vslam_lab.towns.layouts import render_rgbd
from vslam_lab.towns.routes import built_in_route
from vslam_lab.towns.site import Variation

REAL = Path(__file__).parents[3] / "shared/data/tum/rgbd_dataset_freiburg1_desk"
SCALE = 1000.0
FRAMES = 16


def write_list(path: Path, times, folder: str) -> None:
    lines = [f"{t:.6f} {folder}/{t:.6f}.png\n" for t in times]
    path.write_text("".join(["# timestamp filename\n", *lines]))


@pytest.fixture(scope="module")
def tree(corridor: StereoSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of the corridor in TUM's layout.

    Depth is 3 ms late, and its unit is a thousandth of a metre.
    """
    root = tmp_path_factory.mktemp("tum") / "corridor"
    times = corridor.timestamps[:FRAMES]
    for name in ("rgb", "depth"):
        (root / name).mkdir(parents=True)
    for time, image, T_wc in zip(times, corridor.left, corridor.T_wc, strict=False):
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        assert cv2.imwrite(str(root / f"rgb/{time:.6f}.png"), colour)
        depth = np.rint(corridor_depth(corridor.camera, T_wc) * SCALE).astype(np.uint16)
        assert cv2.imwrite(str(root / f"depth/{time + 0.003:.6f}.png"), depth)
    write_list(root / "rgb.txt", times, "rgb")
    write_list(root / "depth.txt", times + 0.003, "depth")
    write_tum(root / "groundtruth.txt", Trajectory(corridor.timestamps, corridor.T_wc))
    c = corridor.camera
    (root / "calibration.yaml").write_text(
        f"left: {{lens: pinhole, size: [{c.width}, {c.height}], focal: [{c.fx}, {c.fy}], "
        f"centre: [{c.cx}, {c.cy}]}}\ndepth_scale: {SCALE}\nvirtual_baseline: {c.baseline}\n"
    )
    return root


@pytest.fixture
def copy(tree: Path, tmp_path: Path) -> Path:
    """A copy of the sequence whose files a test may damage."""
    root = tmp_path / "corridor"
    for path in tree.rglob("*"):
        if path.is_file():
            (root / path.relative_to(tree)).parent.mkdir(parents=True, exist_ok=True)
            (root / path.relative_to(tree)).write_bytes(path.read_bytes())
    return root


def refused(root: Path, *parts: str, **options) -> None:
    with pytest.raises(InputError) as caught:
        open_tum(root, "", **options)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(".")
    for part in parts:
        assert part in message


def run_on(tree: Path, *, threads: int = 1, **options) -> RunOutcome:
    sequence = open_tum(tree, "", **options)
    settings = RunOptions(detector="bow", threads=threads)
    return run_sequence(begin(sequence, settings), parse_perturbation("none", 0), Recorder())


def ate_of(outcome: RunOutcome) -> float:
    truth = Trajectory(outcome.sequence.timestamps, outcome.sequence.ground_truth)
    return evaluate_trajectory(outcome.trajectory, truth, outcome.alignment).ate_rmse_m


# Depth as a column


def test_columns_are_those_of_a_virtual_right_camera():
    camera = Camera(100.0, 100.0, 2.0, 1.0, 0.5, 4, 3, depth=True)
    depth = np.array([[1, 2, 5, 0], [10, 4, np.nan, 0.05], [50, 25, 200, 2]], np.float32)
    xy = np.array([[0, 0], [1.4, 0.6], [3, 0], [2, 1], [3, 1], [2, 2], [3.4, 2.4]], np.float32)
    found = columns_of_depth(xy, np.ones(7), depth, camera, DepthConfig(edge_radius=0))
    # fx b = 50: d = 1, then 4 at pixel (1, 1), unknown, NaN, too near, too far, then 2 at (3, 2).
    np.testing.assert_allclose(found[[0, 1, 6]], [0 - 50, 1.4 - 12.5, 3.4 - 25], rtol=1e-6)
    assert np.isnan(found[2:6]).all()


def test_features_without_depth_are_monocular(corridor):
    camera = replace(corridor.camera, depth=True)
    context = Context.create(camera, Config())
    depth = corridor_depth(camera, corridor.T_wc[0]).astype(np.float32)
    depth[:, :240] = 0.0
    extracted = FrameImages(corridor.left[0], lambda: depth, context).extracted
    features = extracted.features
    rows, columns = np.rint(features.xy).astype(int).T[::-1]
    known = np.isfinite(features.u_right)
    assert (depth[rows, columns][known] > 0).all()
    assert 100 < np.count_nonzero(known) < len(known) - 100
    found = camera.bf / (features.xy[known, 0] - features.u_right[known])
    np.testing.assert_allclose(found, depth[rows, columns][known], rtol=1e-3)


def test_added_features_get_their_depth_too(corridor):
    camera = replace(corridor.camera, depth=True)
    context = Context.create(camera, Config())
    depth = corridor_depth(camera, corridor.T_wc[0]).astype(np.float32)
    images = FrameImages(corridor.left[0], lambda: depth, context)
    xy = np.stack(np.meshgrid([101.0, 203.0, 301.0], [60.0, 90.0]), axis=-1).reshape(-1, 2)
    at = xy.astype(np.float32), np.zeros(len(xy), np.uint8)
    before, after = images.extracted.features, images.extracted_with(at).features
    assert len(after) > len(before)
    known = np.isfinite(after.u_right)
    rows, columns = np.rint(after.xy).astype(int).T[::-1]
    found = camera.bf / (after.xy[:, 0] - after.u_right)[known]
    np.testing.assert_allclose(found, depth[rows, columns][known], rtol=1e-3)


def test_features_have_no_depth_if_the_depth_image_cannot_be_read(corridor):
    def read_depth():
        raise UnreadableImageError(Path("depth.png"), "cannot be decoded; download it again.")

    context = Context.create(replace(corridor.camera, depth=True), Config())
    extracted = FrameImages(corridor.left[0], read_depth, context).extracted
    assert np.isnan(extracted.features.u_right).all()
    assert extracted.problem is not None


def test_a_corner_at_an_edge_of_depth_has_none():
    camera = Camera(100.0, 100.0, 20.0, 20.0, 0.5, 40, 40, depth=True)
    depth = np.full((40, 40), 2.0, np.float32)
    depth[:, 20:] = 2.3  # farther by 15 %
    depth[30:] = 2.1  # 5 % is no edge
    depth[0:4, 0:4] = 0.0  # unknown depth is no edge
    xy = np.array([[14, 9], [15, 9], [16, 9], [23, 9], [24, 9], [8, 33], [5, 5], [19, 9]])
    around = {radius: columns_of_depth(
        xy.astype(np.float32), np.ones(len(xy)), depth, camera, DepthConfig(edge_radius=radius)
    ) for radius in (0, 4)}  # fmt: skip
    assert np.isfinite(around[0]).all()
    assert np.isfinite(around[4]).tolist() == [1, 1, 0, 0, 1, 1, 1, 0]
    # A keypoint of a coarser octave has a larger patch.
    twice = columns_of_depth(
        xy.astype(np.float32), np.full(len(xy), 2.0), depth, camera, DepthConfig(edge_radius=4)
    )
    assert np.isfinite(twice).tolist() == [0, 0, 0, 0, 0, 1, 1, 0]


def test_a_step_takes_depth_in_metres_and_nothing_else(corridor):
    camera = replace(corridor.camera, depth=True)
    left = corridor.left[0]
    depth = corridor_depth(camera, corridor.T_wc[0]).astype(np.float32)
    with pytest.raises(ValueError, match="uint8 and uint8 instead of uint8 and float32"):
        Slam(camera).step(left, corridor.right[0], 0.0)
    with pytest.raises(ValueError, match=r"uint8 and uint16 instead of .* millimetres"):
        Slam(camera).step(left, depth.astype(np.uint16), 0.0)
    with pytest.raises(ValueError, match="but the camera's images have"):
        Slam(camera).step(left, depth[1:], 0.0)
    with pytest.raises(ValueError, match="the depth image is None"):
        Slam(camera).step(left, None, 0.0)
    with pytest.raises(ValueError, match="uint8 and float32 instead of uint8"):
        Slam(corridor.camera).step(left, depth, 0.0)
    assert Slam(camera).step(left, depth, 0.0).n_stereo > 100


def test_sensors_by_name(corridor):
    camera = replace(corridor.camera, depth=True)
    sensors = [c.sensor for c in (corridor.camera, camera, camera.left_camera())]
    assert sensors == ["stereo", "rgbd", "mono"]


def test_an_rgbd_camera_gets_keyframes_sooner():
    calm = KeyframeEvidence(0.5, 190, 200, 150, 200, True)
    config = KeyframeConfig(max_interval_s=1.0, depth_max_interval_s=0.5)
    assert not needs_keyframe(calm, config)
    assert needs_keyframe(calm, config, depth=True)
    assert not needs_keyframe(replace(calm, seconds_since_keyframe=0.49), config, depth=True)


def test_light_does_not_change_depth():
    grey, depth = np.full((8, 8), 100, np.uint8), np.full((8, 8), 2.5, np.float32)
    left, second = parse_perturbation("noise:2,blur", 0).apply(0, 0.0, grey, depth)
    assert (left != grey).any()
    assert second is depth
    frame = TimedFrame(0.0, lambda _: (grey, depth), (lambda: grey, lambda: depth))
    (apart,) = perturbed(iter([frame]), parse_perturbation("noise:2,blur", 0))
    np.testing.assert_array_equal(apart.sides[0](), left)
    assert apart.sides[1]() is depth


# TUM's layout


def test_association_takes_the_nearest_first_and_each_once():
    first = np.array([0.000, 0.010, 0.100, 0.200])
    second = np.array([0.008, 0.085, 0.110, 0.221])
    # 0.010 is paired with 0.008, so that 0.000 has no pair. 0.110 is nearer to 0.100 than 0.085.
    # 0.221 differs from 0.200 by more than 20 ms.
    a, b = associate(first, second, 0.02)
    assert (a.tolist(), b.tolist()) == ([1, 2], [0, 2])


def test_reads_a_sequence(tree, corridor):
    sequence = open_sequence("tum", tree.parent, "corridor", start=2, every=3)
    assert (sequence.dataset, sequence.name, len(sequence)) == ("tum", "corridor", 5)
    assert sequence.camera == replace(corridor.camera, depth=True)
    np.testing.assert_allclose(sequence.timestamps, corridor.timestamps[2:FRAMES:3])
    np.testing.assert_allclose(sequence.ground_truth, corridor.T_wc[2:FRAMES:3], atol=1e-6)
    left, depth = sequence.read(1)
    np.testing.assert_array_equal(left, corridor.left[5])
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, corridor_depth(corridor.camera, corridor.T_wc[5]), atol=6e-4)


def test_depth_scale_and_colour_alone(tree):
    metres = open_tum(tree, "").read(0)[1]
    np.testing.assert_allclose(open_tum(tree, "", depth_scale=500.0).read(0)[1], 2 * metres)
    alone = open_tum(tree, "", monocular=True)
    assert alone.camera.sensor == "mono"
    assert alone.read(0)[1] is None


def test_tums_cameras_are_known_by_the_folder(copy):
    (copy / "calibration.yaml").unlink()
    refused(copy, "camera is unknown", "freiburg1", "--calib")
    known = copy.rename(copy.with_name("rgbd_dataset_freiburg3_corridor"))
    refused(known, "TUM's camera freiburg3", "640x480", "480x160")


def test_sequences_are_found_by_name(tree):
    for root in (tree, tree.parent):
        assert open_tum(root).name == open_tum(root, "corridor").name == "corridor"
    with pytest.raises(InputError, match=r"--seq desk: .* is itself the sequence corridor"):
        open_tum(tree, "desk")
    with pytest.raises(InputError, match="desk: no such sequence; choose one with --seq: corridor"):
        open_tum(tree.parent, "desk")


def test_sparse_ground_truth_is_used_where_it_has_the_time_of_a_frame(copy, corridor):
    """There are 0.3 s between the poses, so that none can be interpolated."""
    known = np.arange(0, FRAMES, 3)
    times = corridor.timestamps
    write_tum(copy / "groundtruth.txt", Trajectory(times[known] + 0.004, corridor.T_wc[known]))
    source = open_tum(copy)
    truth = source.ground_truth
    assert np.flatnonzero(np.isfinite(truth).all((1, 2))).tolist() == known.tolist()
    np.testing.assert_allclose(truth[known], corridor.T_wc[known], atol=1e-8)
    assert not source.warnings


def test_ground_truth_in_another_unit_or_of_another_clock(copy, corridor):
    truth = np.loadtxt(copy / "groundtruth.txt")
    expected = open_tum(copy).ground_truth
    for unit, name in ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")):
        np.savetxt(copy / "groundtruth.txt", truth / [unit, *[1.0] * 7], fmt="%.6f")
        source = open_tum(copy)
        np.testing.assert_allclose(source.ground_truth, expected, atol=1e-5)
        assert (
            f"groundtruth.txt: the times of the ground truth are read as {name}"
            in (source.warnings[0])
        )
    np.savetxt(copy / "groundtruth.txt", truth + np.eye(8)[0] * 1e9, fmt="%.9f")
    source = open_tum(copy)
    assert source.ground_truth is None
    assert "covers none of the frames" in source.warnings[0]
    assert "add -1000000000.000 s to those of the poses" in source.warnings[0]
    write_kitti(copy / "groundtruth.txt", corridor.T_wc)
    refused(copy, "groundtruth.txt: the poses have no times", "remove the file")


def test_bad_input_of_tum(copy, tmp_path):
    refused(tmp_path / "nowhere", "no rgb.txt", "download")
    refused(copy, "--start 16", start=FRAMES)
    (copy / "groundtruth.txt").write_text("5000.0 0 0 0 0 0 0 1\n")
    assert open_tum(copy, "").ground_truth is None
    depth = (copy / "depth.txt").read_text().splitlines()
    (copy / "depth.txt").write_text("\n".join(reversed(depth)))
    refused(copy, "depth.txt: 15 of 16 times are not later", "correct them")
    (copy / "depth.txt").write_text("1.0 a.png\nsoon b.png\n")
    refused(copy, "depth.txt: line 2", "not a time")
    (copy / "depth.txt").write_text("1.0 a.png\n2.0 b.png\n")
    refused(copy, "within 20 ms", "--sensor mono")
    (copy / "depth.txt").unlink()
    refused(copy, "depth.txt", "missing", "--sensor mono")


def test_images_without_depth_are_counted(copy, caplog):
    lines = (copy / "depth.txt").read_text().splitlines()
    (copy / "depth.txt").write_text("\n".join(lines[:-1]))
    shorter = open_tum(copy, "")
    assert len(shorter) == FRAMES - 1
    (one,) = shorter.pairing.warnings()
    (copy / "depth.txt").write_text("\n".join(lines[:-4]))
    source = open_tum(copy, "", max_frames=3)
    (four,) = source.pairing.warnings()
    assert f"1 of {FRAMES} images are left out because no depth image is within 20 ms" in one
    assert f"{copy}: 4 of {FRAMES} images are left out because" in four
    assert "; correct the times in rgb.txt or depth.txt" in four
    assert run_source(source).warnings == [four]
    assert open_tum(copy, "", monocular=True).pairing is None
    assert not caplog.messages  # the summary of the run shows the warning


def test_few_images_without_a_partner_are_not_worth_a_warning(tmp_path):
    pairing = Pairing(tmp_path, "right image", 0.005, "correct the times")
    times = np.arange(100.0)
    pairing.count(times, np.arange(99), times[:99])
    assert pairing.warnings() == []
    assert not pairing.is_poor
    pairing.count(times, np.arange(89), times[:89] + 0.004)
    assert pairing.is_poor
    (said,) = pairing.warnings()
    assert said == (
        f"{tmp_path}: 11 of 100 images are left out because no right image is within 5 ms of them "
        "(the nearest is 5996 ms away); correct the times."
    )


def test_images_whose_depth_is_paired_with_another_image_are_counted_apart(copy):
    """Depth begins with the fourth image and has half of the rate.

    One depth image lies between the images 3 and 4, and is nearer to image 3.
    """
    times = [100.0, 100.1, 100.2, 100.3, 100.33]
    rgb, depth = (
        [line.split()[1] for line in (copy / f"{name}.txt").read_text().splitlines()
         if not line.startswith("#")]
        for name in ("rgb", "depth")
    )  # fmt: skip
    for name, stamps, files in (("rgb", times, rgb), ("depth", [100.314], depth)):
        lines = [f"{t} {file}\n" for t, file in zip(stamps, files, strict=False)]
        (copy / f"{name}.txt").write_text("".join(lines))
    said = open_tum(copy, "").pairing.measured
    assert said == (
        "4 of 5 images are left out, 3 because no depth image is within 20 ms of them (the nearest "
        "is 214 ms away), and 1 because each depth image is paired only once, with the image "
        "nearest in time"
    )
    (copy / "rgb.txt").write_text(
        "".join(f"{t} {f}\n" for t, f in zip(times[3:], rgb, strict=False))
    )
    assert open_tum(copy, "").pairing.measured == (
        "1 of 2 images are left out because each depth image is paired only once, with the image "
        "nearest in time"
    )


@pytest.mark.parametrize(
    ("image", "part"),
    [
        (np.zeros((160, 480), np.uint8), "8 bits"),
        (np.zeros((160, 480, 3), np.uint16), "3 channels"),
        (np.zeros((120, 480), np.uint16), "480x120 pixels but the colour image has 480x160"),
    ],
)
def test_depth_that_does_not_fit(copy, image, part):
    first, later = sorted((copy / "depth").iterdir())[:6:5]
    assert cv2.imwrite(str(later), image)
    with pytest.raises(UnreadableImageError, match=part):
        open_tum(copy, "").read(5)
    assert cv2.imwrite(str(first), image)
    refused(copy, first.name, part)
    first.write_bytes(b"")
    refused(copy, first.name, "empty")
    first.unlink()
    refused(copy, first.name, "no such file")


# Runs


@pytest.fixture(scope="module")
def outcome(tree: Path) -> RunOutcome:
    return run_on(tree)


def test_a_run_is_accurate(outcome):
    assert all(track.state == "OK" for track in outcome.tracks)
    assert outcome.n_submaps == 1
    assert ate_of(outcome) < 0.02  # of 5 m; stereo has 0.01


def test_depth_is_decoded_for_keyframes_and_frames_tracked_by_features_alone(tree):
    reads = []

    def counted(frame):
        def depth():
            reads.append(frame.timestamp)
            return frame.sides[1]()

        return replace(frame, sides=(frame.sides[0], depth))

    source = open_tum(tree, "")
    source = replace(source, stored=tuple(map(counted, source.stored)))
    settings = RunOptions(detector="none", threads=1)
    tracks = run_sequence(begin(source, settings), Perturbation("none"), Recorder()).tracks
    assert sorted(reads) == [track.timestamp for track in tracks if track.n_features]
    assert len(reads) < FRAMES / 2


def test_of_many_visible_landmarks_some_are_searched_for_evenly(corridor, monkeypatch):
    monkeypatch.setattr("vslam.frontend.patch_tracking._ENOUGH", 100)
    camera = replace(corridor.camera, depth=True)
    slam = Slam(camera, Config(), "none", threads=1)
    for k in range(4):
        depth = corridor_depth(camera, corridor.T_wc[k]).astype(np.float32)
        result = slam.step(corridor.left[k], depth, corridor.timestamps[k])
    view = slam._session.published.view
    assert view.patch_stride > 1
    assert view.with_patches.ids.tolist() == view.patches.ids[:: view.patch_stride].tolist()
    assert result.n_features == 0
    assert 50 < result.n_inliers < 150


def test_the_result_does_not_depend_on_the_threads(outcome, tree):
    again = run_on(tree, threads=2)
    assert again.trajectory.T_wc.tobytes() == outcome.trajectory.T_wc.tobytes()


def test_a_map_keeps_its_camera(outcome, tmp_path):
    save_map(tmp_path / "map.npz", outcome.stored)
    assert load_map(tmp_path / "map.npz").camera == outcome.sequence.camera


@pytest.mark.slow
def test_the_command_names_the_sensor(tree, tmp_path, capsys):
    def call(*words: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stopped:
            every_command()(
                ["run", "--data", str(tree), "--out", str(tmp_path), "--no-record", *words]
            )
        captured = capsys.readouterr()
        return int(stopped.value.code or 0), captured.out + captured.err

    code, _ = call("--max-frames", "4", "--threads", "1", "--sensor", "rgbd")
    assert code == 0
    (folder,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    report = (folder / "report.md").read_text()
    assert "rgbd" in report


@pytest.mark.slow
def test_rendered_rgbd(tmp_path):
    small = Camera(140.0, 140.0, 119.5, 39.5, 0.5, 240, 80)
    route = replace(built_in_route("demo"), camera=small)
    folder = render_rgbd(route, Variation(), tmp_path / "rgbd", until=2, threads=1)
    sequence = open_tum(folder, "")
    assert len(sequence) == 2
    assert sequence.camera == replace(small, depth=True)
    np.testing.assert_allclose(sequence.ground_truth, route.ground_truth[:2], atol=1e-6)
    left, depth = sequence.read(1)
    (twin,) = (folder / "stereo").rglob("image_0/000001.png")
    np.testing.assert_array_equal(left, cv2.imread(str(twin), cv2.IMREAD_GRAYSCALE))
    # The road below the camera: its depth is that of a plane at the camera's height.
    road = small.fy * 1.65 / (np.arange(72, 80) - small.cy)
    assert np.median(abs(depth[72:80, 110:130] / road[:, None] - 1)) < 0.1


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="TUM sample absent")
def test_real_sample():
    whole = open_tum(REAL, "")
    assert len(whole) == 573
    assert whole.camera.sensor == "rgbd"
    outcome = run_on(REAL, max_frames=60, threads=2)
    assert all(track.state == "OK" for track in outcome.tracks)
    assert ate_of(outcome) < 0.02
