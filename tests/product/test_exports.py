"""Maps in the formats of other programs, which are read and projected by their conventions."""

from __future__ import annotations

import errno
import importlib
import json
import struct
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from source_files import write_calibration, write_video
from test_pipeline import KITTI, needs_kitti
from test_pipeline import run as run_pipeline
from typer.testing import CliRunner

from vslam.backend.pose_graph import GAP, LOOP, TREE, edge_errors, essential_graph
from vslam.cli.main import every_command
from vslam.config import PoseGraphConfig, load_config
from vslam.datasets import open_sequence
from vslam.maps.colmap import save_colmap
from vslam.maps.formats import landmark_colours, save_g2o, save_nerfstudio, save_ply
from vslam.maps.level import T_UPRIGHT_CAMERA, level_world, turned
from vslam.maps.new_output import new_output
from vslam.maps.reconstruction import Reconstruction, reconstruction_of
from vslam.maps.storage import load_map, save_map
from vslam.maps.stored_map import StoredMap
from vslam.report.finished_run import read_run
from vslam.report.folder import write_results
from vslam.run.options import RunOptions, write_options
from vslam.support.errors import InputError, ResultsError
from vslam.types.camera import Camera
from vslam.types.features import Features
from vslam.types.geometry import inverses, se3_exp
from vslam.types.imu import GRAVITY
from vslam.types.loops import LoopEdge
from vslam.types.map import Map
from vslam.types.map_kernels import erase_landmark, link_many, unlink
from vslam.types.trajectory import Trajectory, write_euroc

CAMERA = Camera(300.0, 310.0, 159.5, 119.5, 0.4, 320, 240)
NOISE = 0.2  # pixels


def small_map() -> Map:
    """Make a map with seven keyframes in a curve and 90 landmarks.

    Every third frame is a keyframe. The third keyframe is culled, and one landmark is erased. Each
    landmark is seen by most of the keyframes. Some keypoints observe nothing.
    """
    rng = np.random.default_rng(4)
    xyz = rng.uniform([-3, -2, 7], [5, 2, 14], (90, 3))
    map_ = Map(1.2 ** np.arange(8))
    T_wc = np.eye(4)
    ids = map_.add_landmarks(xyz, np.zeros((90, 4), np.uint64), 0)
    for k in range(7):
        T_cw = np.linalg.inv(T_wc)
        seen = np.flatnonzero(rng.random(90) < 0.8)
        pixels = CAMERA.project(xyz[seen] @ T_cw[:3, :3].T + T_cw[:3, 3])[:, :2]
        xy = rng.uniform(0, 200, (2 * len(seen), 2)).astype(np.float32)
        xy[::2] = pixels + rng.normal(0, NOISE, pixels.shape)
        n = len(xy)
        features = Features(
            xy, np.zeros(n, np.uint8), np.zeros(n, np.float32), np.zeros((n, 32), np.uint8),
            np.full(n, np.nan, np.float32),
        )  # fmt: skip
        keyframe = map_.add_keyframe(features, T_cw, 5.0 + 0.3 * k, 3 * k)
        map_.parents[keyframe] = keyframe - 1
        link_many(map_.arrays, map_.rows(keyframe).start + 2 * np.arange(len(seen)), ids[seen])
        T_wc = T_wc @ se3_exp(np.array([0.1, 0.0, 0.4, 0.0, 0.03, 0.0]))
    map_.cull_keyframe(2)
    erase_landmark(map_.arrays, 0)
    return map_


@pytest.fixture
def small() -> Reconstruction:
    return reconstruction_of(small_map(), CAMERA)


@pytest.fixture(scope="module")
def corridor_run(kitti_tree, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corridor")
    write_results(folder, run_pipeline(kitti_tree), pages=False)
    write_options(folder, RunOptions(data=str(kitti_tree), dataset="kitti", seq="00"))
    return folder


def some_colours(reconstruction: Reconstruction) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (len(reconstruction.xyz), 3), dtype=np.uint8)


def names_of(reconstruction: Reconstruction) -> list[str]:
    return [f"{frame:06d}.png" for frame in reconstruction.frames]


