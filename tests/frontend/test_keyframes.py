"""Each condition of the keyframe decision is tested from both sides of its threshold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import CAMERA, Points

from vslam.config import Config, KeyframeConfig
from vslam.frontend.keyframes import (
    KeyframeEvidence,
    KeyframePolicy,
    count_close,
    needs_keyframe,
    needs_monocular_keyframe,
)
from vslam.types.context import Context
from vslam.types.track import Track

CONFIG = KeyframeConfig(
    max_interval_s=1.0,
    min_tracked_close=100,
    min_new_close=70,
    max_tracked_ratio=0.75,
)
CONTENT = KeyframeEvidence(
    seconds_since_keyframe=0.3,
    n_inliers=190,
    n_reference=200,
    tracked_close=150,
    untracked_close=200,
    mapping_idle=True,
)


def decide(**changes) -> bool:
    return needs_keyframe(replace(CONTENT, **changes), CONFIG)


def test_a_well_tracked_frame_is_no_keyframe():
    assert not decide()
    assert not decide(mapping_idle=False)


def test_a_frame_without_features_is_judged_by_the_close_points_that_are_left():
    by_patches = {"untracked_close": None, "first_close": 900}
    assert not decide(**by_patches, tracked_close=800)
    assert decide(**by_patches, tracked_close=int(CONFIG.patch_kept_close * 900) - 1)
    assert not decide(**by_patches, tracked_close=int(CONFIG.patch_kept_close * 900))
    assert not decide(first_close=900, tracked_close=101)  # the image has features


@pytest.mark.parametrize("idle", [True, False])
def test_time_alone_makes_a_keyframe(idle):
    assert not decide(seconds_since_keyframe=0.999, mapping_idle=idle)
    assert decide(seconds_since_keyframe=1.0, mapping_idle=idle)


def test_losing_a_quarter_of_the_reference_makes_a_keyframe():
    assert not decide(n_inliers=150)
    assert decide(n_inliers=149)


def test_having_moved_on_waits_for_mapping():
    assert not decide(n_inliers=149, mapping_idle=False)


def test_losing_three_quarters_of_the_reference_does_not_wait():
    assert not decide(n_inliers=50, mapping_idle=False)
    assert decide(n_inliers=49, mapping_idle=False)


@pytest.mark.parametrize("idle", [True, False])
def test_few_close_points_with_new_ones_in_sight_make_a_keyframe_at_once(idle):
    assert decide(tracked_close=99, untracked_close=71, mapping_idle=idle)
    assert not decide(tracked_close=100, untracked_close=71, mapping_idle=idle)
    assert not decide(tracked_close=99, untracked_close=70, mapping_idle=idle)


def test_where_keyframes_bring_few_close_points_losing_most_of_those_makes_one():
    few = {"gained_close": 80.0, "untracked_close": 300}
    assert not decide(tracked_close=16, **few)
    assert decide(tracked_close=15, **few)
    assert not decide(tracked_close=15, gained_close=80.0, untracked_close=70)
    # In fog, there are no far points that would constrain the pose.
    assert decide(tracked_close=16, n_inliers=115, n_reference=100, **few)
    assert not decide(tracked_close=16, n_inliers=116, n_reference=100, **few)
    # If keyframes bring enough close points, all of these are wanted.
    assert decide(tracked_close=99, gained_close=100.0)


def test_that_close_points_are_few_by_nature_takes_several_keyframes_to_show():
    state, means = policy().state, []
    for _ in range(6):
        state = count_close(replace(state, gain_awaited=True), 50, 1)
        state = count_close(state, 3, 2)  # later frames do not count
        means.append(state.gained_close)
    np.testing.assert_allclose(means, 50 + 150 * 0.8 ** np.arange(1, 7), rtol=1e-12)
    assert [mean < 100 for mean in means] == [False] * 4 + [True] * 2


def test_thresholds_come_from_the_configuration():
    evidence = replace(CONTENT, n_inliers=149)
    assert not needs_keyframe(evidence, CONFIG.model_copy(update={"max_tracked_ratio": 0.5}))
    assert needs_keyframe(CONTENT, CONFIG.model_copy(update={"max_interval_s": 0.2}))


def decide_monocular(**changes) -> bool:
    config = CONFIG.model_copy(update={"monocular_ratio": 0.9})
    return needs_monocular_keyframe(replace(CONTENT, **changes), config)


def test_one_camera_needs_a_keyframe_once_a_tenth_of_the_reference_is_gone():
    assert not decide_monocular(n_inliers=180)
    assert decide_monocular(n_inliers=179)
    assert not decide_monocular(n_inliers=179, mapping_idle=False)


def test_one_camera_does_not_wait_where_half_is_gone_or_little_is_left():
    assert not decide_monocular(n_inliers=100, mapping_idle=False)
    assert decide_monocular(n_inliers=99, mapping_idle=False)
    assert not decide_monocular(n_inliers=100, n_reference=120, mapping_idle=False)
    assert decide_monocular(n_inliers=99, n_reference=120, mapping_idle=False)


def test_one_camera_needs_no_keyframe_by_time_alone():
    assert not decide_monocular(seconds_since_keyframe=60.0)
    assert decide_monocular(seconds_since_keyframe=1.0, n_inliers=179, mapping_idle=False)


def test_one_camera_without_features_needs_a_keyframe_once_a_fifth_is_gone_or_little_is_left():
    first = {"untracked_close": None, "first_close": 400, "n_reference": 1000}
    assert not decide_monocular(**first, n_inliers=320)
    assert decide_monocular(**first, n_inliers=319)
    assert not decide_monocular(**first, n_inliers=20, mapping_idle=False)
    assert not decide_monocular(**{**first, "first_close": 0}, n_inliers=100)
    assert decide_monocular(**{**first, "first_close": 110}, n_inliers=99)


def test_one_camera_counts_what_is_left_of_the_newest_landmarks_once_they_are_mapped():
    one = KeyframePolicy(Context.create(CAMERA.left_camera(), Config()))
    one.reference_renewed()
    before = observe(one, frame(close=10), mapping_idle=False)
    assert (before.tracked_close, before.first_close) == (10, 0)
    after = observe(one, frame(close=40), mapping_idle=True)
    assert (after.tracked_close, after.first_close) == (40, 40)
    assert observe(one, frame(close=30), mapping_idle=True).first_close == 40


KNOWN = {"n_inliers": 150, "n_shared": 100, "n_place": 200}


@pytest.mark.parametrize(("changes", "known"), [
    ({}, True),
    ({"n_inliers": 149}, False),
    ({"n_shared": 99}, False),
    ({"n_place": 10, "n_inliers": 50, "n_shared": 5}, True),
    ({"n_place": 10, "n_inliers": 49, "n_shared": 49}, False),  # at the end of a map
])  # fmt: skip
def test_a_place_is_known_that_is_tracked_like_its_old_keyframe(changes, known):
    config = Config(keyframes=KeyframeConfig(max_tracked_ratio=0.75, known_ratio=0.5))
    decides = KeyframePolicy(Context.create(CAMERA, config))
    assert decides.is_known(**KNOWN | changes) == known


# -- the policy -----------------------------------------------------------------------------------

POINTS = Points.create()  # 16 to 30 m away; those nearer than 20 m are close
CLOSE = np.count_nonzero(POINTS.xyz[:, 2] < 20.0)


def policy(camera=CAMERA) -> KeyframePolicy:
    return KeyframePolicy(Context.create(camera, Config(keyframes=CONFIG)))


def frame(*, close: int, far: int = 0) -> Track:
    tracked = POINTS.tracked_frame(3, 0.3, np.eye(4))
    is_close = POINTS.xyz[:, 2] < 20.0
    for among, n in ((is_close, close), (~is_close, far)):
        tracked = tracked.without(np.flatnonzero(among)[n:])
    return tracked


def observe(of: KeyframePolicy, seen: Track, **changes) -> KeyframeEvidence:
    """Return the decision of a policy about a frame 0.3 s after a keyframe. Mapping is idle."""
    known = {"seconds_since_keyframe": 0.3, "mapping_idle": True}
    return of.observe(seen, POINTS.view(n_reference=200), **known | changes)


def test_evidence_is_counted_in_the_frame_and_taken_from_the_view():
    evidence = observe(policy(), frame(close=20, far=30))
    assert 20 < CLOSE < 100
    assert evidence == KeyframeEvidence(
        seconds_since_keyframe=0.3,
        n_inliers=50,
        n_reference=200,
        tracked_close=20,
        untracked_close=CLOSE - 20,
        mapping_idle=True,
        gained_close=200.0,  # first_gain times min_tracked_close
    )
    changed = observe(policy(), frame(close=0), seconds_since_keyframe=0.7, mapping_idle=False)
    assert (changed.seconds_since_keyframe, changed.mapping_idle) == (0.7, False)


def test_points_without_a_depth_are_not_close():
    seen = frame(close=20)
    near = np.flatnonzero(POINTS.xyz[:, 2] < 20.0)
    seen.features.u_right[near[:5]] = np.nan
    evidence = observe(policy(), seen)
    assert (evidence.n_inliers, evidence.tracked_close) == (20, 15)
    assert evidence.untracked_close == CLOSE - 20


def test_only_the_first_frame_after_a_keyframe_tells_what_keyframes_gain():
    one = policy()
    assert observe(one, frame(close=10)).gained_close == 200.0  # no keyframe was made
    one.reference_renewed()
    # The value counts at once. It is a fifth of the way from 200 to 10.
    assert observe(one, frame(close=10)).gained_close == pytest.approx(162.0)
    assert observe(one, frame(close=40)).gained_close == pytest.approx(162.0)


def test_a_keyframe_is_planned_for_the_frame_that_will_have_lost_too_many_close_points():
    """The limit is 0.4 of the 1,000 close points, which is 400.

    Each frame tracks 0.8 of the close points of the previous frame.
    """
    one = policy()
    losing = replace(
        CONTENT, untracked_close=None, first_close=1000, n_inliers=900, close_ratio=0.8
    )
    assert not one.is_due(10, replace(losing, tracked_close=640))
    assert one.due == -1
    assert not one.is_due(11, replace(losing, tracked_close=610))
    assert one.due == 13
    assert not one.is_due(12, CONTENT)
    assert one.is_due(13, CONTENT)
    assert one.due == -1
    assert not one.is_due(14, replace(losing, tracked_close=490))
    assert one.due == 15
    one.reference_renewed()
    assert one.is_due(16, replace(losing, tracked_close=390))  # there is no time to plan


@pytest.mark.parametrize(("n_inliers", "at_once"), [(99, True), (100, False)])
def test_a_planned_keyframe_is_made_at_once_if_few_landmarks_are_left(n_inliers, at_once):
    one = policy()
    losing = replace(CONTENT, untracked_close=None, close_ratio=0.8)
    assert not one.is_due(10, replace(losing, tracked_close=150))
    assert one.due == 12
    few = replace(losing, n_inliers=n_inliers, tracked_close=min(n_inliers, 99))
    assert one.is_due(11, few) is at_once


def test_close_points_are_lost_from_the_first_frame_after_a_keyframe_on():
    one = policy()
    one.reference_renewed()
    seen = frame(close=20)
    assert observe(one, seen).close_ratio == 1.0
    seen = replace(frame(close=5), index=5)
    assert observe(one, seen).close_ratio == pytest.approx(0.5)
    assert observe(one, frame(close=0)).close_ratio == 1.0  # a value of 1 disables the share


@pytest.mark.parametrize("awaited", [True, False])
def test_deciding_changes_nothing(awaited):
    one = policy()
    if awaited:
        one.reference_renewed()
    before = one.state
    assert not one.wants_keyframe(CONTENT)
    assert one.wants_keyframe(replace(CONTENT, seconds_since_keyframe=1.0))
    assert not one.is_known(**KNOWN | {"n_shared": 0})
    assert one.is_known(**KNOWN)
    assert one.state == before
    observe(one, frame(close=10))
    assert (one.state != before) == awaited


@pytest.mark.parametrize(("changes", "wanted"), [
    ({}, False),
    ({"seconds_since_keyframe": 0.999}, False),
    ({"seconds_since_keyframe": 1.0}, True),
    ({"n_inliers": 150}, False),
    ({"n_inliers": 149}, True),
    ({"n_inliers": 149, "mapping_idle": False}, False),
    ({"n_inliers": 49, "mapping_idle": False}, True),
    ({"tracked_close": 99, "untracked_close": 70}, False),
    ({"tracked_close": 99, "untracked_close": 71, "mapping_idle": False}, True),
])  # fmt: skip
def test_a_policy_decides_for_a_stereo_pair(changes, wanted):
    assert policy().wants_keyframe(replace(CONTENT, **changes)) == wanted


@pytest.mark.parametrize(("changes", "wanted"), [
    ({"seconds_since_keyframe": 0.299}, False),
    ({"seconds_since_keyframe": 0.3}, True),
])  # fmt: skip
def test_a_policy_makes_keyframes_of_a_depth_camera_sooner(changes, wanted):
    """The threshold ``depth_max_interval_s`` is 0.3 s."""
    assert policy(replace(CAMERA, depth=True)).wants_keyframe(replace(CONTENT, **changes)) == wanted


@pytest.mark.parametrize(("changes", "wanted"), [
    ({"n_inliers": 180, "seconds_since_keyframe": 60.0}, False),
    ({"n_inliers": 179}, True),
    ({"n_inliers": 179, "mapping_idle": False}, False),
    ({"n_inliers": 99, "mapping_idle": False}, True),
])  # fmt: skip
def test_a_policy_decides_for_one_camera(changes, wanted):
    one = policy(CAMERA.left_camera())
    assert one.wants_keyframe(replace(CONTENT, **changes)) == wanted


@pytest.mark.parametrize(("n_shared", "known"), [(100, True), (99, False)])
def test_a_policy_knows_a_place_by_what_it_shares(n_shared, known):
    assert policy().is_known(**KNOWN | {"n_shared": n_shared}) == known
