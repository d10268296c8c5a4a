"""Candidates are consistent over several keyframes, and verified loops agree."""

from __future__ import annotations

import numpy as np
import pytest
from parts import CAMERA

from vslam.config import Config, ConsistencyConfig
from vslam.loopclosure.consistency import LoopConsistency, implied_drift
from vslam.types.context import Context
from vslam.types.geometry import compose, inverse, se3_exp, se3_log
from vslam.types.loops import LoopCandidate, LoopEdge

USUAL = ConsistencyConfig()
STRICT = ConsistencyConfig(min_keyframes=3, max_gap=0)  # the rule of ORB-SLAM
DRIFT = se3_exp(np.array([2.0, 0.3, -4.0, 0.01, 0.12, 0.0]))


class Street:
    """A map that has only what the check of consistency needs.

    Its keyframes are 2 m apart on a street that is passed twice. Keyframes up to 6 m apart are
    covisible. The second pass starts with keyframe 100 and has drifted.
    """

    def covisible(self, keyframe: int, minimum: int = 1):
        near = [keyframe + d for d in (1, -1, 2, -2, 3, -3)]
        return np.array(near), np.full(len(near), 50)

    def keyframe_pose(self, keyframe: int) -> np.ndarray:
        truth = inverse(se3_exp(np.array([0.0, 0.0, 2.0 * (keyframe % 100), 0.0, 0.0, 0.0])))
        return compose(truth, inverse(DRIFT)) if keyframe >= 100 else truth


STREET = Street()


def consistency_of(config: ConsistencyConfig = USUAL) -> LoopConsistency:
    context = Context.create(CAMERA, Config(consistency=config))
    return LoopConsistency(context, config.verified_memory)


def candidates(query: int, *matches: int) -> list[LoopCandidate]:
    return [LoopCandidate(query, match, 0.5) for match in matches]


def verified(query: int, match: int, error=(0.0, 0.0, 0.0), turn=0.0, p_wrong=0.01) -> LoopEdge:
    """Make an edge whose pose is wrong by ``error`` metres and ``turn`` degrees."""
    true = compose(
        inverse(se3_exp(np.array([0.0, 0.0, 2.0 * (query - 100), 0.0, 0.0, 0.0]))),
        inverse(STREET.keyframe_pose(match)),
    )
    wrong = se3_exp(np.array([*error, 0.0, np.radians(turn), 0.0]))
    T_query_match = compose(wrong, true)
    return LoopEdge(query, match, 0.5, True, "verified", 100, 90, T_query_match, p_wrong=p_wrong)


# -- by looks -------------------------------------------------------------------------------------


def test_a_place_must_resemble_three_keyframes_in_a_row():
    consistency = consistency_of(STRICT)
    for turn, query in enumerate((110, 111, 112, 113)):
        doubts = consistency.update(candidates(query, 10 + turn), STREET)
        reason = f"proposed for only {turn + 1} of the 3 consecutive keyframes needed"
        assert doubts == ({} if turn >= 2 else {10 + turn: reason})


def test_places_that_jump_are_not_consistent():
    consistency = consistency_of(STRICT)
    for query, match in ((110, 10), (111, 40), (112, 70), (113, 10), (114, 40)):
        assert consistency.update(candidates(query, match), STREET).keys() == {match}


@pytest.mark.parametrize(("gap", "still"), [(0, False), (1, True)])
def test_a_keyframe_without_candidates_in_between(gap, still):
    consistency = consistency_of(STRICT.model_copy(update={"max_gap": gap}))
    consistency.update(candidates(110, 10), STREET)
    consistency.update(candidates(111, 11), STREET)
    consistency.update([], STREET)
    doubts = consistency.update(candidates(113, 13), STREET)
    assert (not doubts) == still
    consistency.update([], STREET)
    consistency.update([], STREET)
    assert consistency.update(candidates(116, 16), STREET).keys() == {16}


def test_only_the_consistent_one_of_several_candidates_passes():
    consistency = consistency_of(STRICT)
    for query, other in ((110, 50), (111, 70), (112, 90)):
        doubts = consistency.update(candidates(query, other, query - 100), STREET)
    assert doubts.keys() == {90}


def test_overlapping_groups_do_not_multiply():
    # Each of ten candidates overlaps all earlier groups. There would be 10^30 pairs.
    consistency = consistency_of(ConsistencyConfig(min_keyframes=3, max_gap=2))
    for query in range(110, 140):
        matches = [20 + (query + i) % 10 for i in range(10)]
        consistency.update(candidates(query, *matches), STREET)
        assert len(consistency.state.places) <= 10
    for query in range(140, 170):  # groups that are not continued are forgotten
        apart = [1000 * query + 20 * i for i in range(10)]
        consistency.update(candidates(query, *apart), STREET)
        assert len(consistency.state.places) <= 30


