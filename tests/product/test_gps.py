"""GPS fixes are read and checked. A drive with GPS is georeferenced and does not drift."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vslam.backend import gps
from vslam.backend.gps import Positions, align, anchor
from vslam.backend.pose_graph import TREE, WEAK, PoseGraph, edge_sigmas
from vslam.config import Config
from vslam.datasets.fixes import DEFAULT_SIGMA_M, read_fixes, to_enu, to_geodetic
from vslam.support.errors import InputError
from vslam.types.geometry import inverses, se3_exp
from vslam.types.trajectory import read_trajectory

DATUM = np.array([48.0, 11.0, 500.0])
R_ENU_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
HEAD = "time,latitude,longitude,altitude"
CONFIG = Config().pose_graph


# The readers.


def csv_of(path, times, enu, sigma=None):
    rows = np.column_stack([times, to_geodetic(enu, DATUM)])
    head, more = (HEAD, "") if sigma is None else (f"{HEAD},sigma", f",{sigma}")
    lines = [",".join(f"{x:.9f}" for x in row) + more for row in rows.tolist()]
    path.write_text("\n".join([head, *lines, ""]))
    return path


def test_a_csv_file_is_read_in_the_order_of_its_times(tmp_path):
    path = tmp_path / "fixes.csv"
    path.write_text(
        "Lat, lon ,alt,time,satellites,sigma\n48.1,11,500,2,7,0.5\n48,11.1,501,1,7,\n\n"
    )
    fixes = read_fixes(path)
    assert fixes.times.tolist() == [1.0, 2.0]
    assert fixes.geodetic.tolist() == [[48.0, 11.1, 501.0], [48.1, 11.0, 500.0]]
    assert fixes.sigma.tolist() == [[DEFAULT_SIGMA_M] * 3, [0.5] * 3]
    assert len(fixes.between(1.5, 3.0)) == 1


def test_an_infinite_sigma_counts_as_unknown(tmp_path):
    fixes = read_fixes(csv_of(tmp_path / "fixes.csv", [1.0], np.zeros((1, 3)), sigma="inf"))
    assert fixes.sigma.tolist() == [[DEFAULT_SIGMA_M] * 3]


def oxts(folder, times=3, packets=3):
    (folder / "data").mkdir(parents=True)
    stamps = [f"2011-09-26 13:02:25.9{k}4389445" for k in range(times)]
    (folder / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for k in range(packets):
        numbers = [49.0 + k, 8.4, 112.0, *[0.0] * 20, 0.05, *[0.0] * 6]
        (folder / "data" / f"{k:010}.txt").write_text(" ".join(map(str, numbers)))
    return folder


def test_the_oxts_folder_of_kitti_raw_is_read(tmp_path):
    oxts(tmp_path / "drive" / "oxts")
    for folder in (tmp_path / "drive", tmp_path / "drive" / "oxts"):
        fixes = read_fixes(folder)
        assert fixes.times == pytest.approx([0.0, 0.01, 0.02])
        assert fixes.geodetic[:, 0].tolist() == [49.0, 50.0, 51.0]
        assert (fixes.sigma == 0.05).all()


def bag_of(path, rows, kind="ros1", topics=("/gps/fix",)):
    """Write a bag of GPS fixes from rows of (seconds, status, latitude, type of covariance)."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    of = {name.rpartition("/")[2]: made for name, made in store.types.items()}
    writer = Writer2(path, version=8, storage_plugin=StoragePlugin.MCAP)
    if kind == "ros1":
        writer = Writer1(path)
    counter = {"seq": 0} if kind == "ros1" else {}
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with writer:
        for topic in topics:
            to = writer.add_connection(topic, "sensor_msgs/msg/NavSatFix", typestore=store)
            for seconds, status, latitude, known in rows:
                time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=0)
                header = of["Header"](stamp=time, frame_id="", **counter)
                message = of["NavSatFix"](
                    header, of["NavSatStatus"](status, 1), latitude, 11.0, 500.0,
                    np.diag([1.0, 4.0, 9.0]).ravel(), known,
                )  # fmt: skip
                to_write = serialize(message, message.__msgtype__)
                writer.write(to, 10**9 * (seconds + 1), to_write)
    return path


