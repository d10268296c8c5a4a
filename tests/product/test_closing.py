"""Loop closing, relocalisation and joining of sub-maps, on a ring of points (tests/ring.py)."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from ring import CAMERA, LAP, Oracle, Ring

from vslam.backend import pose_graph
from vslam.backend.loop_correction import move_keyframes
from vslam.backend.pose_graph import (
    GAP,
    WEAK,
    connectivity,
    drift_of_camera,
    essential_graph,
    optimise,
)
from vslam.backend.similarity_graph import scale_of
from vslam.config import Config, ConsistencyConfig, KeyframeConfig, LoopConfig
from vslam.loopclosure.detector import NoDetector
from vslam.loopclosure.verification import verify
from vslam.loopclosure.verifier import Verifier
from vslam.method.closing import LoopClosing
from vslam.method.hypotheses import Hypothesis, Solution, joined_submaps, solve
from vslam.slam import Slam
from vslam.types.context import Context
from vslam.types.features import Extracted, Features, TrackingState
from vslam.types.geometry import inverse, inverses, se3_exp
from vslam.types.loops import LoopCandidate
from vslam.types.map import UNPREDICTED

ROUND = [float(k) for k in range(LAP + 40)]
DRIFTING = Ring.create(focal_error=0.015)
EXACT = Ring.create()
DENSE = Config(keyframes=KeyframeConfig(max_interval_s=0.35))  # many keyframes, many queries


class Deceived(Oracle):
    """A detector that mistakes each place for the place on the opposite side of the ring."""

    def query(self, keyframe, map_):
        opposite = int(np.argmin(np.abs(np.array(map_.frames) - map_.frames[keyframe] + LAP // 2)))
        if keyframe < 20 or not map_.arrays.keyframe_alive[opposite]:
            return []
        return [LoopCandidate(keyframe, opposite, 1.0)]


class Sticker(Ring):
    """A drive in which the camera is carried from one place to another.

    The first image after that shows a few things that the camera saw before, and what is really
    there.
    """

    def see(self, k, seed):
        features = super().see(k, seed)
        if k != CARRIED_TO:
            return features
        before = super().see(CARRIED_FROM, seed)
        chosen = np.linspace(0, len(before) - 1, 70).astype(int)
        return Features(*(
            np.concatenate([getattr(before, name)[chosen], getattr(features, name)])
            for name in ("xy", "octave", "angle", "descriptors", "u_right")
        ))  # fmt: skip


CARRIED_FROM, CARRIED_TO = 60.0, 90.0
CARRIED = [*ROUND[:60], *ROUND[90:]]


def run(ring, frames, detector="none", *, threads=1, dark=(), finish=True, config=None, look=None):
    """Run vslam along ``frames`` of the ring, with ten frames per second.

    Frames in ``dark`` show nothing. ``look`` is called after each frame.
    """
    slam = Slam(CAMERA, config, detector, threads=threads)
    results = []
    for i, k in enumerate(frames):
        image = np.array([[i & 255, i >> 8]], np.uint8)  # index for the oracle
        features = Features.none() if i in dark else ring.see(k, 1)
        results.append(slam.step_features(Extracted(features), 0.1 * i, image))
        if look is not None:
            look(slam)
    if finish:
        slam.finish()
    return slam, results


def errors(slam, ring, frames):
    """Return the ``(N,)`` distances in metres between estimated and true positions.

    Positions are in the world of the first frame.
    """
    T_0 = inverse(ring.pose(frames[0]))
    truth = np.array([(T_0 @ ring.pose(k))[:3, 3] for k in frames])
    return np.linalg.norm(slam.trajectory().T_wc[:, :3, 3] - truth, axis=1)


@cache
def closed():
    return run(DRIFTING, ROUND, Oracle(DRIFTING, ROUND))[0]


@pytest.mark.slow
def test_a_closed_loop_takes_the_drift_out(check_map):
    without, _ = run(DRIFTING, ROUND)
    slam = closed()
    before, after = errors(without, DRIFTING, ROUND), errors(slam, DRIFTING, ROUND)
    assert before[-1] > 3.0
    assert after[-1] < 1.2  # the ring is 1.5 % too large, which is 0.75 m of its radius
    assert np.sqrt((after**2).mean()) < 0.5 * np.sqrt((before**2).mean())
    accepted = [edge for edge in slam.loops if edge.accepted]
    assert [edge.reason for edge in accepted] == ["closed"] * len(slam.corrections)
    assert slam.corrections
    check_map(slam.map)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_saving_after_each_frame_changes_no_result_of_a_drive_with_loops(threads):
    oracle = Oracle(DRIFTING, ROUND)
    slam, _ = run(DRIFTING, ROUND, oracle, threads=threads, look=Slam.stored_map)
    assert slam.trajectory().T_wc.tobytes() == closed().trajectory().T_wc.tobytes()
    assert [edge.reason for edge in slam.loops] == [edge.reason for edge in closed().loops]


@pytest.mark.slow
def test_a_checkpoint_waits_until_a_loop_that_was_found_is_closed():
    states = []

    def look(slam):
        stored = slam.stored_map()
        states.append((len(slam.corrections), stored.checkpoint is None, slam.is_adjusting))

    run(DRIFTING, ROUND, Oracle(DRIFTING, ROUND), look=look)
    first = next(k for k, (closed_loops, _, _) in enumerate(states) if closed_loops)
    assert states[first - 1] == (0, True, False)  # the loop is found, but not closed yet


ZOOMING = Ring.create(focal_error=0.015, zoom=True)
ENDS_EARLY = ROUND[: LAP + 14]
# On the ring, the evidence of one keyframe is overwhelming by default.
CAUTIOUS = ConsistencyConfig(max_wrong=1e-8, max_wrong_at_end=1e-8)


@pytest.mark.slow
def test_a_drive_that_ends_before_the_next_keyframe_asks_an_earlier_one():
    config = Config(consistency=CAUTIOUS)
    slam, _ = run(ZOOMING, ENDS_EARLY, Oracle(ZOOMING, ENDS_EARLY), finish=False, config=config)
    slam.stored_map()  # waits for the search at the last keyframe
    assert slam.loops[-1].reason.startswith("verified, but wrong")
    assert errors(slam, ZOOMING, ENDS_EARLY)[-1] > 3.0
    slam.finish()
    waiting, closed = slam.loops[-2:]
    assert (closed.query, closed.match, closed.reason) == (waiting.query, waiting.match, "closed")
    assert errors(slam, ZOOMING, ENDS_EARLY)[-1] < 1.2
    before = len(slam.loops)
    slam.finish()
    assert len(slam.loops) == before


@pytest.mark.slow
def test_a_loop_that_no_earlier_keyframe_far_enough_away_confirms_stays_open():
    config = Config(consistency=CAUTIOUS.model_copy(update={"min_moved": 2.0}))
    slam, _ = run(ZOOMING, ENDS_EARLY, Oracle(ZOOMING, ENDS_EARLY), config=config)
    assert slam.loops[-1].reason.startswith("verified, but wrong")
    assert not slam.corrections


def test_both_ends_of_a_loop_see_the_same_landmarks_afterwards():
    slam = closed()
    edge = slam.corrections[0].edge
    shared = dict(zip(*(x.tolist() for x in slam.map.covisible(edge.query)), strict=True))
    assert shared[edge.match] >= 40


def test_a_correction_says_where_the_keyframes_were():
    correction = closed().corrections[0]
    query = int(np.flatnonzero(correction.keyframes == correction.edge.query)[0])
    match = int(np.flatnonzero(correction.keyframes == correction.edge.match)[0])
    gap = [
        np.linalg.norm((T[query] @ inverse(T[match]))[:3, 3] - correction.edge.T_query_match[:3, 3])
        for T in (correction.T_cw_before, correction.T_cw_after)
    ]
    assert gap[0] > 2.0
    assert gap[1] < 0.1


@pytest.mark.slow
def test_same_bytes_with_one_thread_and_two():
    again = run(DRIFTING, ROUND, Oracle(DRIFTING, ROUND), threads=2)[0]
    assert again.trajectory().T_wc.tobytes() == closed().trajectory().T_wc.tobytes()


@pytest.mark.slow
def test_two_slams_may_share_the_features_of_their_frames():
    """Detectors that are compared share features, and only one of them closes the loop here.

    Both corrections of features are active: that of disparities, and that of a delay of the right
    image. Neither may change the shared features.
    """
    late = 0.004
    ring = replace(Ring.create(focal_error=0.015), right_delay=late)

    def start(detector, threads):
        return Slam(replace(CAMERA, right_delay=late), None, detector, threads=threads)

    def drive(slams, shown):
        for i, features in enumerate(shown):
            image = np.array([[i & 255, i >> 8]], np.uint8)
            for slam in slams:
                slam.step_features(Extracted(features), 0.1 * i, image)
        for slam in slams:
            slam.finish()

    def see():
        return [ring.see(k, 1) for k in ROUND]

    together = start(Oracle(ring, ROUND), 2), start(NoDetector(), 2)
    shown = see()
    drive(together, shown)
    assert [len(slam.corrections) > 0 for slam in together] == [True, False]
    assert all(slam.map.scalars.disparity_offset != 0.0 for slam in together)
    for features, as_seen in zip(shown, see(), strict=True):
        for name in ("xy", "octave", "angle", "descriptors", "u_right"):
            assert getattr(features, name).tobytes() == getattr(as_seen, name).tobytes()
    for slam, detector in zip(together, (Oracle(ring, ROUND), NoDetector()), strict=True):
        alone = start(detector, 1)
        drive([alone], see())
        assert slam.trajectory().T_wc.tobytes() == alone.trajectory().T_wc.tobytes()
        n = alone.map.n_landmarks
        assert slam.map.arrays.xyz[:n].tobytes() == alone.map.arrays.xyz[:n].tobytes()


@pytest.mark.slow
def test_a_detector_that_is_wrong_changes_nothing():
    deceived = run(DRIFTING, ROUND, Deceived(DRIFTING, ROUND))[0]
    without = run(DRIFTING, ROUND, NoDetector())[0]
    assert deceived.loops
    assert not any(edge.accepted for edge in deceived.loops)
    assert deceived.trajectory().T_wc.tobytes() == without.trajectory().T_wc.tobytes()


def test_a_camera_carried_back_is_found_in_the_map():
    frames = [*ROUND[:90], *(k + 0.4 for k in ROUND[30:60])]
    slam, results = run(EXACT, frames, Oracle(EXACT, frames))
    lost = [r.index for r in results if r.state is TrackingState.LOST]
    assert len(lost) <= 3
    assert not slam.map.restarts
    assert errors(slam, EXACT, frames)[[i for i in range(len(frames)) if i not in lost]].max() < 0.5


def test_a_camera_carried_back_is_lost_without_a_detector():
    frames = [*ROUND[:90], *(k + 0.4 for k in ROUND[30:60])]
    slam, results = run(EXACT, frames)
    assert errors(slam, EXACT, frames)[-1] > 50.0
    assert sum(r.state is TrackingState.LOST for r in results) == 3
    assert slam.map.restarts


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_parts_of_the_map_are_joined_by_a_loop(check_map, threads):
    frames = [*ROUND[:80], *ROUND[140:]]  # 60 frames (90 m) are left out
    slam, results = run(EXACT, frames, Oracle(EXACT, frames), threads=threads)
    assert len(slam.map.restarts) == 1
    assert slam.corrections
    tracked = [r.index for r in results if r.state is not TrackingState.LOST]
    found = errors(slam, EXACT, frames)
    assert found[tracked].max() < 0.7  # the error of the part after the gap was about 70 m
    assert len(slam.trajectory()) == len(frames)
    check_map(slam.map)


@pytest.mark.slow
def test_two_seconds_of_darkness_lose_no_pose(check_map):
    slam, results = run(EXACT, ROUND, Oracle(EXACT, ROUND), dark=range(60, 80))
    assert len(slam.trajectory()) == len(ROUND)
    assert np.isfinite(slam.trajectory().T_wc).all()
    lost = [r.index for r in results if r.state is TrackingState.LOST]
    assert set(range(60, 80)) <= set(lost)
    assert len(lost) <= 22
    found = errors(slam, EXACT, ROUND)
    assert found.max() < 1.5  # including the dark frames, whose motion is interpolated
    check_map(slam.map)


class Accepting(Verifier):
    """A verifier that accepts every candidate as the same verified loop."""

    def __init__(self, edge):
        super().__init__(Context.create(CAMERA, Config()))
        self.edge = edge

    def verify(self, map_, trial):
        return self.edge


def closing_of(edge, config, threads=1):
    """Make loop closing that accepts one loop as soon as it is a candidate."""
    at_once = ConsistencyConfig(min_keyframes=1, max_wrong=0.5)
    config = config.model_copy(update={"consistency": at_once})
    return LoopClosing(
        NoDetector(), Accepting(edge), Context.create(CAMERA, config), threads=threads
    )


@cache
def open_loop(gap):
    """Make a map of two sub-maps, and a verified loop between them that is not closed yet."""
    if gap == "dark":  # the camera moved on for a second
        ring, frames, dark = DRIFTING, ROUND, range(60, 70)
    else:  # 90 m between two frames
        ring, frames, dark = EXACT, [*ROUND[:80], *ROUND[140:]], ()
    slam, _ = run(ring, frames, dark=dark)
    assert len(slam.map.restarts) == 1
    assert not slam.map.unpredicted_restarts
    candidate = Oracle(ring, frames).query(slam.map.n_keyframes - 1, slam.map)[0]
    edge = verify(slam.map, candidate, slam.context)
    assert edge.accepted
    return slam.map, edge


# If no speed was known, there is no GAP edge. Such a sub-map may be too far away for the
# optimiser to follow the loop, unless it is first moved as a whole.
STIFF, SOFT = 10.0, 100.0  # standard deviation of a weak edge, m


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "unpredicted", "weak", "expected"),
    [
        ("dark", False, SOFT, Hypothesis.PREDICTED),
        ("carried", False, SOFT, Hypothesis.KIDNAPPED),
        ("carried", True, SOFT, Hypothesis.PREDICTED),
        ("carried", True, STIFF, Hypothesis.KIDNAPPED),
    ],
)
def test_a_camera_is_taken_for_kidnapped_only_if_it_cannot_have_gone_on_as_predicted(
    gap, unpredicted, weak, expected, monkeypatch
):
    monkeypatch.setattr(pose_graph, "_WEAK_TRANSLATION", weak)
    config = Config()
    map_, edge = copy.deepcopy(open_loop(gap))
    if unpredicted:
        map_.keyframes.restart[map_.restarts] = UNPREDICTED
    drift = drift_of_camera(config.pose_graph, CAMERA.fx)
    solutions = {
        one: solve(map_, [], edge, one, drift, monocular=False)
        for one in (Hypothesis.PREDICTED, Hypothesis.KIDNAPPED)
    }
    kinds = {one: set(found.graph.kind) & {GAP, WEAK} for one, found in solutions.items()}
    assert kinds == {
        Hypothesis.PREDICTED: {WEAK} if unpredicted else {GAP},
        Hypothesis.KIDNAPPED: {WEAK},
    }
    assert all(found.has_gaps for found in solutions.values())
    predicted, kidnapped = solutions.values()
    assert predicted.verdict.consistent == (expected is Hypothesis.PREDICTED)
    assert kidnapped.verdict.consistent
    assert predicted.T_cw.tobytes() != kidnapped.T_cw.tobytes()
    closing = closing_of(edge, config)
    closing.consider(map_, edge.query, [LoopCandidate(edge.query, edge.match, 1.0)])
    (correction,) = closing.corrections
    assert correction.T_cw_after.tobytes() == solutions[expected].T_cw.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(("gap", "closed"), [("dark", 1), ("carried", 0)])
def test_a_doubtful_loop_does_not_carry_the_camera_away(gap, closed):
    map_, edge = copy.deepcopy(open_loop(gap))
    edge = replace(edge, p_wrong=2e-3)
    closing = closing_of(edge, Config())
    closing.consider(map_, edge.query, [LoopCandidate(edge.query, edge.match, 1.0)])
    assert len(closing.corrections) == closed


def test_a_map_in_one_piece_has_no_gaps():
    slam, edge = closed(), closed().corrections[0].edge
    config = Config().pose_graph
    solution = solve(slam.map, [], edge, Hypothesis.PREDICTED, config, monocular=False)
    assert solution.verdict.consistent
    assert not solution.has_gaps


def test_a_loop_joins_two_submaps():
    map_, edge = open_loop("carried")
    assert set(joined_submaps(map_, [])) == {0, map_.restarts[0]}
    assert set(joined_submaps(map_, [edge])) == {0}


def test_a_loop_keeps_the_map_level_where_gravity_is_known():
    """The odometry tilts by two degrees along the ring, and an IMU has measured gravity."""
    map_, edge = copy.deepcopy(open_loop("dark"))
    living, down = map_.living_keyframes(), np.array([0.0, 1.0, 0.0])
    true = np.array([DRIFTING.pose(ROUND[frame]) for frame in map_.frames[living].tolist()])
    felt = true[:, :3, :3].transpose(0, 2, 1) @ down
    angles = np.radians(2.0) * living / map_.n_keyframes
    tilting = np.array([se3_exp(np.array([0, 0, 0, 0, 0, angle])) for angle in angles])
    move_keyframes(map_, living, map_.arrays.T_cw[living] @ inverses(tilting))

    def solved() -> tuple[Solution, float]:
        config = Config().pose_graph
        found = solve(map_, [], edge, Hypothesis.PREDICTED, config, monocular=False)
        assert found.verdict.consistent
        cosine = ((found.T_cw[:, :3, :3] @ down) * felt).sum(axis=1).clip(-1.0, 1.0)
        return found, float(np.degrees(np.sqrt(np.mean(np.arccos(cosine) ** 2))))

    plain, tilted = solved()
    graph = essential_graph(map_, [edge], Config().pose_graph, driven=True)
    assert plain.T_cw.tobytes() == optimise(graph, Config().pose_graph).tobytes()
    map_.keyframes.gravity[living], map_.keyframes.gravity_sigma[living] = felt, 0.002
    level_solution, level = solved()
    assert tilted > 0.4
    assert level < 0.25 * tilted
    # The scale of one camera cannot drift if an IMU made its map metric and the loop agrees.
    config, known = Config().pose_graph, replace(map_.scalars, metric=True)
    metric = copy.deepcopy(map_)
    metric.scalars = known
    other = replace(edge, scale=1.2)
    for kept, one in ((True, edge), (False, other)):
        one_camera = solve(metric, [], one, Hypothesis.PREDICTED, config, monocular=True)
        assert (one_camera.T_cw.tobytes() == level_solution.T_cw.tobytes()) == kept
        assert np.allclose(scale_of(one_camera.S_wc), 1.0) == kept


@pytest.mark.parametrize("threads", [1, 2])
def test_a_global_adjustment_that_fails_leaves_the_map_as_it_was(monkeypatch, caplog, threads):
    def fail(*_, **__):
        raise np.linalg.LinAlgError("not positive definite")

    map_, edge = copy.deepcopy(open_loop("dark"))
    candidates = [LoopCandidate(edge.query, edge.match, 1.0)]
    closing = closing_of(edge, Config(), threads)
    with monkeypatch.context() as patched:
        patched.setattr("vslam.method.closing.adjust_globally", fail)
        closing.consider(map_, edge.query, candidates)
        assert closing.is_adjusting
        before = map_.copy().arrays
        closing.finish(map_)
    assert not closing.is_adjusting
    for name, array in zip(before._fields, map_.copy().arrays, strict=True):
        assert array.tobytes() == getattr(before, name).tobytes()
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "not positive definite" in record.getMessage()
    # The next loop is closed, and the result of its adjustment is applied.
    closing.consider(map_, edge.query, candidates)
    assert len(closing.corrections) == 2
    before = map_.copy().arrays
    closing.finish(map_)
    assert map_.copy().arrays.T_cw.tobytes() != before.T_cw.tobytes()
    assert len(caplog.records) == 1


def test_loop_closing_restored_from_its_state_closes_the_loop_that_waits():
    ring, frames = EXACT, [*ROUND[:80], *ROUND[140:]]
    map_ = copy.deepcopy(open_loop("carried")[0])
    oracle, last = Oracle(ring, frames), map_.n_keyframes - 1
    config = Config(consistency=ConsistencyConfig(min_keyframes=1, max_wrong=1e-4))
    context = Context.create(CAMERA, config)

    def create(state=None):
        return LoopClosing(NoDetector(), Verifier(context), context, threads=1, state=state)

    stopped, fresh = create(), create()
    stopped.count_reused_keyframe(map_, new=True)
    stopped.consider(map_, last - 1, oracle.query(last - 1, map_))
    assert stopped.edges[-1].reason.startswith("verified, but wrong")
    assert fresh.state() != stopped.state()
    restored = create(stopped.state())
    assert restored.state() == stopped.state()
    candidates = oracle.query(last, map_)
    for closing in (fresh, restored):
        closing.consider(map_, last, candidates)
    assert not fresh.corrections
    assert len(restored.corrections) == 1


def test_the_map_is_adjusted_again_after_enough_revisits():
    map_ = copy.deepcopy(open_loop("carried")[0])
    n = len(map_.living_keyframes())
    config = Config(loops=LoopConfig(min_revisits=3, revisits_share=5.5 / n))
    context = Context.create(CAMERA, config)

    def closing() -> LoopClosing:
        return LoopClosing(NoDetector(), Verifier(context), context, threads=1)

    leaving, staying = closing(), closing()
    for count in (1, 2, 3):
        leaving.count_revisit(map_)
        assert not leaving.is_adjusting  # the camera is still at old places
        leaving.adjust_after_revisits(map_)
        assert leaving.is_adjusting == (count == 3)
    for count in range(1, 7):
        staying.count_reused_keyframe(map_, new=True)
        staying.count_reused_keyframe(map_, new=False)
        assert staying.is_adjusting == (count == 6)
    before = map_.arrays.T_cw[: map_.n_keyframes].copy()
    leaving.conclude(map_)
    assert not leaving.is_adjusting
    assert not np.array_equal(map_.arrays.T_cw[: map_.n_keyframes], before)


def test_where_no_speed_was_known_a_restart_is_unpredicted():
    """Tracking is lost at once, so that the map has no velocity."""
    frames = [0.0, *ROUND[30:60]]
    slam, results = run(EXACT, frames)
    assert [r.state for r in results[:3]].count(TrackingState.LOST) == 1
    assert slam.map.restarts == slam.map.unpredicted_restarts == [1]


@pytest.mark.slow
@pytest.mark.parametrize("overwhelming", [0.0, LoopConfig().overwhelming])
def test_overwhelming_evidence_outweighs_a_wrong_keyframe(overwhelming):
    """The camera is carried 45 m away, and its next image agrees with wrong landmarks."""
    ring = Sticker(EXACT.points, EXACT.descriptors)
    config = DENSE.model_copy(update={"loops": LoopConfig(overwhelming=overwhelming)})
    slam, results = run(ring, CARRIED, Oracle(ring, CARRIED), config=config)
    assert results[60].state == TrackingState.WEAK
    assert results[60].is_keyframe
    found = errors(slam, EXACT, CARRIED)
    assert found[:60].max() < 0.3
    if overwhelming:
        assert slam.corrections[0].edge.against_odometry
        assert found[60:].max() < 1.0
        return
    assert not slam.corrections
    assert sum("contradicted" in edge.reason for edge in slam.loops) > 4
    assert found[60:].min() > 40.0
    wrong = slam.map.frames.tolist().index(60)
    held = connectivity(slam.map)
    assert int(held[1:].argmin()) + 1 == wrong
    expected = max(
        len(set(slam.map.landmarks_of(i).tolist()) & set(slam.map.landmarks_of(j).tolist()))
        for i in range(wrong)
        for j in range(wrong, slam.map.n_keyframes)
    )
    assert held[wrong] == expected < 30


def twofold() -> Ring:
    first = EXACT.points[:, 2] > 0.0
    points, descriptors = EXACT.points[first], EXACT.descriptors[first]
    return Ring(np.concatenate([points, points * [-1, 1, -1]]), np.tile(descriptors, (2, 1)))


class Confused(Oracle):
    """A detector that treats places as equal if they look the same."""

    def _near(self, frame, query, map_, last):
        here = self.frames[frame] % (LAP / 2)
        found = [
            LoopCandidate(query, int(k), -abs(here - self.frames[map_.frames[k]] % (LAP / 2)))
            for k in map_.living_keyframes()
        ]
        found = [one for one in found if one.match < last and one.score > -2.0]
        return sorted(found, key=lambda one: -one.score)


@pytest.mark.slow
def test_a_sound_map_is_not_doubted_whatever_many_keyframes_resemble():
    frames = ROUND[: LAP // 2 + 60]
    slam, _ = run(twofold(), frames, Confused(twofold(), frames))
    against = [
        edge for edge in slam.loops if "contradicted" in edge.reason or "drift" in edge.reason
    ]
    assert len({edge.query for edge in against}) >= 4
    assert not slam.corrections
    assert not slam.map.restarts
    assert errors(slam, EXACT, frames).max() < 1.0
