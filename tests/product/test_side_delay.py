"""The delay of the right image is measured from the rows of stereo matches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import corridor_mipmaps, render
from scipy.spatial.transform import Rotation

from vslam.config import Config
from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.perturbation import parse_perturbation
from vslam.doctor.examine import examine
from vslam.run.options import RunOptions
from vslam.run.pair import PairCheck
from vslam.run.side_delay import SideDelay, delay_warnings, fit_delay, measure_delay
from vslam.slam import Slam
from vslam.support.errors import UnreadableImageError
from vslam.types.camera import Camera
from vslam.types.geometry import se3_exp

CAMERA = Camera(240.0, 240.0, 159.5, 79.5, 0.5, 320, 160)
CONFIG = Config().stereo
STEP_S = 0.1


def points(delay: float, k: int, n: int = 200) -> np.ndarray:
    """Return what ``fit_delay`` needs of points that a car sees whose right camera is late. The car
    moves ahead with varying speed, nods and turns."""
    rng = np.random.default_rng(k)
    t = STEP_S * k
    twist = np.array([0, 0, -8 - 2 * np.sin(t), 0.05 * np.sin(3 * t), 0.2 * np.sin(t), 0])
    xy = rng.uniform(-1.0, 1.0, (n, 2))
    rays = np.column_stack([xy * [CAMERA.width, CAMERA.height] / (2 * CAMERA.fx), np.ones(n)])
    seen = rng.uniform(4.0, 40.0, (n, 1)) * rays

    def rows(later: float) -> np.ndarray:
        T = se3_exp(twist * later)
        p = seen @ T[:3, :3].T + T[:3, 3]
        return CAMERA.fy * p[:, 1] / p[:, 2]

    offset = rows(delay) - rows(0.0) + rng.normal(0.0, 0.1, n)
    disparity = CAMERA.bf / seen[:, 2] / CAMERA.width
    return np.column_stack([offset, (rows(0.01) - rows(-0.01)) / 0.02, xy, disparity])


@pytest.mark.parametrize("delay", [-8e-3, 3e-3, 12e-3])
def test_a_delay_is_measured_and_reported_unless_the_calibration_gives_it(delay):
    found = fit_delay([points(delay, k) for k in range(0, 80, 4)])
    assert found.seconds == pytest.approx(delay, abs=4 * found.sigma)
    assert 0.0 < found.sigma < 0.3e-3
    assert found.is_wrong(CAMERA, CONFIG)
    assert not found.is_wrong(replace(CAMERA, right_delay=delay), CONFIG)


def test_nothing_is_said_of_a_rig_whose_rows_do_not_correspond():
    several = [points(0.0, k) for k in range(0, 80, 4)]
    for k, one in enumerate(several):
        x, y, disparity = one[:, 2:].T
        one[:, 0] += 0.5 * x - 0.7 * x * y**2 + 0.2 * (-1) ** k  # turned, distorted, vibrating
        one[:, 0] += (3.0 - 5.0 * y) * disparity  # displaced
    found = fit_delay(several)
    assert abs(found.seconds) < 0.3e-3
    assert not found.is_wrong(CAMERA, CONFIG)


def test_a_few_frames_are_not_believed():
    several = [points(8e-3, k) for k in range(9)]
    assert fit_delay([*several, np.zeros((0, 5))]) is None
    assert measure_delay([late_frame(0.0, k) for k in range(49)], 49) is None


def test_contradicting_frames_are_doubted():
    """A delay in only every other frame is not a property of the rig."""
    found = fit_delay([points(6e-3 * (k % 2), k) for k in range(0, 80, 5)])
    assert found.seconds > 0.0012
    assert not found.is_wrong(CAMERA, CONFIG)


MIPMAPS = corridor_mipmaps()


def pose(t: float) -> np.ndarray:
    """Return ``T_wc`` of a camera that drives along the corridor and nods, after t seconds."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("x", 0.06 * np.sin(4.0 * t)).as_matrix()
    T[2, 3] = 3.0 * t + 0.5 * np.sin(2.0 * t)
    return T