@pytest.mark.parametrize(("kind", "name"), [("ros1", "drive.bag"), ("mcap", "drive")])
def test_fixes_of_a_bag_are_read(tmp_path, kind, name):
    rows = [(5, 0, 48.0, 2), (6, -1, 48.0, 2), (7, 0, np.nan, 2), (8, 0, 48.5, 0)]
    fixes = read_fixes(bag_of(tmp_path / name, rows, kind))
    assert fixes.times.tolist() == [5.0, 8.0]
    assert fixes.geodetic[:, 0].tolist() == [48.0, 48.5]
    assert fixes.sigma.tolist() == [[1.0, 2.0, 3.0], [DEFAULT_SIGMA_M] * 3]


CALIBRATIONS = {
    # Axes of the IMU and laser: ahead, left, up. Axes of the camera: right, down, ahead.
    "calib_imu_to_velo.txt": "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n",
    "calib_velo_to_cam.txt": "calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\n"
    "T: 0 -0.08 -0.27\ndelta_f: 0 0\n",
}


def test_the_calibration_of_kitti_raw_gives_the_antenna(tmp_path):
    folder = oxts(tmp_path / "2011_09_26" / "drive" / "oxts")
    assert not read_fixes(folder).antenna.any()
    for name, text in CALIBRATIONS.items():
        (tmp_path / "2011_09_26" / name).write_text(text)
    for path in (folder, folder.parent):
        assert read_fixes(path).antenna == pytest.approx([-0.32, 0.72, -1.08])
        assert read_fixes(path, (1.0, 2.0, 3.0)).antenna.tolist() == [1.0, 2.0, 3.0]
    (tmp_path / "2011_09_26" / "calib_imu_to_velo.txt").write_text("R: 1 0\nT: 0 0 0\n")
    with pytest.raises(InputError, match=r"imu_to_velo\.txt: not a calibration of KITTI raw"):
        read_fixes(folder)


def test_metres_to_latitude_and_back():
    enu = np.array([[0.0, 0.0, 0.0], [100.0, -2000.0, 30.0]])
    geodetic = to_geodetic(enu, DATUM)
    assert geodetic[0] == pytest.approx(DATUM)
    assert to_enu(geodetic, DATUM) == pytest.approx(enu, abs=1e-6)


def refused(text, name="fixes.csv"):
    def write(folder):
        (folder / name).write_text(text)
        return folder / name

    return write