def test_a_reconstruction_is_the_living_part_of_a_map(small):
    assert small.frames.tolist() == [0, 3, 9, 12, 15, 18]
    assert len(small.xyz) == 89
    assert np.unique(small.landmark).tolist() == list(range(89))
    assert set(small.keyframe) == set(range(6))
    assert (np.diff(small.keyframe) >= 0).all()
    assert 0.5 * NOISE < np.median(small.reprojection_errors()) < 2.0 * NOISE


# -- COLMAP ---------------------------------------------------------------------------------------


@dataclass
class Colmap:
    """The contents of COLMAP's files by id.

    Images have a pose, name, xy and point ids. Points have xyz, rgb, an error and a track.
    """

    camera: tuple
    images: dict[int, tuple]
    points: dict[int, tuple]

    def errors(self) -> np.ndarray:
        """Compute the reprojection error of each keypoint in COLMAP's conventions."""
        fx, fy, cx, cy = self.camera[2:]
        found = []
        for pose, _, xy, ids in self.images.values():
            R = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()
            p = np.array([self.points[i][0] for i in ids]) @ R.T + pose[4:]
            uv = np.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy], axis=1)
            found.append(np.linalg.norm(uv - xy, axis=1))
        return np.concatenate(found)


def read_binary(folder: Path) -> Colmap:
    def unpack(layout: str) -> tuple:
        nonlocal at
        values = struct.unpack_from("<" + layout, data, at)
        at += struct.calcsize("<" + layout)
        return values

    data, at = (folder / "cameras.bin").read_bytes(), 0
    assert unpack("QIi") == (1, 1, 1)
    camera = unpack("QQ4d")
    assert at == len(data)
    data, at, images = (folder / "images.bin").read_bytes(), 0, {}
    for _ in range(unpack("Q")[0]):
        (image,), pose, (camera_id,) = unpack("I"), unpack("7d"), unpack("I")
        assert camera_id == 1
        name = data[at : data.index(b"\0", at)].decode()
        at += len(name) + 1
        rows = [unpack("ddq") for _ in range(unpack("Q")[0])]
        images[image] = (pose, name, [row[:2] for row in rows], [row[2] for row in rows])
    assert at == len(data)
    data, at, points = (folder / "points3D.bin").read_bytes(), 0, {}
    for _ in range(unpack("Q")[0]):
        (point,), xyz, rgb, (error, length) = unpack("Q"), unpack("3d"), unpack("3B"), unpack("dQ")
        points[point] = (xyz, rgb, error, [unpack("II") for _ in range(length)])
    assert at == len(data)
    return Colmap(camera, images, points)


def read_text(folder: Path) -> Colmap:
    def lines(name: str) -> list[list[str]]:
        text = (folder / name).read_text().splitlines()
        return [line.split() for line in text if not line.startswith("#")]

    ((_, model, *camera),) = lines("cameras.txt")
    assert model == "PINHOLE"
    images, points = {}, {}
    rows = lines("images.txt")
    for head, body in zip(rows[::2], rows[1::2], strict=True):
        xy = [(float(x), float(y)) for x, y in zip(body[::3], body[1::3], strict=True)]
        pose = tuple(map(float, head[1:8]))
        images[int(head[0])] = (pose, head[9], xy, list(map(int, body[2::3])))
    for point, *row in lines("points3D.txt"):
        track = list(map(int, row[7:]))
        points[int(point)] = (
            tuple(map(float, row[:3])), tuple(map(int, row[3:6])), float(row[6]),
            list(zip(track[::2], track[1::2], strict=True)),
        )  # fmt: skip
    return Colmap((int(camera[0]), int(camera[1]), *map(float, camera[2:])), images, points)


