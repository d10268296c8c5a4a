"""The whole pipeline on a rendered corridor: accuracy, determinism, and typical faults in cars."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection

import numpy as np
import pytest
from parts import InstantWorkers

from vslam.backend import local_mapping
from vslam.backend.local_mapping import local_window
from vslam.config import Config, KeyframeConfig, OrbConfig, TrackingConfig
from vslam.datasets.kitti import open_kitti
from vslam.loopclosure.detector import NoDetector
from vslam.slam import Slam
from vslam.types.features import TrackResult
from vslam.types.geometry import inverse, se3_log
from vslam.types.map import Map
from vslam.types.map_kernels import detach_keyframe

ORB = OrbConfig(n_features=800)
CONFIG = Config(orb=ORB)
# With a keyframe at every frame, mapping and merging never pause.
EAGER = Config(orb=ORB, keyframes=KeyframeConfig(max_interval_s=0.05))


def run(
    sequence,
    config: Config = CONFIG,
    *,
    threads: int = 1,
    frames: Iterable[int] | None = None,
    black: Iterable[int] = (),
    left_black: Iterable[int] = (),
    skipped: Iterable[int] = (),
) -> tuple[Slam, list[TrackResult]]:
    slam = Slam(sequence.camera, config, "none", threads=threads)
    results = []
    nothing = np.zeros_like(sequence.left[0])
    for k in range(len(sequence)) if frames is None else frames:
        if k in skipped:
            results.append(slam.skip(sequence.timestamps[k]))
            continue
        dark = k in black
        left = nothing if dark or k in left_black else sequence.left[k]
        right = nothing if dark else sequence.right[k]
        results.append(slam.step(left, right, sequence.timestamps[k]))
    slam.finish()
    return slam, results


def position_errors(slam: Slam, sequence, frames=slice(None)) -> np.ndarray:
    """Return the position errors in metres, in the world frame of the first frame."""
    return np.linalg.norm(slam.trajectory().T_wc[:, :3, 3] - sequence.T_wc[frames, :3, 3], axis=1)


def rmse(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


def states(results: list[TrackResult]) -> str:
    """Return the state of each frame as one letter: O, W or L."""
    return "".join(result.state[0] for result in results)


def bytes_of(slam: Slam, results: list[TrackResult]) -> bytes:
    online = np.array([r.T_wc for r in results])
    counts = np.array([[r.n_matches, r.n_inliers, r.is_keyframe] for r in results])
    keyframes = slam.keyframe_trajectory()
    landmarks = slam.map.arrays.xyz[slam.map.living_landmarks()]
    return b"".join(
        np.ascontiguousarray(x).tobytes()
        for x in (slam.trajectory().T_wc, online, counts, keyframes.T_wc, landmarks)
    )


def test_tracks_every_frame_to_centimetres(corridor, check_map):
    slam, results = run(corridor)
    assert states(results) == "O" * len(corridor)
    errors = position_errors(slam, corridor)
    assert rmse(errors) < 0.04
    assert errors.max() < 0.08
    for T, truth in zip(slam.trajectory().T_wc, corridor.T_wc, strict=True):
        assert np.abs(se3_log(T @ inverse(truth))[3:]).max() < 0.006
    check_map(slam.map)


def test_frames_whose_left_image_is_black_are_lost_and_nothing_else(corridor, check_map):
    dark = range(10, 13)
    slam, results = run(corridor, EAGER, left_black=dark)
    assert states(results) == "O" * 10 + "LLL" + "O" * 15
    assert not any(results[k].n_features for k in dark)
    assert slam.rig.sides.n_black_left == len(dark)
    assert position_errors(slam, corridor)[13:].max() < 0.08
    check_map(slam.map)


@pytest.mark.parametrize(
    ("threads", "said"), [(1, "every frame was tracked"), (2, "create it after the fork")]
)
def test_a_fork_tracks_with_one_thread_and_is_refused_with_more(corridor, threads, said):
    """In a fork, no thread would work on the copy of the map. The fork would wait forever."""
    slam = Slam(corridor.camera, EAGER, "none", threads=threads)

    def go_on(frames: range) -> None:
        for k in frames:
            slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])

    def child(told: Connection) -> None:
        try:
            go_on(range(6, 12))
            told.send("every frame was tracked")
        except RuntimeError as error:
            told.send(str(error))

    go_on(range(6))
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=child, args=(there,))
    process.start()
    try:
        assert here.poll(30), "the child hangs"
        assert said in here.recv()
    finally:
        process.kill()
        process.join()
    go_on(range(6, 12))  # the map of the parent has not changed


def test_results_account_for_every_frame(corridor):
    slam, results = run(corridor)
    assert [r.index for r in results] == list(range(len(corridor)))
    np.testing.assert_array_equal([r.timestamp for r in results], corridor.timestamps)
    np.testing.assert_array_equal(slam.trajectory().timestamps, corridor.timestamps)
    for r in results:
        assert 30 <= r.n_inliers <= r.n_matches
        if r.n_features:
            assert 100 < r.n_stereo <= r.n_features
        assert np.abs(r.T_wc[:3, :3] @ r.T_wc[:3, :3].T - np.eye(3)).max() < 1e-12


def test_keyframes_are_few_and_lie_on_the_trajectory(corridor):
    slam, results = run(corridor)
    made = [r.index for r in results if r.is_keyframe]
    assert made[0] == 0
    assert 4 <= len(made) <= 14
    assert slam.map.frames.tolist() == made
    living = slam.map.living_keyframes()
    keyframes, trajectory = slam.keyframe_trajectory(), slam.trajectory()
    frames = slam.map.frames[living]
    np.testing.assert_array_equal(keyframes.timestamps, corridor.timestamps[frames])
    np.testing.assert_allclose(keyframes.T_wc, trajectory.T_wc[frames], rtol=0, atol=1e-12)


def test_landmarks_lie_on_the_walls_and_the_ground(corridor):
    slam, _ = run(corridor)
    x, y, z = slam.map.arrays.xyz[slam.map.living_landmarks()].T
    assert len(x) > 500
    distance = np.min([np.abs(y - 1.5), np.abs(x + 4.0), np.abs(x - 4.5), np.abs(z - 32.0)], axis=0)
    assert np.median(distance) < 0.08  # metres; far points of coarse octaves are included
    assert np.mean(distance < 0.3) > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, EAGER], ids=["usual", "a keyframe each frame"])
def test_same_bytes_with_one_thread_and_two_and_again(corridor, config):
    runs = [bytes_of(*run(corridor, config, threads=threads)) for threads in (1, 2, 2, 1)]
    assert len(set(runs)) == 1


def test_two_in_threads_of_their_own_have_the_bytes_of_one(corridor):
    expected = bytes_of(*run(corridor))
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(lambda: bytes_of(*run(corridor, threads=2))) for _ in range(2)]
        assert [one.result() for one in both] == [expected] * 2


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, EAGER], ids=["usual", "a keyframe each frame"])
def test_tracking_sees_nothing_of_mapping_before_it_is_published(corridor, config, monkeypatch):
    """Mapping runs as early or as late as possible. A race would lead to different results."""
    late = bytes_of(*run(corridor, config, threads=1))
    monkeypatch.setattr("vslam.slam.Workers", InstantWorkers)
    assert bytes_of(*run(corridor, config, threads=2)) == late


@pytest.mark.slow
def test_tracking_of_one_camera_sees_nothing_of_mapping_before_it_is_published(
    corridor, monkeypatch
):
    """Mapping also aligns what keyframes observed, whose patches tracking reads."""

    def drive(threads: int) -> bytes:
        slam = Slam(corridor.camera.left_camera(), CONFIG, "none", threads=threads)
        results = [
            slam.step(left, None, timestamp)
            for left, timestamp in zip(corridor.left, corridor.timestamps, strict=True)
        ]
        slam.finish()
        assert slam.map.n_keyframes > 5
        return bytes_of(slam, results)

    late = drive(1)
    assert drive(2) == late
    monkeypatch.setattr("vslam.slam.Workers", InstantWorkers)
    assert drive(2) == late


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, EAGER], ids=["usual", "a keyframe each frame"])
@pytest.mark.parametrize("dark", [(), range(9, 14)])
def test_dropping_culled_landmarks_changes_no_byte(corridor, config, dark, monkeypatch, check_map):
    sizes, bytes_ = [], []
    for drop in (False, True):
        monkeypatch.setattr(Map, "many_culled_landmarks", drop)
        slam, results = run(corridor, config, black=dark)
        check_map(slam.map)
        sizes.append(slam.map.n_landmarks)
        bytes_.append(bytes_of(slam, results))
    assert sizes[1] < 0.9 * sizes[0]
    assert bytes_[1] == bytes_[0]


def test_the_pose_is_known_before_a_frame_becomes_a_keyframe(corridor):
    slam = Slam(corridor.camera, EAGER, "none", threads=1)
    known = []

    def note(result):
        known.append((result, slam._session.published.n_keyframes))

    results = [
        slam.step(left, right, timestamp, on_pose=note)
        for left, right, timestamp in zip(
            corridor.left[:6], corridor.right[:6], corridor.timestamps[:6], strict=True
        )
    ]
    assert [n for _, n in known] == [1, 1, 2, 3, 4, 5]  # keyframes published so far
    for (first, _), result in zip(known[1:], results[1:], strict=True):
        assert (first.is_keyframe, result.is_keyframe) == (False, True)
        # The insertion publishes the previous keyframe, which may move the frame slightly.
        np.testing.assert_allclose(first.T_wc, result.T_wc, atol=0.02)


def test_the_map_cannot_be_read_while_a_keyframe_is_mapped(corridor):
    slam = Slam(corridor.camera, EAGER, "none", threads=1)
    for k in range(2):
        slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
    assert slam.is_mapping
    with pytest.raises(RuntimeError, match=r"finish\(\) first"):
        _ = slam.map
    slam.finish()
    assert not slam.is_mapping
    assert slam.map.n_keyframes == 2


@pytest.mark.slow
def test_map_stays_sound_with_a_keyframe_each_frame(corridor, check_map):
    """Two landmarks are fused that the current frame tracks."""
    slam, results = run(corridor, EAGER)
    assert all(r.is_keyframe for r in results)
    assert states(results) == "O" * len(corridor)
    check_map(slam.map)
    assert rmse(position_errors(slam, corridor)) < 0.04


def test_counters_of_landmarks_stay_in_order(corridor):
    slam, _ = run(corridor)
    a, living = slam.map.arrays, slam.map.living_landmarks()
    assert (a.found[living] >= 1).all()
    assert a.visible[living].max() > 10
    assert np.mean(a.found[living] <= a.visible[living]) > 0.99


# -- faults ---------------------------------------------------------------------------------------


def test_black_frames_are_lost_at_the_predicted_pose_and_tracking_recovers(corridor):
    dark = range(12, 15)
    slam, results = run(corridor, black=dark)
    assert states(results) == "O" * 12 + "LLL" + "O" * 13
    for k in dark:
        assert (results[k].n_features, results[k].n_inliers, results[k].is_keyframe) == (
            0,
            0,
            False,
        )
    # The camera moves by 0.35 m per frame along a gentle curve.
    np.testing.assert_allclose(
        [r.T_wc[:3, 3] for r in results[12:15]], corridor.T_wc[12:15, :3, 3], rtol=0, atol=0.15
    )
    errors = position_errors(slam, corridor)
    assert errors[12:15].max() < 0.15
    assert rmse(errors[15:]) < 0.06


@pytest.mark.parametrize("after", [0, 1, 2])
def test_a_black_frame_soon_after_a_keyframe_does_not_move_the_frame_before(corridor, after):
    """The result of mapping is published before, at or after the black frame."""
    _, plain = run(corridor)
    keyframe = next(r.index for r in plain if r.is_keyframe and r.index > 10)
    slam = Slam(corridor.camera, CONFIG, "none", threads=1)
    nothing = np.zeros_like(corridor.left[0])
    black = keyframe + 1 + after
    for k in range(black):
        slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
    last = slam.frame
    for k in (black, black + 1):  # two frames, so that it is published
        slam.step(nothing, nothing, corridor.timestamps[k])
    assert slam.frame.index == last.index == black - 1
    slam.finish()
    expected = inverse(slam.trajectory().T_wc[black - 1])
    np.testing.assert_allclose(slam.frame.T_cw, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("young", "lost"), [(0, 4), (20, 1)])
def test_lost_for_long_mapping_restarts_at_the_predicted_pose(corridor, check_map, young, lost):
    """If the map has only just begun, mapping restarts after one lost frame."""
    tracking = TrackingConfig(lost_frames_before_restart=4, young_keyframes=young)
    config = Config(orb=ORB, tracking=tracking)
    # From frame 10, the images of the corridor are in reverse order and upside down, so that
    # nothing can be recognised.
    frames = list(range(20))
    slam = Slam(corridor.camera, config, "none", threads=1)
    results = []
    for k in frames:
        left, right = corridor.left[k], corridor.right[k]
        if k >= 10:
            left, right = (np.ascontiguousarray(i[::-1]) for i in (left, right))
        results.append(slam.step(left, right, corridor.timestamps[k]))
    slam.finish()
    assert states(results[:10]) == "O" * 10
    assert states(results[10:]) == "L" * lost + "O" * (10 - lost)
    assert [r.is_keyframe for r in results[10 : 10 + lost]] == [False] * (lost - 1) + [True]
    T_wc = slam.trajectory().T_wc
    # The motion is still 0.35 m per frame, relative to the prediction.
    steps = np.linalg.norm(np.diff(T_wc[9 + lost :, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.35, rtol=0, atol=0.05)
    check_map(slam.map)


def test_a_blackout_to_the_end_makes_no_keyframe(corridor):
    slam, results = run(corridor, black=range(8, 28))
    assert states(results) == "O" * 8 + "L" * 20
    assert not any(r.is_keyframe for r in results[8:])
    assert slam.map.n_keyframes == sum(r.is_keyframe for r in results)
    assert np.isfinite(slam.trajectory().T_wc).all()


def test_starts_with_the_first_frame_that_shows_something(corridor):
    slam, results = run(corridor, black=range(3))
    assert states(results) == "LLL" + "O" * 25
    assert [r.is_keyframe for r in results[:4]] == [False, False, False, True]
    T_wc = slam.trajectory().T_wc
    np.testing.assert_array_equal(T_wc[:4], np.tile(np.eye(4), (4, 1, 1)))
    relative = inverse(corridor.T_wc[3]) @ corridor.T_wc[-1]
    assert np.linalg.norm(T_wc[-1, :3, 3] - relative[:3, 3]) < 0.1


@pytest.mark.parametrize("first", [0, 2])
def test_a_start_at_speed_is_tracked_by_far_points(corridor, check_map, first):
    """The camera moves 2.8 m per frame, so that near points leave the view at once."""
    frames = range(first, 28, 8)
    slam, results = run(corridor, frames=frames)
    assert states(results) == "O" * len(frames)
    relative = inverse(corridor.T_wc[first]) @ corridor.T_wc[list(frames)]
    assert np.abs(slam.trajectory().T_wc[:, :3, 3] - relative[:, :3, 3]).max() < 0.1
    check_map(slam.map)


def test_far_points_are_mapped_only_where_a_start_fails(corridor):
    slam, _ = run(corridor, frames=range(0, 28, 4))
    first = slam.map.arrays.first_keyframe[: slam.map.n_landmarks] == 0
    assert np.linalg.norm(slam.map.arrays.xyz[: slam.map.n_landmarks][first], axis=1).max() < 30.0
    fast, _ = run(corridor, frames=range(0, 28, 8))
    first = fast.map.arrays.first_keyframe[: fast.map.n_landmarks] == 0
    assert np.linalg.norm(fast.map.arrays.xyz[: fast.map.n_landmarks][first], axis=1).max() > 30.0


def test_nothing_but_darkness(corridor):
    slam, results = run(corridor, frames=range(12), black=range(12))
    assert states(results) == "L" * 12
    np.testing.assert_array_equal(slam.trajectory().T_wc, np.tile(np.eye(4), (12, 1, 1)))
    assert len(slam.keyframe_trajectory()) == 0


def test_skipped_frames_are_lost_at_the_predicted_pose(corridor):
    slam, results = run(corridor, skipped=[9, 17, 18])
    assert [i for i, s in enumerate(states(results)) if s == "L"] == [9, 17, 18]
    assert [r.index for r in results] == list(range(28))
    for k in (9, 17, 18):
        assert (results[k].n_features, results[k].is_keyframe) == (0, False)
        assert results[k].timestamp == corridor.timestamps[k]
    assert position_errors(slam, corridor).max() < 0.12
    np.testing.assert_array_equal(slam.trajectory().timestamps, corridor.timestamps)


@pytest.mark.parametrize("skipped", [[0], [0, 1], range(5)])
def test_skipping_before_the_first_image(corridor, skipped):
    slam, results = run(corridor, frames=range(8), skipped=skipped)
    n = len(list(skipped))
    assert states(results) == "L" * n + "O" * (8 - n)
    assert len(slam.trajectory()) == 8


def test_skipping_everything(corridor):
    slam, results = run(corridor, frames=range(4), skipped=range(4))
    assert states(results) == "LLLL"
    np.testing.assert_array_equal(slam.trajectory().T_wc, np.tile(np.eye(4), (4, 1, 1)))


def test_nothing_at_all(corridor):
    slam, _ = run(corridor, frames=[])
    assert slam.trajectory().T_wc.shape == (0, 4, 4)
    assert slam.keyframe_trajectory().T_wc.shape == (0, 4, 4)


def test_dropped_frames_do_not_disturb_the_prediction(corridor):
    """The velocity is per second. A gap of two frames is predicted as two frames of motion."""
    frames = [k for k in range(len(corridor)) if k not in (7, 14, 15, 21)]
    slam, results = run(corridor, frames=frames)
    assert states(results) == "O" * len(frames)
    assert rmse(position_errors(slam, corridor, frames)) < 0.05


def test_the_prediction_scales_with_the_time_passed(corridor):
    ends = {}
    for gap in (0.1, 0.2, 0.4):
        slam = Slam(corridor.camera, CONFIG, "none", threads=1)
        for k in range(6):
            slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
        ends[gap] = slam.skip(corridor.timestamps[5] + gap).T_wc[2, 3]
        slam.finish()
    start = 5 * 0.35
    for gap, z in ends.items():
        assert z - start == pytest.approx(3.5 * gap, abs=0.05 + 0.2 * gap)


def test_a_stationary_camera_stays_and_does_not_grow_the_map(corridor):
    slam = Slam(corridor.camera, CONFIG, "none", threads=1)
    for k in range(25):
        slam.step(corridor.left[0], corridor.right[0], 0.1 * k)
        if k == 12:
            halfway = slam.map.n_landmarks
    slam.finish()
    assert np.abs(slam.trajectory().T_wc - np.eye(4)).max() < 0.01
    assert slam.map.n_landmarks < 1.3 * halfway
    assert slam.map.n_keyframes <= 4


@pytest.mark.parametrize(("method", "inserted"), [("orb", 15), ("patches", 2)])
def test_a_stationary_camera_keeps_few_keyframes(corridor, check_map, method, inserted):
    """Without patches, a standing camera is not recognised, and its keyframes are culled later."""
    eager = EAGER.model_copy(
        update={"tracking": EAGER.tracking.model_copy(update={"method": method})}
    )
    slam = Slam(corridor.camera, eager, "none", threads=1)
    for k in range(15):
        slam.step(corridor.left[0], corridor.right[0], 0.1 * k)
    slam.finish()
    assert slam.map.n_keyframes == inserted
    assert len(slam.map.living_keyframes()) <= 6
    assert np.abs(slam.trajectory().T_wc - np.eye(4)).max() < 0.01
    check_map(slam.map)


def test_refuses_images_of_another_size_and_time_that_stands_still(corridor):
    slam = Slam(corridor.camera, CONFIG, "none", threads=1)
    with pytest.raises(ValueError, match="camera"):
        slam.step(corridor.left[0][:-1], corridor.right[0], 0.0)
    for time in (float("nan"), float("inf"), float("-inf")):
        with pytest.raises(ValueError, match="must be a finite number"):
            slam.step(corridor.left[0], corridor.right[0], time)
    slam.step(corridor.left[0], corridor.right[0], 1.0)
    for time in (1.0, 0.5, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="timestamp"):
            slam.step(corridor.left[1], corridor.right[1], time)
        with pytest.raises(ValueError, match="timestamp"):
            slam.skip(time)
    assert len(slam.trajectory()) == 1
    slam.finish()


def test_the_kitti_tree_is_read_as_it_was_rendered(kitti_tree, corridor):
    sequence = open_kitti(kitti_tree, "00")
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth, corridor.T_wc, rtol=0, atol=1e-9)
    assert sequence.camera == corridor.camera
    assert len(sequence.ground_truth) == len(corridor)


def test_a_part_of_the_map_that_began_anew_is_held_by_its_oldest_keyframe(corridor, monkeypatch):
    """Otherwise, bundle adjustment could move the whole part freely."""
    slam, _ = run(corridor)
    detach_keyframe(slam.map.arrays, 0)
    anew = [int(k) for k in slam.map.living_keyframes() if k != 0]
    assert len(anew) >= 3
    monkeypatch.setattr(local_mapping, "MIN_SHARED", 1)
    free, fixed, _ = local_window(slam.map, anew[-1], Config())
    assert fixed.tolist() == anew[:1]
    assert free.tolist() == anew[1:]


def test_images_of_floats_are_refused(corridor):
    slam = Slam(corridor.camera)
    with pytest.raises(ValueError, match="float64"):
        slam.step(corridor.left[0] / 255.0, corridor.right[0] / 255.0, 0.0)


def test_a_step_after_finish_goes_on(corridor):
    slam = Slam(corridor.camera)
    for k in range(len(corridor)):
        slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])
        if k == 9:
            slam.finish()
    slam.finish()
    assert rmse(position_errors(slam, corridor)) < 0.06


class Onlooker(NoDetector):
    """A detector that keeps the image of every keyframe."""

    def __init__(self) -> None:
        self.images: list[np.ndarray] = []

    def add(self, keyframe, image, features):
        self.images.append(image)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_caller_may_write_the_next_images_into_the_same_arrays(corridor, threads):
    """A detector in the mapping thread must still see the image of the keyframe."""
    onlooker = Onlooker()
    slam = Slam(corridor.camera, EAGER, onlooker, threads=threads)
    left, right = np.empty_like(corridor.left[0]), np.empty_like(corridor.right[0])
    for k in range(12):
        left[:], right[:] = corridor.left[k], corridor.right[k]
        slam.step(left, right, corridor.timestamps[k])
        left[:] = right[:] = 0
    slam.finish()
    assert len(onlooker.images) == len(slam.map.frames) > 3
    for frame, image in zip(slam.map.frames, onlooker.images, strict=True):
        np.testing.assert_array_equal(image, corridor.left[frame])


def test_the_capsule_network_beside_the_bag_of_words_is_the_default(corridor):
    assert Slam(corridor.camera).detector.name == "both"
    assert Slam(corridor.camera.left_camera()).detector.name == "both"
    assert Slam(corridor.camera, detector="bow").detector.name == "bow"
    assert Slam(corridor.camera, detector="none").detector.name == "none"
    with pytest.raises(ValueError, match=r"'bwo' \(did you mean bow\?\); choose one of none, bow"):
        Slam(corridor.camera, detector="bwo")


def test_a_keyframe_that_cannot_be_mapped_is_the_last_thing_that_happens(
    corridor, monkeypatch, tmp_path
):
    """The step that publishes it raises an error. After that, the incomplete map is not used."""
    slam = Slam(corridor.camera, EAGER, "none", threads=1)

    def drive(frames: range) -> None:
        for k in frames:
            slam.step(corridor.left[k], corridor.right[k], corridor.timestamps[k])

    drive(range(3))

    def fail(*_: object) -> None:
        raise ZeroDivisionError("injected")

    monkeypatch.setattr("vslam.method.mapping.refine_and_calibrate", fail)
    with pytest.raises(ZeroDivisionError, match="injected"):
        drive(range(3, 6))
    monkeypatch.undo()
    for use in (
        lambda: drive(range(6, 7)),
        lambda: slam.save(tmp_path / "map.npz"),
        lambda: slam.map,
        slam.finish,
        slam.trajectory,
    ):
        with pytest.raises(
            RuntimeError, match=r"mapping a keyframe failed.*injected.*saved before"
        ):
            use()
    assert not (tmp_path / "map.npz").exists()