BAD = {
    "absent": (lambda folder: folder / "absent.csv", "no such file or folder"),
    "without time": (refused("latitude,longitude,altitude\n48,11,5\n"), "names no time"),
    "without altitude": (refused("time,lat,lon\n1,48,11\n"), "names no altitude"),
    "empty": (refused(""), "names no time and no latitude"),
    "no rows": (refused(f"{HEAD}\n"), "holds no fix"),
    "a word": (refused(f"{HEAD}\n1,2,3,4\n2,north,3,4\n"), "line 3 is not a fix of 4 numbers"),
    "too few": (refused(f"{HEAD}\n1,2,3\n"), "line 2 is not a fix of 4 numbers"),
    "not a number": (refused(f"{HEAD}\n1,2,3,nan\n"), "line 2 is not a fix of 4 numbers"),
    "latitude": (refused(f"{HEAD}\n1,91,3,4\n"), "the fix at 1 s has latitude 91 and longitude 3"),
    "longitude": (refused(f"{HEAD}\n1,9,200,4\n"), "from -180 to 180"),
    "other times": (refused(f"{HEAD}\n1e9,48,11,5\n"), "the images are from 0.000 to"),
    "no packets": (lambda folder: folder, "no data/*.txt"),
    "unequal": (lambda folder: oxts(folder / "oxts", times=2), "2 times for 3 packets"),
    "no stamps": (lambda folder: oxts(folder / "oxts", times=0), "the file is empty"),
    "no topic": (lambda folder: bag_of(folder / "a.bag", [], topics=()), "the bag has none"),
    "two topics": (
        lambda folder: bag_of(folder / "a.bag", [(1, 0, 48.0, 0)], topics=("/a", "/b")),
        "the bag has several (/a, /b)",
    ),
    "no fix": (lambda folder: bag_of(folder / "a.bag", [(1, -1, 48.0, 0)]), "/gps/fix is a fix"),
    "no stamp": (lambda folder: bag_of(folder / "a.bag", [(0, 0, 48.0, 0)]), "no time stamps"),
    "no bag": (refused("no", "a.bag"), "not a bag, because it does not begin like"),
    "no bag in capitals": (refused("no", "a.BAG"), "not a bag, because it does not begin like"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_fixes_are_refused_in_one_sentence(call, kitti_tree, tmp_path, case):
    make, said = BAD[case]
    path = make(tmp_path)
    code, _, err = call("run", "--data", kitti_tree, "--gps", path, "--quiet")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert said in err
    assert str(path) in err
    assert not (tmp_path / "runs").exists()


def test_a_missing_library_is_named(call, kitti_tree, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymap3d", None)
    code, _, err = call("run", "--data", kitti_tree, "--gps", tmp_path / "fixes.csv")
    assert code == 2
    assert "pip install 'vslam[gps]'" in err


# Alignment and pose graph.


def drive(n, *, turn=0.05, drift=0.0, shrink=0.0, seed=0):
    """Return the true poses of n keyframes that are 3 m apart, and the poses of odometry."""
    rng = np.random.default_rng(seed)
    true, found = [np.eye(4)], [np.eye(4)]
    for k in range(n - 1):
        step = np.array([0.0, 0.0, 3.0, 0.0, turn * np.sin(k / 15.0), 0.0])
        wrong = drift * rng.normal(size=6) * np.array([0.02, 0.02, 0.02, 0.001, 0.001, 0.001])
        true.append(true[-1] @ se3_exp(step))
        step[:3] *= np.exp(-shrink * k)
        found.append(found[-1] @ se3_exp(step + wrong))
    return np.array(true), np.array(found)


def graph_of(T_wc, seconds):
    n = len(T_wc)
    edges = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    T_i_j = inverses(T_wc)[edges[:, 0]] @ T_wc[edges[:, 1]]
    kind = np.full(n - 1, TREE, np.uint8)
    sigmas = edge_sigmas(edges, T_i_j, kind, seconds[edges], n, CONFIG)
    first = np.arange(n) == 0
    return PoseGraph(
        np.arange(n), inverses(T_wc), edges, T_i_j, kind, sigmas, first, np.ones(n - 1)
    )


def measured(true, sigma=1.0, seed=0, antenna=(0.0, 0.0, 0.0)):
    """Return GPS fixes of all keyframes, one per second, and the true positions of the camera."""
    enu = true[:, :3, 3] @ R_ENU_CAMERA.T + np.array([50.0, -20.0, 3.0])
    fixes = enu + true[:, :3, :3] @ np.array(antenna) @ R_ENU_CAMERA.T
    fixes += np.random.default_rng(seed).normal(0.0, sigma, enu.shape)
    n, three = len(true), np.full(enu.shape, sigma)
    zeros, lever = np.zeros((n, 3)), np.tile(antenna, (n, 1))
    return Positions(np.arange(n) * 1.0, np.arange(n), zeros, lever, fixes, three), enu


def jumped(positions, at):
    enu = positions.enu.copy()
    enu[at] += np.array([20.0, -5.0, 0.0])
    return replace(positions, enu=enu)


def error_of(anchored, enu):
    return float(np.linalg.norm(anchored.T_enu_k[:, :3, 3] - enu, axis=1).mean())


def test_the_test_refuses_what_has_jumped_and_little_else():
    true, found = drive(600, drift=2.0)
    positions, enu = measured(true)
    at = np.r_[100:110, 300:310, 590:600]
    positions = jumped(positions, at)
    anchored = anchor(graph_of(found, positions.seconds), positions.seconds, positions, CONFIG,
                      metric=True)  # fmt: skip
    assert not anchored.used[at].any()
    assert np.delete(~anchored.used, at).mean() < 0.02
    S = anchored.S_enu_w
    without = np.linalg.norm(found[:, :3, 3] @ S[:3, :3].T + S[:3, 3] - enu, axis=1).mean()
    assert without > 3.0
    assert error_of(anchored, enu) < 0.9
    assert anchored.level
    assert anchored.scale == pytest.approx(1.0, abs=0.01)
    angles = Rotation.from_matrix(
        (R_ENU_CAMERA @ true[:, :3, :3]).transpose(0, 2, 1) @ anchored.T_enu_k[:, :3, :3]
    ).magnitude()
    assert np.degrees(angles.mean()) < 1.0


@pytest.mark.parametrize(("drift", "gain"), [(0.02, 0.75), (2.0, 1.1)])
def test_an_accurate_map_is_bent_less_than_one_that_drifts(monkeypatch, drift, gain):
    true, found = drive(300, drift=drift)
    positions, _ = measured(true)
    graph = graph_of(found, positions.seconds)

    def error():
        anchored = anchor(graph, positions.seconds, positions, CONFIG, metric=True)
        T = inverses(anchored.T_enu_k[:-1]) @ anchored.T_enu_k[1:]
        return float(np.linalg.norm((T - inverses(true[:-1]) @ true[1:])[:, :3, 3], axis=1).mean())

    believed = error()
    monkeypatch.setattr(gps, "_DRIFTS", (1.0,))
    assert believed < gain * error()


@pytest.mark.parametrize("metric", [True, False])
def test_the_alignment_ignores_wrong_fixes(metric):
    true, _ = drive(200)
    positions, enu = measured(true, 0.5)
    positions = jumped(positions, np.arange(0, 200, 3))
    T_wk = true.copy()
    if not metric:
        T_wk[:, :3, 3] *= 0.1
    found = align(T_wk, positions, metric=metric)
    S = found.S_enu_w
    assert np.cbrt(np.linalg.det(S[:3, :3])) == pytest.approx(1.0 if metric else 10.0, rel=0.01)
    assert np.linalg.norm(T_wk[:, :3, 3] @ S[:3, :3].T + S[:3, 3] - enu, axis=1).max() < 1.5
    assert found.unsure < 0.01
    assert found.unsure_about < 0.02


def test_an_error_of_the_calibration_is_found_where_the_drive_is_long_enough():
    """The baseline in the calibration is 2 % too long."""
    for n, share in ((500, 1.0), (15, 0.0)):
        true, found = drive(n)
        found[:, :3, 3] *= 1.02
        positions, enu = measured(true)
        graph = graph_of(found, positions.seconds)
        anchored = anchor(graph, positions.seconds, positions, CONFIG, metric=True)
        assert anchored.scale == pytest.approx(1.0 - share * (1.0 - 1.0 / 1.02), abs=0.008)
        assert error_of(anchored, enu) < 1.0


def test_fixes_within_the_time_of_their_bias_weigh_as_one():
    positions, _ = measured(drive(100)[0])
    once = positions.crowding
    dense = replace(positions, seconds=positions.seconds / 10.0)
    assert once[50] == 11
    assert dense.crowding[50] == 100
    far = np.zeros(100, np.bool_)
    far[::20] = True
    assert (positions.select(far).crowding == 1).all()


def test_a_straight_drive_is_placed_but_not_level():
    true, found = drive(100, turn=0.0, drift=0.5)
    positions, enu = measured(true)
    anchored = anchor(graph_of(found, positions.seconds), positions.seconds, positions, CONFIG,
                      metric=True)  # fmt: skip
    assert not anchored.level
    assert error_of(anchored, enu) < 1.2
    up = -anchored.T_enu_k[:, :3, 1]
    assert np.degrees(np.arccos(up[:, 2])).max() < 12.0


def test_a_short_drive_is_refused():
    positions, _ = measured(drive(4)[0])
    graph = graph_of(drive(4)[0], positions.seconds)
    with pytest.raises(InputError, match="too short for GPS: the fixes do not determine"):
        anchor(graph, positions.seconds, positions, CONFIG, metric=True)


def test_two_keyframes_suffice_for_an_accurate_receiver():
    """The edge between them is very short. Without the fixes, GTSAM cannot solve the system."""
    true = np.tile(np.eye(4), (2, 1, 1))
    true[1, 2, 3] = 0.35
    keyframe, ahead = np.array([0, 1, 1, 1, 1, 1]), 0.35 * np.arange(6.0)
    offset = np.zeros((6, 3))
    offset[:, 2] = ahead - true[keyframe, 2, 3]
    enu = (np.eye(3)[2] * ahead[:, None]) @ R_ENU_CAMERA.T
    positions = Positions(
        np.arange(6) * 0.1, keyframe, offset, np.zeros((6, 3)), enu, np.full((6, 3), 0.01)
    )
    graph = graph_of(true, np.array([0.0, 0.1]))
    anchored = anchor(graph, np.array([0.0, 0.1]), positions, CONFIG, metric=True)
    assert anchored.used.all()
    assert error_of(anchored, enu[:2]) < 0.01


def test_the_scale_of_a_monocular_map_is_found_where_it_drifts():
    true, found = drive(500, drift=0.5, shrink=0.001)  # the scale decreases by a factor of 1.6
    found[:, :3, 3] *= 0.2
    positions, enu = measured(true)
    anchored = anchor(graph_of(found, positions.seconds), positions.seconds, positions, CONFIG,
                      metric=False)  # fmt: skip
    assert error_of(anchored, enu) < 1.0
    assert anchored.used.mean() > 0.97
    wanted = 5.0 * np.exp(0.001 * np.arange(500))
    assert anchored.scale[30:-30] == pytest.approx(wanted[30:-30], rel=0.05)


@pytest.mark.parametrize("metric", [True, False])
def test_the_antenna_need_not_be_at_the_camera(metric):
    """The antenna is behind and above the camera, which turns by more than 90 degrees."""
    true, found = drive(300, turn=0.1, drift=0.5)
    if not metric:
        found[:, :3, 3] *= 0.2
    positions, enu = measured(true, 0.05, antenna=(0.0, -1.5, -1.5))
    graph = graph_of(found, positions.seconds)
    known = anchor(graph, positions.seconds, positions, CONFIG, metric=metric)
    ignored = replace(positions, lever=np.zeros_like(positions.lever))
    without = anchor(graph, positions.seconds, ignored, CONFIG, metric=metric)
    assert error_of(known, enu) < 0.1
    assert error_of(without, enu) > 1.5


def test_each_part_of_a_map_is_aligned_by_itself():
    """After tracking is lost, the position of the next part of the map is unknown."""
    true, found = drive(300)
    elsewhere = se3_exp(np.array([200.0, 5.0, -300.0, 0.1, 2.0, 0.0]))
    found[150:] = elsewhere @ found[150:]
    positions, enu = measured(true, 0.5)
    graph = graph_of(found, positions.seconds)
    kind = graph.kind.copy()
    kind[149] = WEAK
    anchored = anchor(replace(graph, kind=kind), positions.seconds, positions, CONFIG, metric=True)
    assert error_of(anchored, enu) < 0.5
    assert anchored.used.mean() > 0.97


# Whole runs.


@pytest.fixture
def fixes(corridor, tmp_path):
    times = corridor.timestamps - corridor.timestamps[0]
    enu = (corridor.T_wc[:, :3, 3] + corridor.T_wc[:, :3, :3] @ ANTENNA) @ R_ENU_CAMERA.T
    enu = enu + np.random.default_rng(0).normal(0.0, 0.01, enu.shape)
    enu[10] += 3.0
    return csv_of(tmp_path / "fixes.csv", times, enu, 0.01)


# Above and behind the camera.
ANTENNA = np.array([0.2, -0.5, -1.5])
WORDS = ("--detector", "none", "--no-record", "--quiet", "--threads", 1)


@pytest.mark.slow
def test_a_run_with_gps_lies_on_the_earth(call, corridor, kitti_tree, fixes, tmp_path):
    code, _, err = call("run", "--data", kitti_tree, *WORDS, "--out", "without")
    assert code == 0, err
    at = ",".join(map(str, ANTENNA))
    code, _, err = call("run", "--data", kitti_tree, *WORDS, "--gps", fixes, "--gps-antenna", at)
    assert code == 0, err
    run, without = tmp_path / "runs" / "latest", tmp_path / "without" / "latest"
    for name in ("trajectory.tum", "trajectory_odom.tum", "keyframes.tum", "map.npz"):
        assert (run / name).read_bytes() == (without / name).read_bytes(), name
    assert not list(without.glob("*gps*"))
    assert "GPS" not in (without / "report.html").read_text()

    figures = json.loads((run / "gps.json").read_text())
    assert figures["antenna"] == ANTENNA.tolist()
    assert figures["fixes"] == 28
    assert figures["refused"] == 1
    datum = to_enu(np.array([figures["datum"]]), DATUM)
    assert datum[0] == pytest.approx(R_ENU_CAMERA @ ANTENNA, abs=0.1)
    track = read_trajectory(run / "trajectory_enu.tum")
    true = corridor.T_wc[:, :3, 3] @ R_ENU_CAMERA.T
    assert np.linalg.norm(track.T_wc[:, :3, 3] + datum - true, axis=1).max() < 0.1
    forward = track.T_wc[:, :3, 2]
    assert (forward[:, 1] > 0.9).all()
    rows = np.loadtxt(run / "trajectory_gps.csv", delimiter=",", skiprows=1)
    assert to_enu(rows[:, 1:], np.array(figures["datum"])) == pytest.approx(
        track.T_wc[:, :3, 3], abs=2e-3
    )
    report = json.loads((run / "report.json").read_text())
    assert report["gps_track"] == figures
    assert report["gps"] == str(fixes)
    assert figures["ate_rmse_m"] < 0.1
    page = (run / "report.md").read_text()
    assert "28, 1 of them refused" in page
    assert "0.20 m right of, -0.50 m below, -1.50 m ahead of the camera" in page
    assert "27 fixes" in page
    assert (run / "figures" / "gps_map.png").is_file()
    assert "too straight" in page or figures["level"]


@pytest.mark.slow
def test_what_was_computed_is_kept_where_gps_says_too_little(call, kitti_tree, fixes, tmp_path):
    rough = tmp_path / "rough.csv"
    rough.write_text(fixes.read_text().replace(",0.01\n", ",5\n"))
    code, _, err = call("run", "--data", kitti_tree, *WORDS, "--no-report", "--gps", rough)
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "all other results were written: the drive is too short for GPS" in err
    run = tmp_path / "runs" / "latest"
    assert (run / "trajectory.tum").is_file()
    assert not (run / "gps.json").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--gps-antenna", "1,2,3"), "give the fixes of this antenna with --gps"),
        (("--gps", "fixes.csv", "--gps-antenna", "1,2"), "--gps-antenna 1,2: give three numbers"),
        (("--gps", "fixes.csv", "--gps-antenna", "-1,x,2"), "give three numbers"),
        (("--gps", "fixes.csv", "--gps-antenna", "-1,inf,2"), "give three numbers"),
    ],
)
def test_a_place_that_no_antenna_has_is_refused(call, kitti_tree, words, said):
    code, _, err = call("run", "--data", kitti_tree, *words)
    assert code == 2
    assert len(err.splitlines()) == 1
    assert said in err


def test_localising_takes_no_gps(call, kitti_tree, fixes):
    code, _, err = call("run", "--data", kitti_tree, "--map", "x.npz", "--localize", "--gps", fixes)
    assert code == 2
    assert "--gps: changes the map" in err


def test_fixes_before_a_stream_are_refused(corridor, tmp_path, fixes):
    from source_files import open_from, write_calibration, write_video

    from vslam.datasets.fixes import require_overlap

    write_calibration(tmp_path / "left.yaml", corridor.camera, mono=True)
    write_video(tmp_path / "drive.mkv", corridor.left[:4])
    calib = (tmp_path / "left.yaml",)
    source = open_from("video", tmp_path / "drive.mkv", calib=calib, sensor="mono", start=2)
    good = read_fixes(fixes)
    require_overlap(good, source, fixes)
    early = replace(good, times=good.times - 100.0)
    with pytest.raises(
        InputError, match=r"to -97\.300 s but the images are from 0\.200 s on; both"
    ):
        require_overlap(early, source, fixes)
    with pytest.raises(InputError, match="cannot be used with a live camera"):
        require_overlap(good, replace(source, live=True), fixes)