@pytest.mark.parametrize("text", [False, True])
def test_colmap_model(small, tmp_path, text):
    colours = some_colours(small)
    save_colmap(tmp_path, small, names_of(small), colours, text=text)
    model = (read_text if text else read_binary)(tmp_path)
    # The centre of the upper left pixel is (0.5, 0.5).
    assert model.camera == (320, 240, 300.0, 310.0, 160.0, 120.0)
    assert [name for _, name, *_ in model.images.values()] == names_of(small)
    observed = np.concatenate([xy for *_, xy, _ in model.images.values()])
    np.testing.assert_array_equal(observed, small.xy + 0.5)
    errors = model.errors()
    assert np.median(errors) < 2.0 * NOISE
    np.testing.assert_allclose(errors, small.reprojection_errors(), atol=1e-9)
    for k, (point, (xyz, rgb, error, track)) in enumerate(sorted(model.points.items())):
        assert xyz == tuple(small.xyz[k])
        assert rgb == tuple(colours[k])
        assert error == pytest.approx(errors[small.landmark == k].mean())
        assert len(track) == np.count_nonzero(small.landmark == k)
        for image, index in track:
            assert model.images[image][3][index] == point


def test_colmap_text_and_binary_are_the_same_model(small, tmp_path):
    for text in (True, False):
        save_colmap(tmp_path, small, names_of(small), some_colours(small), text=text)
    assert read_text(tmp_path) == read_binary(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_pycolmap_opens_the_model(small, tmp_path, text):
    pycolmap = pytest.importorskip("pycolmap")
    save_colmap(tmp_path, small, names_of(small), some_colours(small), text=text)
    model = pycolmap.Reconstruction(tmp_path)
    assert (model.num_reg_images(), model.num_points3D()) == (6, 89)
    assert model.compute_num_observations() == len(small.xy)
    errors = [
        np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy)
        for image in model.images.values()
        for point in image.points2D
    ]
    np.testing.assert_allclose(np.sort(errors), np.sort(small.reprojection_errors()), atol=1e-6)


# -- nerfstudio and PLY ---------------------------------------------------------------------------


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "uchar": "u1"}
    fields = [(words[2], types[words[1]]) for words in map(str.split, lines[3:])]
    rows = np.frombuffer(body, fields)
    assert lines[2] == f"element vertex {len(rows)}"
    xyz = np.stack([rows[name] for name in ("x", "y", "z")], axis=1)
    if len(fields) == 3:
        return xyz, None
    return xyz, np.stack([rows[name] for name in ("red", "green", "blue")], axis=1)


def nerfstudio_errors(folder: Path, reconstruction: Reconstruction) -> np.ndarray:
    """Return the reprojection errors in pixels of the points of ``ply_file_path``.

    In nerfstudio, cameras look along -z, and y is up.
    """
    content = json.loads((folder / "transforms.json").read_text())
    xyz, _ = read_ply(folder / content["ply_file_path"])
    T_cw = np.linalg.inv([frame["transform_matrix"] for frame in content["frames"]])
    T_cw = T_cw[reconstruction.keyframe]
    p = np.einsum("nij,nj->ni", T_cw[:, :3, :3], xyz[reconstruction.landmark]) + T_cw[:, :3, 3]
    assert (p[:, 2] < 0).all()
    u = content["fl_x"] * p[:, 0] / -p[:, 2] + content["cx"]
    v = -content["fl_y"] * p[:, 1] / -p[:, 2] + content["cy"]
    return np.linalg.norm(np.stack([u, v], axis=1) - (reconstruction.xy + 0.5), axis=1)


def test_nerfstudio(small, tmp_path):
    colours = some_colours(small)
    save_nerfstudio(tmp_path, small, names_of(small), colours)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert [frame["file_path"] for frame in content["frames"]] == names_of(small)
    assert (content["w"], content["h"]) == (320, 240)
    assert (content["cx"], content["cy"]) == (160.0, 120.0)
    errors = nerfstudio_errors(tmp_path, small)
    np.testing.assert_allclose(errors, small.reprojection_errors(), atol=1e-3)
    xyz, rgb = read_ply(tmp_path / content["ply_file_path"])
    np.testing.assert_array_equal(rgb, colours)
    applied = np.array(content["applied_transform"])
    np.testing.assert_allclose(small.xyz @ applied[:, :3].T + applied[:, 3], xyz, atol=1e-5)
    np.testing.assert_allclose(xyz[:, 2], -small.xyz[:, 1], atol=1e-6)  # z is up
    assert np.linalg.det(applied[:, :3]) == pytest.approx(1.0)


