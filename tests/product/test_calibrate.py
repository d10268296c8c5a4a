"""``vslam calibrate`` on rendered boards with known ground truth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_boards import Renderer, texture
from source_files import write_images, write_video

from vslam.calibration.boards import (
    Board,
    View,
    board_points,
    find_corners,
    other_board,
    read_board,
    same_order,
)
from vslam.calibration.files import read_calibration, write_calibration
from vslam.calibration.models import Calibration, CameraModel, project, unproject
from vslam.calibration.solve import Estimate, diverse, fit_camera, fit_pair
from vslam.cli.calibrate import _frames
from vslam.datasets.frames import RawSource, TimedFrame
from vslam.doctor.calibration_page import findings_of
from vslam.support.errors import BrokenSourceError, InputError
from vslam.types.geometry import transform

PINHOLE = CameraModel(
    300.0, 300.6, 193.2, 142.8, 384, 288, "pinhole", (-0.25, 0.07, 0.0005, -0.0004)
)
FISHEYE = CameraModel(150.0, 150.6, 193.2, 142.8, 384, 288, "fisheye", (0.02, -0.01, 0.003, -0.001))
CHECKERBOARD = Board("checkerboard", 9, 6, 0.03)
CHARUCO = Board("charuco", 7, 5, 0.04, 0.03, "4X4_50")
APRILGRID = Board("aprilgrid", 4, 3, 0.078, 0.06)
KALIBR = "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.06\ntagSpacing: 0.3\n"
T_LEFT_RIGHT = np.eye(4)
T_LEFT_RIGHT[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
T_LEFT_RIGHT[:3, 3] = 0.06, 0.001, -0.002


def poses(board: Board, model: CameraModel, n: int) -> list[np.ndarray]:
    """Return ``T_camera_board`` of views in all parts of the image, tilted in all directions."""
    points = board_points(board)
    middle, extent = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    upright = np.diag([1.0, -1.0, -1.0]) if board.kind == "aprilgrid" else np.eye(3)
    found = []
    for k in range(n):
        x, y = (-0.18, 0.0, 0.18)[k % 3], (-0.15, 0.15, 0.0)[k // 3 % 3]
        xy = np.array([[model.cx + x * model.width, model.cy + y * model.height]])
        ray = unproject(model, xy)[0]
        angle = 2.4 * k  # the golden angle
        tilt = cv2.Rodrigues(0.55 * np.array([np.cos(angle), np.sin(angle), 0.2]))[0]
        # A board off the axis is rotated towards the camera, so that all of it is visible.
        R = cv2.Rodrigues(np.cross([0, 0, 1], ray))[0] @ tilt @ upright
        T = np.eye(4)
        reach = (1.15 + 0.1 * (k % 2)) * model.fx * extent / (0.6 * model.width)
        T[:3, :3], T[:3, 3] = R, reach * ray - R @ middle
        found.append(T)
    return found


def rendered(board: Board, model: CameraModel, views: list[np.ndarray], seed: int) -> list:
    renderer, rng = Renderer(board, model), np.random.default_rng(seed)
    return [renderer.image(T, rng) for T in views]


def exact_views(board: Board, model: CameraModel, poses: list[np.ndarray]) -> list[View]:
    rng, points = np.random.default_rng(0), board_points(board)
    found = []
    for k, T in enumerate(poses):
        xy = project(model, transform(T, points))
        found.append(View(str(k), np.arange(len(xy)), xy + rng.normal(0.0, 0.05, xy.shape)))
    return found


@pytest.fixture
def calibrate(call):
    """Run ``vslam calibrate`` in an empty folder. Return the exit code, stdout and stderr."""
    return partial(call, "calibrate")


def check_camera(found: CameraModel, truth: CameraModel) -> None:
    assert (found.width, found.height, found.lens) == (truth.width, truth.height, truth.lens)
    assert [found.fx, found.fy] == pytest.approx([truth.fx, truth.fy], rel=0.002)
    assert [found.cx, found.cy] == pytest.approx([truth.cx, truth.cy], abs=0.6)


def check_pair(found: Calibration, truth: CameraModel) -> None:
    assert found.right is not None
    assert found.T_left_right is not None
    check_camera(found.left, truth)
    check_camera(found.right, truth)
    baseline = np.linalg.norm(found.T_left_right[:3, 3])
    assert baseline == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), rel=0.005)
    turn = cv2.Rodrigues(found.T_left_right[:3, :3] @ T_LEFT_RIGHT[:3, :3].T)[0]
    assert np.linalg.norm(turn) < 2e-3


def test_checkerboard_filmed_by_one_camera(calibrate, tmp_path):
    images = rendered(CHECKERBOARD, PINHOLE, poses(CHECKERBOARD, PINHOLE, 14), 0)
    write_images(tmp_path, {"board": images}, [f"{k}.png" for k in range(14)])
    code, out, _ = calibrate("board", "--board", "checkerboard", "--size", "9x6")
    assert code == 0, out
    # One board is cut off by the border of the image.
    assert out.startswith("The checkerboard of 9x6 inner corners is seen in 13 of 14 images.\n")
    assert "vslam run DRIVE --sensor mono --calib calibration.yaml" in out
    check_camera(read_calibration(["calibration.yaml"]).left, PINHOLE)
    page = Path("calibration.html").read_text()
    assert "checkerboard of 9x6 inner corners" in page
    assert page.count("<svg") == 2


def test_second_try_keeps_the_result_of_the_first_and_refuses_other_files(calibrate, tmp_path):
    images = rendered(CHECKERBOARD, PINHOLE, poses(CHECKERBOARD, PINHOLE, 5), 0)
    write_images(tmp_path, {"board": images}, [f"{k}.png" for k in range(5)])
    words = ("board", "--board", "checkerboard", "--size", "9x6", "--out")
    code, out, _ = calibrate(*words, "a.yaml")
    assert (code, "Next" in out) == (1, False)
    *_, ending = out.splitlines()
    assert ending == (
        "Do not use this calibration, because it has faults; apply the fixes above, and try again."
    )
    first = Path("a.yaml").read_text(), Path("a.html").read_text()
    Path("a.yaml").write_text("left: of an earlier try\n")
    code, out, _ = calibrate(*words, "a.yaml")
    assert "a-1.yaml: the earlier a.yaml, which is replaced.\n" in out
    assert Path("a-1.yaml").read_text() == "left: of an earlier try\n"
    assert (Path("a.yaml").read_text(), Path("a-1.html").read_text()) == first
    assert "a-2.html: the earlier a.html" in calibrate(*words, "a.yaml")[1]
    Path("b.yaml").write_text("left_out: 1\n")
    for name, said in (
        ("b.yaml", "--out b.yaml: belongs to another program; give another name."),
        ("none/a.yaml", "--out none/a.yaml: there is no folder none; create it first."),
        ("board", "--out board: is a folder"),
        ("a.html", "--out a.html: a calibration is YAML"),
    ):
        code, out, err = calibrate(*words, name)
        assert (code, out, said in err) == (2, "", True), err


@pytest.mark.slow
def test_another_board_than_the_given_one_is_named_with_its_options(calibrate, tmp_path):
    charuco = rendered(CHARUCO, PINHOLE, poses(CHARUCO, PINHOLE, 4), 0)
    aprilgrid = rendered(APRILGRID, PINHOLE, poses(APRILGRID, PINHOLE, 4), 0)
    write_images(
        tmp_path, {"charuco": charuco, "aprilgrid": aprilgrid}, [f"{k}.png" for k in range(4)]
    )
    (tmp_path / "april.yaml").write_text(KALIBR.replace("Cols: 4", "Cols: 3"))
    given = ("--board", "charuco", "--square", 0.04, "--marker", 0.03, "--size")
    grid = ("--board", "aprilgrid", "--square", 0.078, "--size", "4x3", "--marker")
    its = "the images show a ChArUco board of 7x5 squares with markers of 4X4_50: give --board "
    its += "charuco --size 7x5 --dictionary 4X4_50, and measure --square and --marker (about 0.7 of"
    kalibr = "the images show an AprilGrid of 4x3 tags: give --board aprilgrid --size 4x3, and "
    for words in (
        ("charuco", "--board", "checkerboard", "--size", "6x4"),
        ("charuco", *given, "5x7", "--dictionary", "4x4_50"),  # columns and rows swapped
        ("charuco", *given, "6x4", "--dictionary", "4X4_50"),  # inner corners
        ("charuco", *given, "7x5", "--dictionary", "5X5_1000"),
        ("aprilgrid", "--board", "april.yaml"),
        ("aprilgrid", *grid, 0.04),
    ):
        code, _, err = calibrate(*words)
        message = err[err.index("error: ") :]
        said = its if words[0] == "charuco" else kalibr
        assert (code, said in message, message.count("\n")) == (2, True, 1), message
    street = [np.random.default_rng(k).integers(0, 256, (288, 384), np.uint8) for k in range(2)]
    for board in (CHECKERBOARD, CHARUCO, APRILGRID):
        assert other_board(board, street) == ""
    assert other_board(CHARUCO, charuco) == other_board(APRILGRID, aprilgrid) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("columns", "rows", "seen_rows"), [(8, 6, 6), (12, 9, 8)])
def test_charuco_boards_of_any_size_are_recognised(columns, rows, seen_rows):
    """Some of the sizes that are tried need more markers than the recognised ones."""
    board = Board("charuco", columns, rows, 0.04, 0.03, "4X4_1000")
    printed, scale, origin = texture(board)
    image = printed[: int(origin[1] + (seen_rows + 0.5) * board.square * scale)]
    assert other_board(board, [image]) == ""
    least = "4X4_50" if columns == 8 else "4X4_100"
    said = f"--board charuco --size {columns}x{rows} --dictionary {least}, and measure"
    assert said in other_board(replace(board, dictionary="5X5_1000"), [image])


@pytest.mark.slow
def test_charuco_board_in_a_side_by_side_video(calibrate, tmp_path):
    views = poses(CHARUCO, PINHOLE, 14)
    right = [np.linalg.inv(T_LEFT_RIGHT) @ T for T in views]
    sides = rendered(CHARUCO, PINHOLE, views, 1), rendered(CHARUCO, PINHOLE, right, 2)
    write_video(tmp_path / "pair.mkv", [np.hstack(pair) for pair in zip(*sides, strict=True)])
    sizes = ("--size", "7x5", "--square", 0.04, "--marker", 0.03, "--dictionary", "4X4_50")
    words = ("pair.mkv", "--side-by-side", "--board", "charuco", *sizes, "--out", "stereo.yaml")
    code, out, _ = calibrate(*words)
    assert code == 0, out
    check_pair(read_calibration(["stereo.yaml"]), PINHOLE)


@pytest.mark.slow
def test_aprilgrid_of_kalibr_in_euroc_layout_by_fisheye_cameras(calibrate, tmp_path):
    views = poses(APRILGRID, FISHEYE, 14)
    right = [np.linalg.inv(T_LEFT_RIGHT) @ T for T in views]
    names = [f"{10**18 + 10**8 * k}.png" for k in range(14)]
    for side, of_side in enumerate((views, right)):
        folder = tmp_path / "mav0" / f"cam{side}"
        write_images(folder, {"data": rendered(APRILGRID, FISHEYE, of_side, side)}, names)
        listed = names[: 14 - side]  # the last right image is missing
        (folder / "data.csv").write_text("".join(f"{Path(n).stem},{n}\n" for n in listed))
    (tmp_path / "april.yaml").write_text(KALIBR)
    board = read_board(tmp_path / "april.yaml")
    assert (board.columns, board.rows) == (4, 3)
    assert (board.square, board.marker) == pytest.approx((APRILGRID.square, APRILGRID.marker))
    code, out, err = calibrate(tmp_path, "--board", "april.yaml", "--lens", "fisheye")
    assert code == 0, out
    assert "warning: " in err
    assert "1 of 14 images are left out because no right image is within 5 ms of them" in err
    check_pair(read_calibration(["calibration.yaml"]), FISHEYE)


def test_a_board_has_an_integer_size(tmp_path):
    path = tmp_path / "april.yaml"
    path.write_text(KALIBR.replace("Cols: 4", "Cols: 4.7"))
    with pytest.raises(InputError, match=r"april.yaml: tagCols must be one integer\."):
        read_board(path)


@pytest.mark.parametrize("border", [1, 2])
def test_aprilgrid_of_upright_tags(border):
    upright = Renderer(APRILGRID, PINHOLE, border=border, upright=True)
    (T,) = poses(APRILGRID, PINHOLE, 1)
    view = find_corners(APRILGRID, upright.image(T, np.random.default_rng(0)))
    xy = project(PINHOLE, transform(T, board_points(APRILGRID)))
    assert len(view.ids) > 30
    assert np.linalg.norm(view.xy - xy[view.ids], axis=1).max() < 0.5


def test_charuco_board_that_begins_with_a_marker():
    board = replace(CHARUCO, rows=6)
    (T,) = poses(board, PINHOLE, 1)
    for legacy in (False, True):
        image = Renderer(board, PINHOLE, legacy=legacy).image(T, np.random.default_rng(0))
        view = find_corners(board, image)
        xy = project(PINHOLE, transform(T, board_points(board)))
        assert len(view.ids) > 15
        assert np.linalg.norm(view.xy - xy[view.ids], axis=1).max() < 0.5


def test_written_calibration_is_read_as_the_same(tmp_path):
    pair = Calibration(PINHOLE, FISHEYE, T_LEFT_RIGHT)
    for calibration in (pair, pair.left_alone()):
        write_calibration(tmp_path / "a.yaml", calibration)
        found = read_calibration([tmp_path / "a.yaml"])
        assert (found.left, found.right) == (calibration.left, calibration.right)
        if calibration.T_left_right is not None:
            np.testing.assert_allclose(found.T_left_right, T_LEFT_RIGHT, atol=1e-12)


def test_views_that_do_not_fit_are_dropped_and_named():
    views = exact_views(CHECKERBOARD, PINHOLE, poses(CHECKERBOARD, PINHOLE, 14))
    noise = np.random.default_rng(1).normal(0.0, 2.0, views[5].xy.shape)
    views[5] = replace(views[5], xy=views[5].xy + noise)
    fit = fit_camera(CHECKERBOARD, views, (384, 288), "pinhole")
    check_camera(fit.model, PINHOLE)
    assert [name for name, _ in fit.dropped] == ["5"]
    other = fit_camera(CHECKERBOARD, views[:5] + views[6:], (384, 288), "pinhole")
    assert fit.model.fx == pytest.approx(other.model.fx, abs=2e-5)
    found = findings_of(Estimate((fit,)))
    assert {f.verdict for f in found} == {"good"}
    assert "dropped because they do not fit: 5 (" in found[0].measured


@pytest.mark.slow
def test_pairs_that_were_not_taken_together_are_dropped():
    views = poses(CHECKERBOARD, PINHOLE, 14)
    right = [np.linalg.inv(T_LEFT_RIGHT) @ T for T in views]
    late = np.eye(4)
    late[0, 3] = 0.01
    right[3] = late @ right[3]
    fits = [
        fit_camera(CHECKERBOARD, exact_views(CHECKERBOARD, PINHOLE, side), (384, 288), "pinhole")
        for side in (views, right)
    ]
    pair = fit_pair(CHECKERBOARD, *fits)
    assert [name for name, _ in pair.dropped] == ["3"]
    check_pair(Estimate(tuple(fits), pair).calibration, PINHOLE)


def test_checkerboard_numbered_from_the_other_end_is_renumbered():
    board = Board("checkerboard", 8, 6, 0.03)
    (left,) = exact_views(board, PINHOLE, poses(board, PINHOLE, 1))
    assert np.array_equal(same_order(board, left, replace(left, xy=left.xy[::-1])).xy, left.xy)


def test_diverse_views_leave_out_a_board_that_stands_still():
    moving = poses(CHECKERBOARD, PINHOLE, 9)
    film = [moving[0]] * 30 + moving[1:]
    frames = [(None,), *((view,) for view in exact_views(CHECKERBOARD, PINHOLE, film))]
    chosen = [int(view.name) for (view,) in diverse(CHECKERBOARD, frames, [(384, 288)], 60)]
    assert (len(chosen), chosen[1:]) == (9, list(range(30, 38)))
    assert len(diverse(CHECKERBOARD, frames, [(384, 288)], 4)) == 4


def test_doubtful_calibration_is_judged_in_plain_words():
    flat = np.eye(4)
    flat[:3, 3] = -0.12, -0.08, 0.4
    views = exact_views(CHECKERBOARD, PINHOLE, [*poses(CHECKERBOARD, PINHOLE, 2), flat])
    fit = fit_camera(CHECKERBOARD, views, (384, 288), "pinhole")
    faults = {f.check: f.measured for f in findings_of(Estimate((fit,))) if f.verdict == "fault"}
    assert faults["views"] == "3 views, too few"
    assert faults["tilt"] == "2 views are tilted by more than 15 degrees"
    assert faults["coverage"].startswith("corners in ")


def test_lens_of_the_other_model_is_a_fault():
    views = exact_views(CHECKERBOARD, FISHEYE, poses(CHECKERBOARD, FISHEYE, 14))
    faults = {}
    for lens in ("pinhole", "fisheye"):
        fit = fit_camera(CHECKERBOARD, views, (384, 288), lens)
        faults[lens] = [f.check for f in findings_of(Estimate((fit,))) if f.verdict == "fault"]
    assert "lens" in faults["pinhole"]
    assert faults["fisheye"] == []


def test_swapped_cameras_are_a_fault():
    views = poses(CHECKERBOARD, PINHOLE, 14)
    left, right = (
        fit_camera(CHECKERBOARD, exact_views(CHECKERBOARD, PINHOLE, side), (384, 288), "pinhole")
        for side in ([np.linalg.inv(T_LEFT_RIGHT) @ T for T in views], views)
    )
    pair = fit_pair(CHECKERBOARD, left, right)
    (fault,) = [f for f in findings_of(Estimate((left, right), pair)) if f.verdict == "fault"]
    assert (fault.check, "0.060 m to the left" in fault.measured) == ("rectification", True)


def test_too_few_views_and_another_board_are_errors():
    views = exact_views(APRILGRID, PINHOLE, poses(APRILGRID, PINHOLE, 8))
    with pytest.raises(InputError, match="is found in only 2 usable images, but 3 are needed"):
        fit_camera(APRILGRID, views[:2], (384, 288), "pinhole")
    other = replace(APRILGRID, columns=3, rows=4)
    with pytest.raises(InputError, match="do not fit a flat AprilGrid of 3x4 tags"):
        fit_camera(other, views, (384, 288), "pinhole")


def test_video_that_breaks_off_is_used_up_to_there(capsys):
    def play(n: int):
        for k in range(n):
            yield TimedFrame(k / 30, lambda image_map: (np.zeros((288, 384), np.uint8), None))
        raise BrokenSourceError("film.mp4: the video breaks off.")

    def source(n: int) -> RawSource:
        return RawSource(
            dataset="video", name="film", sizes=((384, 288),), play=lambda: play(n), n_expected=600
        )

    assert [round(30 * frame.timestamp) for frame in _frames(source(9), 300)] == [0, 2, 4, 6, 8]
    assert capsys.readouterr().err == "warning: film.mp4: the video breaks off.\n"
    with pytest.raises(BrokenSourceError):
        list(_frames(source(0), 300))


@pytest.mark.slow
def test_images_without_the_board_are_an_error_that_says_what_was_looked_for(calibrate, tmp_path):
    blank = np.full((288, 384), 128, np.uint8)
    images = rendered(CHECKERBOARD, PINHOLE, poses(CHECKERBOARD, PINHOLE, 2), 0)
    write_images(tmp_path, {"blank": [blank] * 2, "board": images}, ["0.png", "1.png"])
    write_images(tmp_path / "pair", {"left": images, "right": [blank] * 2}, ["0.png", "1.png"])
    write_images(tmp_path, {"mixed": [blank, blank[:100]]}, ["0.png", "1.png"])
    rest = ("--board", "checkerboard", "--size")
    charuco = ("pair", "--board", "charuco", "--square", 0.04, "--marker", 0.03, "--size")
    for words, said in (
        (("blank", *rest, "9x6"), "blank: no checkerboard of 9x6 inner corners in any of 2 images"),
        (("board", *rest, "10x7"), "a checkerboard of 9x6 inner corners: give --board checker"),
        (
            ("pair", *rest, "9x6", "--square", 0.03),
            "the right camera never sees the checkerboard of 9x6 inner corners, which the other",
        ),
        (("mixed", *rest, "9x6"), "384x100 pixels but the first image has 384x288"),
        (("pair", *rest, "9x6"), "--square is missing"),
        (("pair", *rest, "9x6", "--square", 30), "give both in metres, such as 0.025 for 25 mm"),
        (("pair", *rest, "9"), "--size 9: give columns and rows, such as 9x6."),
        (("pair", "--board", "none.yaml"), "--board none.yaml: there is no such file; give"),
        ((*charuco, "7x5", "--dictionary", "8X8_50"), "8X8_50: OpenCV has no such markers; give a"),
        ((*charuco, "12x9", "--dictionary", "4x4_50"), "50 markers are too few for this board"),
    ):
        code, _, err = calibrate(*words)
        message = err[err.index("error: ") :]
        assert (code, said in message, message.count("\n")) == (2, True, 1), message
