"""The unit, the order and the rate of the times of frames."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from vslam.datasets.times import (
    UNITS,
    Timing,
    in_order,
    jitter_warnings,
    ordered_list,
    rate_text,
    read_times,
    times_of_names,
    unit_of_list,
)
from vslam.support.errors import BrokenSourceError, InputError

HERE = Path("here")
EVEN = [0.1 * k for k in range(40)]


def steps(first: int, step: float, n: int = 20) -> list[int]:
    """Return integers with steps that vary a little, as those of a real clock."""
    return [first + round(step * (k + 0.01 * (k % 3))) for k in range(n)]


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("hz", [10.0, 30.0, 120.0])
def test_names_that_are_dates_are_read_in_their_unit(unit, hz):
    per = UNITS[unit]
    names = [f"{n}" for n in steps(1_700_000_000 * per, per / hz)]
    if unit == "seconds":
        names = [f"{1_700_000_000 + k / hz:.6f}" for k in range(20)]
    times, remarks = times_of_names(names, HERE)
    assert times[0] == pytest.approx(1.7e9)
    assert np.median(np.diff(times)) == pytest.approx(1 / hz, rel=0.05)
    assert remarks == []


@pytest.mark.parametrize("unit", ["microseconds", "nanoseconds"])
@pytest.mark.parametrize("uptime_s", [312.0, 1800.0, 90_000.0, 5e5])
@pytest.mark.parametrize("hz", [9.6, 60.0])
def test_names_that_count_from_the_start_of_the_camera_are_read_by_their_rate(unit, uptime_s, hz):
    per = UNITS[unit]
    names = [f"{n}" for n in steps(round(uptime_s * per), per / hz)]
    times, (remark,) = times_of_names(names, HERE)
    assert times[0] == pytest.approx(uptime_s)
    assert np.median(np.diff(times)) == pytest.approx(1 / hz, rel=0.05)
    said, _, rate = remark.partition(": the names are read as ")[2].partition(": ")
    assert said == unit
    assert float(rate.removesuffix(" Hz; give --fps if this is wrong.")) == pytest.approx(hz, 0.05)


def test_names_that_cross_a_power_of_ten_have_one_unit():
    names = [f"{n}" for n in steps(99_500_000_000, 1e8)]
    times, _ = times_of_names(names, HERE)
    assert np.median(np.diff(times)) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(
    "names",
    [
        [f"{k:06d}" for k in range(20)],
        [f"{k}" for k in range(1100, 1200, 5)],
        [f"{k}" for k in range(0, 60_000, 3000)],
        ["20231114", "20231115", "20231116"],
        ["a", "1700000000"],
    ],
)
def test_names_that_number_the_frames_are_no_times(names):
    assert times_of_names(names, HERE) is None


@pytest.mark.parametrize(("step_s", "unit"), [(60, "seconds"), (600, "milliseconds")])
def test_a_time_lapse_with_dates_is_read_as_today_and_is_named(step_s, unit):
    per = UNITS[unit]
    names = [f"{1_700_000_000 * per + step_s * per * k}" for k in range(9)]
    times, (remark,) = times_of_names(names, HERE)
    assert times.tolist() == [1_700_000_000 + step_s * k for k in range(9)]
    assert f"read as {unit} since 1970: one frame every {step_s} s" in remark


def test_names_that_no_camera_can_have_are_refused():
    clock = [f"2023111415301{k}" for k in range(9)]  # a date and time in decimal digits
    with pytest.raises(InputError, match=r"here: the names increase in steps of 1, .*; give --fps"):
        times_of_names(clock, HERE)


@pytest.mark.parametrize("usual", ["seconds", "nanoseconds"])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("first", [0.0, 312.0, 1.7e9])
@pytest.mark.parametrize("hz", [1.4, 10.0, 100.0])  # 1 Hz in us could be 1000 Hz in ns
def test_lists_are_read_in_the_unit_that_gives_a_frame_rate(usual, unit, first, hz):
    numbers = [(first + (k + 0.01 * (k % 2)) / hz) * UNITS[unit] for k in range(30)]
    found, timing = unit_of_list(numbers, HERE, usual, "correct them")
    assert found == unit
    assert bool(timing.remarks) == (unit != usual)
    assert all(f"the times are read as {unit}" in remark for remark in timing.remarks)


@pytest.mark.parametrize("step", [0.001, 0.1036, 1.5, 5.0, 10.0])
@pytest.mark.parametrize("first", [0.0, 1e7, 1.7e9])
def test_lists_in_their_usual_unit_stay_as_they_are(step, first):
    numbers = [first + step * k for k in range(9)]
    assert unit_of_list(numbers, HERE, "seconds", "") == ("seconds", Timing("here", []))


@pytest.mark.parametrize("numbers", [[0, 1, 2, 3], [1.0, 2.0, 4.0, 5.0, 6.0], [1100, 1101, 1102]])
@pytest.mark.parametrize("usual", ["seconds", "nanoseconds"])
def test_the_numbers_of_frames_are_no_list_of_times(numbers, usual):
    with pytest.raises(
        InputError, match=r"here: \d+, \d+, \d+, \.\.\. look like the numbers of frames"
    ):
        unit_of_list(numbers, HERE, usual, "give --fps")


def test_whole_seconds_are_not_the_numbers_of_frames():
    """A clock that counts seconds gives ten frames the same time."""
    assert unit_of_list([k // 10 for k in range(60)], HERE, "seconds", "")[0] == "seconds"


def test_a_list_that_no_camera_can_have_is_refused():
    with pytest.raises(InputError, match=r"here: the times increase in steps of 1e-05, .*; fix it"):
        unit_of_list([1e-5 * k for k in range(9)], HERE, "seconds", "fix it")


def order(times, timing=None):
    timing = Timing("x") if timing is None else timing
    found = list(in_order(zip(times, range(len(times)), strict=True), timing))
    return [time for time, _ in found], [k for _, k in found], timing


def test_increasing_times_pass_unchanged():
    gaps = np.cumsum(np.random.default_rng(0).choice([0.001, 0.1, 0.1, 0.1, 3.0], 200)).tolist()
    for times in (EVEN, gaps, [5.0], []):
        found, kept, timing = order(times)
        assert found == times
        assert kept == list(range(len(times)))
        assert timing.measured == ""


@pytest.mark.parametrize(
    ("at", "by"),
    [
        *((at, by) for at in (1, 2, 20, 37) for by in (30.0, 1.7e9)),
        (20, 0.25),
        (20, 0.7),
        (37, 0.7),
    ],
)
def test_a_clock_that_was_set_back_does_not_end_the_drive(at, by):
    times, kept, timing = order([time - by * (k >= at) for k, time in enumerate(EVEN)])
    assert kept == list(range(40))
    np.testing.assert_allclose(np.diff(times), 0.1, rtol=1e-5)
    ((before, back),) = timing.set_back
    assert (before, back) == pytest.approx((EVEN[at - 1], by), rel=1e-6)
    assert timing.left_out == []
    assert f"the clock was set back by {by:.3g} s after {EVEN[at - 1]:.3f} s" in timing.measured


def test_integers_stay_exact():
    stamps = [1_403_636_579_763_555_584 + 50_000_001 * k - 10**12 * (k >= 20) for k in range(40)]
    times, _, timing = order(stamps)
    assert set(np.diff(np.array(times, np.int64)).tolist()) == {50_000_001}
    assert len(timing.set_back) == 1


def test_repeated_frames_and_frames_out_of_order_are_left_out_and_counted():
    indices = [0, 1, 2, 3, 3, 4, 5, 7, 6, 8, 8, 8, 9, 10, 11]
    times, kept, timing = order([0.1 * k for k in indices])
    assert times == [0.1 * k for k in (0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11)]
    assert kept == [0, 1, 2, 3, 5, 6, 7, 9, 12, 13, 14]
    assert [same for _, same in timing.left_out] == [True, False, True, True]
    assert timing.measured == (
        "4 frames left out (3 with the time of the frame before and 1 with a wrong or earlier "
        "time), the first after 0.300 s"
    )
    assert timing.set_back == []


def test_a_burst_of_late_frames_is_no_clock_that_was_set_back():
    times, _, timing = order([0.1 * k for k in [*range(10), 12, 10, 11, *range(13, 20)]])
    assert times == [0.1 * k for k in [*range(10), 12, *range(13, 20)]]
    assert (len(timing.left_out), timing.set_back) == (2, [])


def test_one_time_in_the_future_costs_one_frame():
    times, kept, timing = order([5e3 if k == 7 else time for k, time in enumerate(EVEN)])
    assert kept == [k for k in range(40) if k != 7]
    assert times == [time for k, time in enumerate(EVEN) if k != 7]
    assert len(timing.left_out) == 1


def test_two_clocks_that_alternate_cost_the_frames_of_one():
    _, kept, timing = order([time - 30.0 * (k % 2) for k, time in enumerate(EVEN)])
    assert kept == list(range(0, 40, 2))
    assert len(timing.left_out) == 20


def test_frames_before_a_failure_come_first():
    def play():
        yield from enumerate([0.0, 0.1, 0.2, 0.3, 5.0])
        raise BrokenSourceError("x: unplugged.")

    found = []
    with pytest.raises(BrokenSourceError):
        found.extend(in_order(((time, k) for k, time in play()), Timing("x")))
    frames = in_order(((time, k) for k, time in play()), Timing("x"))
    assert [k for _, k in islice(frames, 5)] == [0, 1, 2, 3, 4]


def test_a_stream_is_counted_anew():
    timing = Timing("x")
    for _ in range(2):
        order([*EVEN[:20], EVEN[10], *EVEN[20:], EVEN[39]], timing)
    assert len(timing.left_out) == 2
    assert timing.warnings() == [f"x: {timing.measured}."]


def test_what_both_lists_say_is_said_once():
    timing = order([*EVEN[:20], *EVEN[:20]], Timing("x"))[2]
    timing.add(order([*EVEN[:20], *EVEN[:20]], Timing("y", ["y: in milliseconds."]))[2])
    assert timing.warnings() == ["y: in milliseconds.", f"x: {timing.measured}."]
    alone = Timing("x")
    alone.add(timing)
    assert "the clock was set back by 2 s" in alone.measured


def test_a_list_of_which_much_would_be_left_out_is_refused():
    times, kept = ordered_list([*EVEN[:20], EVEN[19], *EVEN[20:]], Timing("x"), "fix it")
    assert (times, len(kept)) == (EVEN, 40)
    with pytest.raises(InputError, match=r"x: 19 of 40 times .*\(time 3 is the first\); fix it"):
        ordered_list([float(k // 2) for k in range(1, 41)], Timing("x"), "fix it")


def test_stamps_of_arrival_are_named():
    arrival = np.cumsum(np.tile([0.058, 0.058, 0.023, 0.001], 30))
    (said,) = jitter_warnings(arrival, "x")
    assert said.startswith("x: the steps between the times vary by 4")
    assert "(1 to 58 ms), as if the frames were stamped when they arrived" in said
    exposed = np.cumsum(np.random.default_rng(0).normal(0.033, 0.002, 200))
    assert jitter_warnings(exposed, "x") == []
    assert jitter_warnings(np.delete(exposed, slice(20, 200, 9)), "x") == []


@pytest.mark.parametrize(
    ("interval_s", "text"),
    [(1 / 9.6, "9.6 Hz"), (2.0, "0.50 Hz"), (60.0, "one frame every 60 s"), (0.001, "1000.0 Hz")],
)
def test_a_rate_is_never_zero(interval_s, text):
    assert rate_text(interval_s) == text


def test_a_list_of_dates_in_which_one_line_is_no_date(tmp_path):
    path = tmp_path / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.25\n\n2011-09-26 13:02:2x\n")
    with pytest.raises(InputError, match="line 3 is not a date and time, unlike the lines before"):
        read_times(path)
    path.write_bytes("time\r\n2011/09/26 13:02:25.25\r\n".encode("utf-16"))
    assert read_times(path).tolist() == [1317042145.25]
