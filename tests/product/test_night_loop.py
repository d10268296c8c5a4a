"""A loop at night is closed by the shipped network, but not by the bag of words.

This is the purpose of the whole system, tested from end to end.
"""

from __future__ import annotations

import numpy as np
import pytest

from vslam.datasets.perturbation import parse_perturbation
from vslam.evaluation.loops import evaluate_loops
from vslam.run.options import RunOptions
from vslam.run.pipeline import run_sequence
from vslam.run.recorder import Recorder
from vslam.run.slam_run import begin
from vslam.slam import Slam

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def compared(round_the_block):
    """The drive with the default detector, which is compared with ``bow``."""
    settings = RunOptions(threads=2, compare=("bow",))
    return run_sequence(begin(round_the_block, settings), parse_perturbation("none", 0), Recorder())


def test_the_default_closes_a_loop_by_night_that_the_bag_of_words_misses(compared):
    (bow,) = compared.compared
    by_default, by_words = evaluate_loops(compared), evaluate_loops(bow)
    assert (by_default.n_found, by_default.n_missed, by_default.n_wrong) == (1, 0, 0)
    assert (by_words.n_found, by_words.n_missed, by_words.n_wrong) == (0, 1, 0)
    for outcome in (compared, bow):
        assert all(track.state != "LOST" for track in outcome.tracks)


def test_the_loop_says_that_the_network_found_and_verified_it(compared):
    closed = [edge for edge in compared.loops if edge.accepted]
    (edge,) = closed
    assert "capsule" in edge.proposed_by
    assert edge.matched_by == "learned"


def test_the_library_closes_it_without_being_told_how(round_the_block, compared):
    """``Slam(camera)`` gives a trajectory that is byte-identical to that of the command."""
    slam = Slam(round_the_block.camera)
    for k, timestamp in enumerate(round_the_block.timestamps):
        left, right = round_the_block.read(k)
        slam.step(left, right, timestamp)
    slam.finish()
    assert len(slam.corrections) == 1
    np.testing.assert_array_equal(slam.trajectory().T_wc, compared.trajectory.T_wc)