def test_ply_with_and_without_colours(small, tmp_path):
    colours = some_colours(small)
    save_ply(tmp_path / "a.ply", small.xyz, colours)
    save_ply(tmp_path / "b.ply", small.xyz)
    xyz, rgb = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(xyz, small.xyz.astype(np.float32))
    np.testing.assert_array_equal(rgb, colours)
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply")[0], xyz)
    assert read_ply(tmp_path / "b.ply")[1] is None


def test_the_colour_of_a_landmark_is_the_median_of_what_was_seen(small):
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (6, 240, 320), dtype=np.uint8)
    colours = landmark_colours(small, images)
    for k, colour in enumerate(colours):
        seen = []
        for i in np.flatnonzero(small.landmark == k):
            x, y = np.rint(small.xy[i]).astype(int)
            seen.append(images[small.keyframe[i], min(max(y, 0), 239), min(max(x, 0), 319)])
        assert colour.tolist() == [sorted(seen)[(len(seen) - 1) // 2]] * 3


# -- g2o and EuRoC --------------------------------------------------------------------------------


def test_gtsam_reads_the_pose_graph_and_weighs_it_alike(tmp_path):
    map_, rng = small_map(), np.random.default_rng(2)
    loop = LoopEdge(6, 0, 0.5, True, "closed", T_query_match=np.eye(4))
    graph = essential_graph(map_, [loop], PoseGraphConfig(min_shared=30))
    T_i_j = np.array([T @ se3_exp(rng.normal(0, 0.01, 6)) for T in graph.T_i_j])
    ids = map_.frames[graph.keyframes]
    path = tmp_path / "graph.g2o"
    save_g2o(path, ids, inverses(graph.T_cw), graph.edges, T_i_j, graph.sigmas)
    factors, values = gtsam.readG2o(str(path), True)
    assert sorted(values.keys()) == ids.tolist()
    for k, T_wc in zip(ids.tolist(), inverses(graph.T_cw), strict=True):
        np.testing.assert_allclose(values.atPose3(k).matrix(), T_wc, atol=1e-12)
    assert factors.size() == len(graph.edges)
    chi2 = edge_errors(graph.T_cw, graph.edges, T_i_j, graph.sigmas)
    for e in range(factors.size()):
        factor = factors.at(e)
        assert list(factor.keys()) == ids[graph.edges[e]].tolist()
        np.testing.assert_allclose(factor.measured().matrix(), T_i_j[e], atol=1e-12)
        assert 2.0 * factor.error(values) == pytest.approx(chi2[e], rel=1e-6)


def test_loops_and_gaps_of_a_run_become_edges(corridor_run, tmp_path):
    grown = small_map()
    for row in range(grown.rows(5).start, grown.n_rows):  # of the last two keyframes
        if grown.arrays.landmark[row] >= 0:
            unlink(grown.arrays, row)
    shared = grown.add_landmarks(np.ones((20, 3)), np.zeros((20, 4), np.uint64), 5)
    for k in (5, 6):
        link_many(grown.arrays, grown.rows(k).start + np.arange(20), shared)
    grown.begin_submap(5, 4, predicted=True)
    T_query_match = se3_exp(np.array([0.1, 0.0, 2.0, 0.0, 0.1, 0.0]))
    # The keyframe at frame 6 was culled: its parent takes its place.
    loop = LoopEdge(6, 2, 0.5, True, "closed", T_query_match=T_query_match)
    save_map(tmp_path / "map.npz", StoredMap(grown, CAMERA, (loop,)))
    stored = load_map(tmp_path / "map.npz")
    map_ = stored.map
    assert map_.frames.tolist() == [0, 3, 9, 12, 15, 18]
    config = load_config(corridor_run / "config.json").pose_graph
    graph = essential_graph(map_, stored.loops, config, driven=True)
    kinds = dict(zip(map(tuple, graph.edges.tolist()), graph.kind.tolist(), strict=True))
    tree = {(k, k + 1): TREE for k in range(5)}
    assert kinds == tree | {(3, 4): GAP, (1, 5): LOOP}
    expected = np.linalg.inv(T_query_match @ grown.keyframes.T_c_parent[2])
    measured = graph.edges.tolist().index([1, 5])
    np.testing.assert_allclose(graph.T_i_j[measured], expected, atol=1e-9)


def test_the_picture_of_a_loop_shows_its_images_and_where_it_lies_in_the_map(tmp_path, monkeypatch):
    tools = Path(__file__).parents[2] / "tools"
    monkeypatch.syspath_prepend(str(tools / "experiments" / "loops"))
    tool = importlib.import_module("loop_picture")
    loop = LoopEdge(6, 1, 0.5, True, "closed", T_query_match=np.eye(4))
    save_map(tmp_path / "map.npz", StoredMap(small_map(), CAMERA, (loop,)))
    (tmp_path / "figures").mkdir()
    seen = np.full((100, 1288, 3), 200, np.uint8)
    cv2.imwrite(str(tmp_path / "figures" / "loop-18-3.jpg"), seen)
    picture = tool.draw(tmp_path)
    np.testing.assert_array_equal(picture[:100], seen)
    below = picture[100:]
    green = np.abs(below.astype(int) - (153, 211, 52)).max(axis=2) < 10
    orange = np.abs(below.astype(int) - (36, 191, 251)).max(axis=2) < 10
    assert below.shape == (540, 1288, 3)
    assert 200 < np.count_nonzero(green) < 10_000
    assert 20 < np.count_nonzero(orange) < 10_000


def test_evo_reads_the_csv_of_euroc(tmp_path):
    from evo.tools.file_interface import read_euroc_csv_trajectory

    T_wc = np.array([se3_exp(np.array([k, 0.2, 1.0, 0.3, 0.1 * k, 0.0])) for k in range(4)])
    seconds = 1403636579.763555527 + 0.05 * np.arange(4)
    write_euroc(tmp_path / "data.csv", Trajectory(seconds, T_wc))
    first = (tmp_path / "data.csv").read_text().splitlines()[1].split(",")[0]
    assert abs(int(first) - 1403636579763555527) < 200  # the precision of float64
    read = read_euroc_csv_trajectory(tmp_path / "data.csv")
    np.testing.assert_allclose(read.timestamps, seconds, rtol=0, atol=1e-6)
    np.testing.assert_allclose(read.poses_se3, T_wc, atol=1e-9)


# -- level exports --------------------------------------------------------------------------------

TILTED = GRAVITY * Rotation.from_rotvec([0.3, 0.1, -0.2]).apply([0.0, 1.0, 0.0])


def export(*words: object) -> str:
    done = CliRunner().invoke(every_command(), ["export", *map(str, words)])
    if done.exception is not None:
        raise done.exception
    return done.output


@pytest.mark.parametrize("gravity", [TILTED, (0, 0, 1), (0, 0, -9.81), (0, -9.81, 0), (3, -9, 0)])
def test_a_level_world_is_turned_until_z_points_up(gravity):
    T = level_world(np.array(gravity, float))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    length = np.linalg.norm(gravity)
    np.testing.assert_allclose(T[:3, :3] @ gravity, [0.0, 0.0, -length], atol=1e-8)


def test_a_level_camera_keeps_its_right_and_looks_along_y():
    np.testing.assert_array_equal(level_world(np.array([0.0, 9.81, 0.0])), T_UPRIGHT_CAMERA)


def test_a_turned_map_looks_the_same(small):
    level = turned(small, level_world(TILTED))
    np.testing.assert_allclose(level.reprojection_errors(), small.reprojection_errors(), atol=1e-9)


@pytest.mark.slow
def test_all_exports_of_a_run_have_the_same_level(kitti_tree, tmp_path):
    write_results(tmp_path, replace(run_pipeline(kitti_tree), gravity=TILTED), pages=False)
    write_options(tmp_path, RunOptions(data=str(kitti_tree), dataset="kitti", seq="00"))
    for kind in ("euroc", "ply", "g2o", "colmap", "nerfstudio"):
        export(kind, tmp_path, "--level", *["--text"] * (kind == "colmap"))
    T_level_world = level_world(TILTED)
    finished = read_run(tmp_path)
    reconstruction = reconstruction_of(finished.map, finished.camera)
    T_wc = T_level_world @ reconstruction.T_wc
    _, values = gtsam.readG2o(str(tmp_path / "pose_graph.g2o"), True)
    g2o = [values.atPose3(k).matrix() for k in reconstruction.frames.tolist()]
    np.testing.assert_allclose(g2o, T_wc, atol=1e-9)
    transforms = json.loads((tmp_path / "nerfstudio" / "transforms.json").read_text())
    nerf = np.array([one["transform_matrix"] for one in transforms["frames"]])
    np.testing.assert_allclose(nerf @ np.diag([1, -1, -1, 1]), T_wc, atol=1e-9)
    np.testing.assert_allclose(transforms["applied_transform"], T_level_world[:3], atol=1e-9)
    colmap = read_text(tmp_path / "colmap" / "sparse" / "0")
    xyz = reconstruction.xyz @ T_level_world[:3, :3].T
    np.testing.assert_allclose([one[0] for one in colmap.points.values()], xyz, atol=1e-9)
    assert np.median(colmap.errors()) < 1.0
    first = np.array((tmp_path / "trajectory_euroc.csv").read_text().splitlines()[1].split(","))
    rotation = Rotation.from_quat(first[[5, 6, 7, 4]].astype(float)).as_matrix()
    np.testing.assert_allclose(rotation, T_level_world[:3, :3], atol=1e-6)


def test_a_run_without_an_imu_cannot_be_levelled(corridor_run, tmp_path):
    with pytest.raises(InputError, match="--level needs gravity, which no IMU has measured"):
        export("euroc", corridor_run, "--level", "--out", tmp_path / "level.csv")
    assert not list(tmp_path.iterdir())


# -- files are complete, and nothing is replaced --------------------------------------------------


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_there_is_never_replaced(tmp_path, kind):
    begin = partial(new_output, folder=kind == "folder")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    for name in ("taken", "taken/mine", "link"):
        with (
            pytest.raises(InputError, match=f"{name}: exists already.* --out"),
            begin(tmp_path / name),
        ):
            pytest.fail("not to be reached")
    assert (tmp_path / "taken" / "mine").read_text() == "mine"


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyError()])
def test_a_failed_export_leaves_nothing(tmp_path, kind, error):
    begin = partial(new_output, folder=kind == "folder")
    told = ResultsError if isinstance(error, OSError) else KeyError

    def fail() -> None:
        with begin(tmp_path / "a" / "b") as part:
            (part / "x" if kind == "folder" else part).write_text("half of it")
            raise error

    with pytest.raises(told) as caught:
        fail()
    if told is ResultsError:
        assert "a/b: cannot be written (No space left on device)" in str(caught.value)
    assert list((tmp_path / "a").iterdir()) == []


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "made").mkdir()
    with new_output(tmp_path / "made", folder=True) as part:
        (part / "x").write_text("x")
    assert [path.name for path in tmp_path.rglob("*")] == ["made", "x"]