def test_the_same_group_twice_counts_once():
    consistency = consistency_of(STRICT)
    doubts = consistency.update(candidates(110, 10, 10, 10, 11), STREET)
    assert doubts.keys() == {10, 11}
    assert len(consistency.state.places) == 2


# -- verified ones --------------------------------------------------------------------------------


def test_the_drift_of_a_true_edge_is_undone():
    np.testing.assert_allclose(
        se3_log(compose(implied_drift(verified(110, 10), STREET), DRIFT)), 0, atol=1e-12
    )


def test_two_true_edges_confirm_each_other():
    consistency = consistency_of()
    consistency.update([], STREET)
    first = consistency.confirm(verified(110, 10, (0.05, 0.02, 0.1), 0.05), STREET)
    assert not first.accepted
    assert first.reason == "verified, but wrong with probability 0.01"
    assert first.T_query_match is not None
    consistency.update([], STREET)
    second = consistency.confirm(verified(111, 12, (-0.05, 0.0, 0.05), -0.05), STREET)
    assert second.accepted
    assert second.reason == "verified"


def test_overwhelming_evidence_needs_no_second_keyframe():
    consistency = consistency_of(ConsistencyConfig(max_wrong=1e-3))
    consistency.update([], STREET)
    assert consistency.confirm(verified(110, 10, p_wrong=1e-3), STREET).accepted
    consistency.reset()
    assert not consistency.confirm(verified(110, 10, p_wrong=2e-3), STREET).accepted


def test_two_weak_loops_that_agree_are_too_weak_together():
    consistency = consistency_of(ConsistencyConfig(max_wrong=1e-3))
    for query in range(110, 114):
        consistency.update([], STREET)
        edge = consistency.confirm(verified(query, query - 100, p_wrong=0.1), STREET)
        assert not edge.accepted
    assert edge.p_wrong == pytest.approx(0.01)  # neighbours see similar things: only one counts


@pytest.mark.parametrize(
    "wrong", [{"error": (1.0, 0.0, 0.0)}, {"error": (0.0, 0.0, 8.0)}, {"turn": 3.0}]
)
def test_edges_that_disagree_do_not(wrong):
    consistency = consistency_of()
    consistency.update([], STREET)
    consistency.confirm(verified(110, 10, **wrong), STREET)
    consistency.update([], STREET)
    assert not consistency.confirm(verified(111, 11), STREET).accepted
    consistency.update([], STREET)
    assert consistency.confirm(verified(112, 12), STREET).accepted  # the true loops are kept


def test_one_keyframe_cannot_confirm_itself():
    consistency = consistency_of()
    consistency.update([], STREET)
    for match in (9, 10, 11):
        assert not consistency.confirm(verified(110, match), STREET).accepted


def test_verified_edges_are_forgotten_in_time_and_at_a_reset():
    config = ConsistencyConfig(verified_memory=3)
    for forgets in ("time", "reset"):
        consistency = consistency_of(config)
        consistency.update([], STREET)
        consistency.confirm(verified(110, 10), STREET)
        if forgets == "time":
            for _ in range(4):
                consistency.update([], STREET)
        else:
            consistency.reset()
            consistency.update([], STREET)
        assert not consistency.confirm(verified(114, 14), STREET).accepted


def test_a_rejected_edge_stays_rejected_and_counts_for_nothing():
    consistency = consistency_of()
    consistency.update([], STREET)
    rejected = LoopEdge(110, 10, 0.5, False, "only 3 descriptors match")
    assert consistency.confirm(rejected, STREET) is rejected
    consistency.update([], STREET)
    assert not consistency.confirm(verified(111, 11), STREET).accepted


def test_a_revisit_of_twenty_metres_is_closed_within_it():
    # There is a keyframe every 3 m, and the detector misses every second one.
    consistency = consistency_of()
    closed_at = None
    for turn in range(7):
        query = 110 + turn
        found = candidates(query, 10 + turn) if turn % 2 == 0 else []
        doubts = consistency.update(found, STREET)
        for candidate in found:
            if candidate.match in doubts:
                continue
            if consistency.confirm(verified(query, candidate.match), STREET).accepted:
                closed_at = 3 * turn
                break
        if closed_at:
            break
    assert closed_at == 12