def late_frame(delay: float, k: int, damaged: bool = False) -> TimedFrame:
    """Return a frame whose images are rendered when they are read."""
    T_left_right = np.eye(4)
    T_left_right[0, 3] = CAMERA.baseline

    def left() -> np.ndarray:
        if damaged:
            raise UnreadableImageError(Path("a.png"), "damaged")
        return render(MIPMAPS, CAMERA, pose(STEP_S * k))

    def right() -> np.ndarray:
        return render(MIPMAPS, CAMERA, pose(STEP_S * k + delay) @ T_left_right)

    return TimedFrame(STEP_S * k, lambda image_map: (left(), right()), (left, right))


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 6e-3, -10e-3])
def test_the_delay_of_images_is_measured(delay):
    frames = [late_frame(delay, k, damaged=k == 1) for k in range(60)]
    found = measure_delay(frames, len(frames))
    assert found.seconds == pytest.approx(delay, abs=1e-3)
    assert found.is_wrong(CAMERA, CONFIG) is (delay != 0.0)


@pytest.mark.parametrize("image", [np.zeros((160, 320), np.uint8), None], ids=["black", "still"])
def test_images_without_motion_are_not_measured(image):
    if image is None:
        image = render(MIPMAPS, CAMERA, pose(0.0))
    frames = [TimedFrame(STEP_S * k, lambda image_map: (image, image)) for k in range(60)]
    assert measure_delay(frames, len(frames)) is None


def source(delay: float) -> Source:
    stored = tuple(late_frame(delay, k) for k in range(60))
    return Source(dataset="images", name="late", camera=CAMERA, stored=stored)


def said_at_the_end(source: Source, perturb: str = "none", n_frames: int = 60) -> str:
    check = PairCheck(CAMERA, "images", RunOptions())
    check.end(source, parse_perturbation(perturb, 0).bound_to(source), n_frames)
    return "".join(check.warnings())


@pytest.mark.slow
def test_the_end_of_a_run_reports_a_late_camera():
    late = source(8e-3)
    assert "the right camera is 8." in said_at_the_end(late)
    assert said_at_the_end(late, n_frames=49) == ""
    assert said_at_the_end(replace(late, live=True)) == ""
    assert said_at_the_end(source(0.0)) == ""
    assert "the right camera is" in said_at_the_end(source(0.0), "desync:10")


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 4e-3])
def test_the_delay_is_measured_in_the_images_only_if_the_map_does_not_rule_it_out(
    delay, monkeypatch
):
    def turning(t: float) -> np.ndarray:
        T = ahead(t)
        T[:3, :3] = Rotation.from_euler("y", 0.15 * np.sin(4.0 * t)).as_matrix() @ T[:3, :3]
        return T

    ahead = pose
    monkeypatch.setitem(globals(), "pose", turning)
    slam, late = Slam(CAMERA, detector="none", threads=1), source(delay)
    for frame in late.stored:
        slam.step(*frame.read(map), frame.timestamp)
    slam.finish()
    measured: list[int] = []
    monkeypatch.setattr(
        "vslam.run.pair.measure_delay", lambda frames, n: measured.append(n) or None
    )
    check = PairCheck(CAMERA, "images", RunOptions())
    check.end(late, parse_perturbation("none", 0).bound_to(late), 60, slam.map)
    assert measured == ([60] if delay else [])
    check.end(late, parse_perturbation("none", 0).bound_to(late), 60)
    assert len(measured) == (2 if delay else 1)  # without a map
    assert check.warnings() == []


def test_a_measurement_that_fails_does_not_end_the_run():
    frames = (TimedFrame(STEP_S * k, lambda image_map: 1 / 0) for k in range(60))
    said = said_at_the_end(replace(source(0.0), stored=tuple(frames)))
    assert "could not be measured (ZeroDivisionError" in said


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "verdict"), [(0.0, "good"), (-8e-3, "fault")])
def test_the_doctor_reports_a_late_camera(delay, verdict):
    (finding,) = (f for f in examine(source(delay), Config()).findings if f.check == "delay")
    assert finding.verdict == verdict
    assert ("the left camera is 8." in finding.measured) is (verdict == "fault")
    assert finding.fix.startswith("trigger both" if delay else "")


def test_the_warning_says_what_to_write_into_the_calibration():
    (said,) = delay_warnings(SideDelay(4.68e-3, 1e-4), CAMERA, CONFIG)
    assert "the right camera is 4.7 ms late. Trigger both" in said
    assert "right_delay: 0.0047 (seconds) into the file that --calib names" in said
    known = replace(CAMERA, right_delay=3e-3)
    (said,) = delay_warnings(SideDelay(-2e-3, 1e-4), known, CONFIG)
    assert "the left camera is 2.0 ms late instead of 3.0 ms (right_delay). " in said
    assert "right_delay: -0.0020" in said
    assert delay_warnings(SideDelay(1e-3, 1e-4), CAMERA, CONFIG) == []
    assert delay_warnings(None, CAMERA, CONFIG) == []