# -- the commands ---------------------------------------------------------------------------------


def vslam(*words: object) -> str:
    result = CliRunner().invoke(every_command(), list(map(str, words)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.parametrize("link", [False, True])
def test_export_colmap_and_nerfstudio(corridor_run, kitti_tree, tmp_path, link):
    options = ["--link"] if link else []
    vslam("export", "colmap", corridor_run, "--out", tmp_path / "c", *options, "--quiet")
    out = vslam("export", "nerfstudio", corridor_run, "--out", tmp_path / "n", *options)
    finished = read_run(corridor_run)
    reconstruction = reconstruction_of(finished.map, finished.camera)
    assert f"{len(reconstruction.xyz):,} landmarks" in out
    assert np.median(nerfstudio_errors(tmp_path / "n", reconstruction)) < 1.0
    model = read_binary(tmp_path / "c" / "sparse" / "0")
    assert np.median(model.errors()) < 1.0
    sequence = open_sequence("kitti", kitti_tree, "00")
    for _, name, xy, ids in model.images.values():
        assert (tmp_path / "c/images" / name).is_symlink() == link
        for folder in ("c", "n"):
            image = cv2.imread(str(tmp_path / folder / "images" / name), cv2.IMREAD_GRAYSCALE)
            np.testing.assert_array_equal(image, sequence.read(int(name[:6]))[0])
        # The grey value of a corner differs less between views than that of random pixels.
        x, y = (np.array(xy) - 0.5).round().astype(int).T
        grey = np.array([model.points[i][1][0] for i in ids], float)
        assert np.corrcoef(image[y, x], grey)[0, 1] > 0.8
    content = json.loads((tmp_path / "n" / "transforms.json").read_text())
    assert all((tmp_path / "n" / frame["file_path"]).is_file() for frame in content["frames"])


def test_export_files_into_the_folder_of_the_run(corridor_run):
    vslam("export", "ply", corridor_run)
    vslam("export", "g2o", corridor_run)
    vslam("export", "euroc", corridor_run)
    finished = read_run(corridor_run)
    xyz, rgb = read_ply(corridor_run / "landmarks.ply")
    assert len(xyz) == len(rgb) == len(reconstruction_of(finished.map, finished.camera).xyz)
    _, values = gtsam.readG2o(str(corridor_run / "pose_graph.g2o"), True)
    assert sorted(values.keys()) == finished.map.frames.tolist()
    rows = np.loadtxt(corridor_run / "trajectory_euroc.csv", delimiter=",")
    tum = np.loadtxt(corridor_run / "trajectory.tum")
    np.testing.assert_allclose(rows[:, 0] * 1e-9, tum[:, 0], atol=1e-9)
    np.testing.assert_allclose(rows[:, [1, 2, 3, 5, 6, 7, 4]], tum[:, 1:], atol=1e-9)


def test_ply_needs_no_image_without_colours(corridor_run, tmp_path):
    words = ("--data", "nowhere", "--no-colours", "--out", tmp_path / "grey.ply")
    vslam("export", "ply", corridor_run, *words)
    assert read_ply(tmp_path / "grey.ply")[1] is None


def test_map_info(corridor_run):
    lines = [" ".join(line.split()) for line in vslam("map", "info", corridor_run).splitlines()]
    out = "\n".join([*lines, ""])
    finished = read_run(corridor_run)
    reconstruction = reconstruction_of(finished.map, finished.camera)
    assert f"keyframes {len(reconstruction.frames)}, frames 0 to " in out
    assert f"\nlandmarks {len(reconstruction.xyz)}\n" in out
    assert f"observations {len(reconstruction.xy)}, " in out
    assert "sub-maps 1\n" in out
    assert "stereo, 480x160" in out


def test_map_info_tells_depth_from_a_pair(tmp_path):
    save_map(tmp_path / "map.npz", StoredMap(small_map(), replace(CAMERA, depth=True)))
    assert "rgbd, " in vslam("map", "info", tmp_path)


def refusal(*words: object) -> str:
    result = CliRunner().invoke(every_command(), list(map(str, words)))
    assert isinstance(result.exception, InputError), result.output
    assert "\n" not in str(result.exception)
    return str(result.exception)


def test_refusals(corridor_run, kitti_tree, tmp_path):
    assert "no map.npz here" in refusal("export", "colmap", tmp_path)
    assert "map.npz: cannot be read" in refusal("map", "info", tmp_path)
    out = ("--out", tmp_path / "out")
    words = ("export", "nerfstudio", corridor_run, *out)
    assert "--data" in refusal(*words, "--data", tmp_path / "gone")
    # Other images under the same name.
    other = tmp_path / "other"
    for path in kitti_tree.rglob("*.*"):
        copy = other / path.relative_to(kitti_tree)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.symlink_to(path)
    times = other / "sequences/00/times.txt"
    text = times.read_text()
    times.unlink()
    times.write_text("".join(f"{1.0 + float(line)}\n" for line in text.split()))
    assert "use --data to give" in refusal(*words, "--data", other)
    # The report has a different version, or is missing.
    run = tmp_path / "run"
    run.mkdir()
    for name in ("map.npz", "config.json"):
        (run / name).symlink_to(corridor_run / name)
    assert "missing or damaged" in refusal("export", "g2o", run, *out)
    report = json.loads((corridor_run / "report.json").read_text())
    (run / "report.json").write_text(json.dumps({**report, "schema_version": 3, "eyes": 2}))
    assert "report schema 3, but this version of vslam reads 5" in refusal(
        "export", "g2o", run, *out
    )
    np.savez(tmp_path / "new.npz", schema=1, keyframe_first_row=np.zeros(1))
    assert "a map of schema 1" in refusal("map", "info", tmp_path / "new.npz")
    assert not (tmp_path / "out").exists()


def test_what_can_be_exported_of_a_live_camera(corridor_run, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    for name in ("map.npz", "config.json", "run.json"):
        (run / name).symlink_to(corridor_run / name)
    report = json.loads((corridor_run / "report.json").read_text())
    (run / "report.json").write_text(json.dumps({**report, "dataset": "camera"}))
    for kind in ("colmap", "nerfstudio", "ply"):
        message = refusal("export", kind, run)
        assert "images of a live camera are not stored" in message
        assert "export g2o, euroc or ply --no-colours" in message
    vslam("export", "ply", run, "--no-colours")
    vslam("export", "g2o", run)


def test_images_are_opened_as_the_run_opened_them(corridor_run, kitti_tree, tmp_path):
    """The run used its own calibration and every second frame. The images were moved afterwards."""
    camera = read_run(corridor_run).camera
    calib = write_calibration(tmp_path / "own.yaml", camera)
    words = ("--calib", calib, "--every", "2", "--no-record", "--no-report", "--quiet")
    vslam("run", "--data", kitti_tree, *words, "--out", tmp_path / "runs")
    run = tmp_path / "runs" / "latest"
    there = json.loads((run / "run.json").read_text())["data"]
    assert there == str(kitti_tree)
    vslam("export", "colmap", run)
    (tmp_path / "moved").symlink_to(kitti_tree)
    vslam("export", "colmap", run, "--data", tmp_path / "moved", "--out", tmp_path / "again")
    names = sorted(path.name for path in (run / "colmap/images").iterdir())
    sequence = open_sequence("kitti", kitti_tree, "00", every=2)
    for folder in (run / "colmap", tmp_path / "again"):
        for name in names:
            image = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)
            np.testing.assert_array_equal(image, sequence.read(int(name[:6]))[0])


def test_a_phone_video_in_two_commands(corridor, tmp_path, monkeypatch):
    """Keyframes and landmarks are exported in colour, although the run used grey images."""
    monkeypatch.chdir(tmp_path)
    tinted = [np.dstack([image // 2, image, 255 - image]) for image in corridor.left]
    write_video(Path("phone.mkv"), tinted)
    write_calibration(Path("phone.yaml"), corridor.camera, mono=True)
    words = ("--sensor", "mono", "--calib", "phone.yaml", "--no-record", "--no-report", "--quiet")
    vslam("run", "phone.mkv", *words)
    for what in ("colmap", "nerfstudio"):
        vslam("export", what, "runs/latest")
    images = sorted(Path("runs/latest/colmap/images").iterdir())
    assert len(images) > 3
    for path in images:
        np.testing.assert_array_equal(cv2.imread(str(path)), tinted[int(path.stem)])
    points = read_binary(Path("runs/latest/colmap/sparse/0")).points.values()
    red, green, blue = np.array([point[1] for point in points], int).T
    assert np.array_equal(red, 255 - green)
    assert np.array_equal(blue, green // 2)
    _, colours = read_ply(Path("runs/latest/nerfstudio/sparse_pc.ply"))
    assert len(np.unique(colours, axis=0)) > 10


@pytest.mark.slow
@needs_kitti
def test_real_keyframes_reproject_within_a_pixel(tmp_path):
    write_results(tmp_path, run_pipeline(KITTI, "06", max_frames=51), pages=False)
    write_options(tmp_path, RunOptions(data=str(KITTI), dataset="kitti", seq="06", max_frames=51))
    for what in ("colmap", "nerfstudio"):
        vslam("export", what, tmp_path, "--quiet")
    finished = read_run(tmp_path)
    reconstruction = reconstruction_of(finished.map, finished.camera)
    assert len(reconstruction.xyz) > 1000
    assert np.median(read_binary(tmp_path / "colmap" / "sparse" / "0").errors()) < 1.0
    assert np.median(nerfstudio_errors(tmp_path / "nerfstudio", reconstruction)) < 1.0
