"""The rendered towns: exact geometry, reproducible images, and invalid input."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.datasets import open_sequence
from vslam.datasets.kitti import open_kitti
from vslam.support.errors import InputError
from vslam.support.machine import has_avx2
from vslam.types.camera import Camera
from vslam_lab.loopbench.drives import render_views
from vslam_lab.towns import parse_drive, store, textures, vehicles
from vslam_lab.towns import town as town_module
from vslam_lab.towns.files import lock_of
from vslam_lab.towns.pairs import render_pairs
from vslam_lab.towns.passes import Passes, pass_starts
from vslam_lab.towns.render import Light, Moment, Renderer, sensor_image
from vslam_lab.towns.routes import (
    CAMERA_HEIGHT,
    ROUTES,
    built_in_route,
    route_of_poses,
)
from vslam_lab.towns.scene import AtlasBuilder, join, patches
from vslam_lab.towns.shadows import cast_shadows, lamp_pools
from vslam_lab.towns.site import ALIASES, Variation
from vslam_lab.towns.solids import turn
from vslam_lab.towns.town import build_town

CAMERA = Camera(360.0, 360.0, 300.3, 95.7, 0.54, 620, 190)
BY_DAY = Light(np.array([0.0, -0.8, -0.6]), visibility=1e9, haze=0.0)
SIDE = 1024
DOTS = 8  # in each row and column


def straight(n=64, step=1.0):
    """Return the poses of a straight drive with a little sway."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step * np.arange(n)
    T[:, 0, 3] = 0.2 * np.sin(0.1 * np.arange(n))
    return T


@pytest.fixture(scope="module")
def route():
    return route_of_poses(straight(), "street")


@pytest.fixture(scope="module")
def town(route):
    return build_town(route, Variation(seed=3))


def dotted_world():
    """Make a slanted wall with bright dots before grey ground, and the positions of the dots."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] + 0.5
    pitch = SIDE / DOTS
    from_dot = ((x % pitch) - pitch / 2) ** 2 + ((y % pitch) - pitch / 2) ** 2
    atlas = AtlasBuilder()
    wall = atlas.add(20 + 180 * np.exp(-0.5 * from_dot / 9.0**2))
    plain = atlas.add(np.full((4, 4), 4.0))
    origin, s, t = (
        np.array([-4.0, -3.2, 11.0]),
        np.array([7.6, 0.1, 3.0]),
        np.array([0.2, 4.1, 0.3]),
    )
    surfaces = join(
        [
            patches(origin, s, t, wall, thing=0),
            patches(
                np.array([-40.0, 1.65, -10.0]),
                np.array([80.0, 0, 0]),
                np.array([0, 0, 90.0]),
                plain,
            ),
        ]
    )
    at = (np.stack(np.meshgrid(np.arange(DOTS), np.arange(DOTS)), -1).reshape(-1, 2) + 0.5) / DOTS
    return surfaces, atlas.build(), plain, origin + at[:, :1] * s + at[:, 1:] * t


def draw(surfaces, atlas, sky, T_wc, threads=1):
    renderer = Renderer(CAMERA, atlas, sky, threads)
    empty = cast_shadows(surfaces.select(surfaces.thing < -1), atlas, BY_DAY.sun)
    views = renderer.stereo(Moment(surfaces, empty, BY_DAY), T_wc)
    renderer.close()
    return views


def centroids(image, near):
    found = []
    for u, v in near:
        c, r = round(u), round(v)
        patch = image[r - 6 : r + 7, c - 6 : c + 7].astype(np.float64)
        weight = np.clip(patch - 1.25 * np.percentile(patch, 20), 0, None) ** 2
        rows, columns = np.mgrid[r - 6 : r + 7, c - 6 : c + 7]
        found.append([(columns * weight).sum(), (rows * weight).sum()] / weight.sum())
    return np.array(found)


@pytest.mark.parametrize("yaw", [-0.12, 0.0, 0.2])
def test_projection_and_disparity_are_exact(yaw):
    surfaces, atlas, sky, dots = dotted_world()
    T_wc = np.eye(4)
    T_wc[:3, :3] = turn(yaw)
    T_wc[:3, 3] = [0.3, -0.4, 0.7]
    left, right = draw(surfaces, atlas, sky, T_wc)
    uvr = CAMERA.project((dots - T_wc[:3, 3]) @ T_wc[:3, :3])
    inside = (uvr > 16).all(1) & (uvr[:, :2] < [604, 174]).all(1)
    uvr = uvr[inside]
    assert len(uvr) > 25
    seen = centroids(left.image, uvr[:, :2])
    error = np.linalg.norm(seen - uvr[:, :2], axis=1)
    assert error.max() < 0.05
    seen_right = centroids(right.image, uvr[:, [2, 1]])
    at = np.rint(uvr[:, :2]).astype(int)
    z = left.depth[at[:, 1], at[:, 0]]
    # The depth belongs to the pixel's centre, the disparity to the dot.
    slope = np.abs(np.gradient(left.depth, axis=1)[at[:, 1], at[:, 0]])
    assert (
        np.abs(seen[:, 0] - seen_right[:, 0] - CAMERA.bf / z).max()
        < 0.05 + (CAMERA.bf / z**2 * slope).max()
    )


def test_depth_is_that_of_the_plane():
    surfaces, atlas, sky, _ = dotted_world()
    left, _ = draw(surfaces, atlas, sky, np.eye(4))
    v = np.arange(150, 190)
    expected = 1.65 * CAMERA.fy / (v - CAMERA.cy)
    np.testing.assert_allclose(left.depth[150:, 40], expected, rtol=1e-5)
    assert left.depth[2, 2] == 0  # sky


def test_ground_under_the_camera_is_clipped_not_torn():
    surfaces, atlas, sky, _ = dotted_world()
    down = np.eye(4)
    down[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks at the ground below
    left, _ = draw(surfaces, atlas, sky, down)
    np.testing.assert_allclose(left.depth, 1.65, rtol=1e-5)


def test_cut_outs_layers_and_near_before_far():
    atlas = AtlasBuilder()
    holes = np.zeros((8, 8))
    holes[:, 4:] = 255
    plain = [atlas.add(np.full((8, 8), grey)) for grey in (40.0, 160.0)]
    cut = atlas.add(np.full((8, 8), 100.0), holes)
    wide = np.array([40.0, 0, 0]), np.array([0, 30.0, 0])
    far = patches(np.array([-20.0, -15.0, 20.0]), *wide, plain[0], thing=0)
    marked = patches(np.array([-20.0, -15.0, 20.0]), *wide, plain[1], layer=1, thing=0)
    near = patches(np.array([-20.0, -15.0, 10.0]), *wide, cut, thing=0)
    middle = CAMERA.height // 2
    alone, _ = draw(far, atlas.build(), plain[0], np.eye(4))
    left, _ = draw(join([marked, near, far]), atlas.build(), plain[0], np.eye(4))
    assert left.depth[middle, 500] == pytest.approx(10.0)
    assert left.depth[middle, 100] == pytest.approx(20.0)
    assert left.image[middle, 100] == pytest.approx(4 * alone.image[middle, 100], rel=1e-4)


def test_shadow_falls_away_from_the_sun():
    atlas = AtlasBuilder()
    grey = atlas.add(np.full((4, 4), 100.0))
    ground = patches(
        np.array([-40.0, 1.65, 0.0]), np.array([80.0, 0, 0]), np.array([0, 0, 80.0]), grey
    )
    wall = patches(
        np.array([0.0, -2.35, 10.0]), np.array([0, 0, 6.0]), np.array([0, 4.0, 0]), grey, thing=0
    )
    scene = join([ground, wall])
    built = atlas.build()
    light = Light(np.array([-0.6, -0.8, 0.0]), visibility=1e9, haze=0.0)  # from the left
    renderer = Renderer(CAMERA, built, grey)
    moment = Moment(scene, cast_shadows(scene, built, light.sun), light)
    left, _ = renderer.stereo(moment, np.eye(4))
    u, v, _ = CAMERA.project(np.array([[-1.5, 1.65, 13.0], [1.5, 1.65, 13.0], [4.0, 1.65, 13.0]])).T
    sunny, shaded, beyond = left.image[np.rint(v).astype(int), np.rint(u).astype(int)]
    assert shaded < 0.5 * sunny
    assert beyond == pytest.approx(sunny, rel=1e-3)


@pytest.fixture
def unpainted(monkeypatch):
    """Make towns with the real geometry, but with textures that need no time and deep ground."""
    plain = np.full((2, 2), 99.0, np.float32)
    twice = (plain, plain)
    for module, names, value in (
        (town_module, ["facade"], twice),
        (vehicles, ["_paint_side"], twice),
        (vehicles, ["_paint_end", "_paint_strip", "_paint_glass"], plain),
        (textures, ["foliage", "hedge", "fence", "sign"], twice),
        (textures, ["sky", "poster", "garden_wall", "bark"], plain),
    ):
        for name in names:
            monkeypatch.setattr(module, name, lambda *_, value=value, **__: value)
    below = patches(np.array([0.0, 1e4, 0.0]), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), 0)
    monkeypatch.setattr(town_module, "make_ground", lambda *_: below)


def clearance(surfaces, cameras):
    """Return the smallest distance of cameras from surfaces, if it is below about 4 m."""
    tree = cKDTree(cameras)
    middle = surfaces.origin + 0.5 * (surfaces.edge_s + surfaces.edge_t)
    lengths = [np.linalg.norm(edge, axis=1) for edge in (surfaces.edge_s, surfaces.edge_t)]
    near = surfaces.select(tree.query(middle)[0] < 0.5 * (lengths[0] + lengths[1]) + 4.0)
    grid = np.linspace(0, 1, 21)
    s, t = (x.ravel()[:, None] for x in np.meshgrid(grid, grid))
    points = (
        near.origin + s[..., None] * near.edge_s + t[..., None] * near.edge_t
    )  # (grid, surfaces, 3)
    points = points[((s + t <= 1.0) | ~near.triangle)]
    return tree.query(points)[0].min(initial=np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROUTES)
def test_nothing_stands_near_a_camera_of_any_route(name, unpainted):
    route = built_in_route(name)
    town = build_town(route, Variation(change=0.5))
    built = town.surfaces.select(np.arange(1, len(town.surfaces.origin)))
    assert len(built.origin) > 1000
    assert clearance(built, route.T_wc[:, :3, 3]) >= 2.5


def test_pairs_keep_clear_of_the_town_beside_the_route(route, unpainted):
    town = build_town(route, Variation(), aside=(-1.4, 1.4, 0.0))
    built = town.surfaces.select(np.arange(1, len(town.surfaces.origin)))
    for aside in (-1.4, -0.7, 0.7, 1.4):
        cameras = route.T_wc[:, :3, 3] + aside * route.T_wc[:, :3, 0]
        assert clearance(built, cameras) >= 2.5


@pytest.mark.slow
def test_moving_cars_keep_clear(unpainted):
    route = built_in_route("demo")
    variation = Variation(moving=5)
    passes = Passes(route, town := build_town(route, variation), variation)
    standing = len(town.surfaces.origin)
    seen = 0
    for frame in range(0, len(route.T_wc), 6):
        moment = passes.at(frame)
        cars = moment.surfaces.select(np.arange(standing, len(moment.surfaces.origin)))
        seen += len(cars.origin) > 0
        assert clearance(cars, route.T_wc[frame : frame + 1, :3, 3]) >= 2.5
    assert seen > 20


@pytest.mark.slow
def test_sight_lines_are_closed_at_bends(unpainted):
    """Along the whole loop of the demo, nearly every ray near the horizon meets a surface."""
    route = built_in_route("demo")
    town = build_town(route, Variation())
    renderer = Renderer(route.camera, town.atlas, town.sky, 2)
    moment = Passes(route, town, Variation()).at(0)
    horizon = round(route.camera.cy) - 6
    for frame in range(5, len(route.T_wc), 50):
        left, _ = renderer.stereo(moment, route.T_wc[frame])
        row = left.depth[horizon - 12 : horizon].max(axis=0)
        assert (row > 0).mean() > 0.97, frame
    renderer.close()


@pytest.mark.slow
def test_aliased_facades_repeat(route, monkeypatch, unpainted):
    painted = []
    monkeypatch.setattr(
        town_module, "facade", lambda rng, *rest, **_: painted.append((rng.random(), rest[2]))
        or (np.full((2, 2), 9.0),) * 2,
    )  # fmt: skip
    build_town(route, Variation())
    assert len(set(painted)) == len(painted) > 40
    painted.clear()
    build_town(route, Variation(aliased=True))
    assert len(painted) > 40
    assert len(set(painted)) <= 4 * ALIASES


@pytest.mark.slow
def test_places_match_themselves_only(route, town):
    renderer = Renderer(route.camera, town.atlas, town.sky)
    moment = Passes(route, town, Variation(seed=3)).at(0)
    orb = cv2.ORB_create(1500)
    described = []
    for frame, aside in ((4, 0.0), (4, 0.5), (56, 0.0)):
        T = route.T_wc[frame].copy()
        T[0, 3] += aside
        view, _ = renderer.stereo(moment, T)
        image = sensor_image(view.image, route.camera, yaw_rate=0.0, night=0.0, key=(0, frame, 0))
        described.append(orb.detectAndCompute(image, None))

    def agreeing(a, b):
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(a[1], b[1], k=2)
        good = [m for m, n in pairs if m.distance < 0.75 * n.distance]
        if len(good) < 8:
            return 0
        xy = [np.float32([p[0][i].pt for i in k]) for p, k in (
            (a, [m.queryIdx for m in good]), (b, [m.trainIdx for m in good]))]  # fmt: skip
        _, inliers = cv2.findFundamentalMat(*xy, cv2.FM_RANSAC, 1.0, 0.999)
        return 0 if inliers is None else int(inliers.sum())

    assert agreeing(described[0], described[1]) > 150
    assert agreeing(described[0], described[2]) < 25


@pytest.fixture(scope="module")
def rendered(route, town, tmp_path_factory):
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "build_town", lambda *_: town)
        return store.render_sequence(
            route, Variation(seed=3), cache, until=3, depth=True, threads=1
        )


def tree(root):
    return {p.relative_to(root): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_same_seed_same_bytes_on_any_number_of_threads(route, rendered, tmp_path):
    again = store.render_sequence(
        route, Variation(seed=3), tmp_path, until=3, depth=True, threads=2
    )
    assert tree(again) == tree(rendered)


@pytest.mark.slow
def test_views_are_the_left_images_of_the_drive(route, town, rendered, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "build_town", lambda *_: town)
    seen = []
    for _ in range(2):
        args = (route, Variation(seed=3), tmp_path, (0, 2))
        render_views(*args, threads=1, on_frame=lambda *at: seen.append(at))
        images = sorted(tmp_path.rglob("*.png"))
        assert [image.name for image in images] == ["000000.png", "000002.png"]
        for image in images:
            assert image.read_bytes() == (rendered / image.relative_to(tmp_path)).read_bytes()
        images[1].unlink()
    assert seen == [(1, 2), (2, 2), (2, 2)]
    for name in (f"poses/{route.name}.txt", f"sequences/{route.name}/times.txt"):
        assert (tmp_path / name).read_bytes() == (rendered / name).read_bytes()


def test_tree_is_kitti_with_depth(route, rendered):
    sequence = open_kitti(rendered, "street")
    assert len(sequence) == 3
    assert sequence.camera == route.camera
    np.testing.assert_allclose(sequence.ground_truth, route.ground_truth[:3], atol=1e-9)
    depth = cv2.imread(str(rendered / "sequences/street/depth_0/000001.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    foot = 1.65 * route.camera.fy / (route.camera.height - 1 - route.camera.cy)
    assert depth[-1, 620] / 100 == pytest.approx(foot, abs=0.05)


def test_rendering_resumes_after_a_kill(route, town, rendered, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "build_town", lambda *_: town)
    whole = tree(rendered)
    shutil.copytree(rendered, tmp_path / rendered.name)
    folder = tmp_path / rendered.name / "sequences/street"
    kept = folder / "image_0/000000.png"
    before = kept.stat().st_mtime_ns
    (folder / "image_1/000001.png").unlink()
    (folder / "image_0/.000002.png.99").write_bytes(b"cut sho")
    calls = []
    root = store.render_sequence(
        route, Variation(seed=3), tmp_path, until=3, depth=True,
        on_frame=lambda *done: calls.append(done),
    )  # fmt: skip
    (folder / "image_0/.000002.png.99").unlink()
    assert len(calls) == 1
    assert kept.stat().st_mtime_ns == before
    assert tree(root) == whole


def test_whole_sequence_has_a_manifest_and_is_not_rendered_twice(tmp_path, monkeypatch):
    small = route_of_poses(straight(24), "short")
    monkeypatch.setattr(store, "render_frames", fake := Renderings())
    root = store.render_sequence(small, Variation(), tmp_path)
    store.render_sequence(small, Variation(), tmp_path)
    assert fake.calls == 1
    (found,) = store.list_stored(tmp_path)
    assert (found.name, found.frames, found.complete, found.root) == ("short", 24, True, root)
    assert store.clean(tmp_path, "short") > 0
    assert not store.list_stored(tmp_path)


def test_damaged_frames_are_found_and_rendered_again(tmp_path, monkeypatch, caplog):
    small = route_of_poses(straight(24), "short")
    monkeypatch.setattr(store, "render_frames", fake := Renderings())
    root = store.render_sequence(small, Variation(), tmp_path)
    images = root / "sequences/short/image_0"
    (images / "000007.png").write_bytes(b"pn")  # a file of a different size
    store.render_sequence(small, Variation(), tmp_path)
    assert (fake.calls, fake.missing) == (2, [7])
    assert "rendering 1 damaged frame again: 7" in caplog.text
    (images / "000008.png").write_bytes(b"xxx")  # a file of the same size
    store.render_sequence(small, Variation(), tmp_path)
    assert fake.calls == 2
    store.render_sequence(small, Variation(), tmp_path, verify=True)
    assert (fake.calls, fake.missing) == (3, [8])
    store.render_sequence(small, Variation(), tmp_path, verify=True)
    assert fake.calls == 3


def test_another_calibration_is_another_sequence(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "render_frames", fake := Renderings())
    for calibration in ("00-02", "04-12", "04-12"):
        route = route_of_poses(straight(24), "short", calibration)
        store.render_sequence(route, Variation(), tmp_path)
    assert fake.calls == 2
    with pytest.raises(InputError, match="choose one of 00-02, 03, 04-12"):
        route_of_poses(straight(24), "short", "13")


def test_two_processes_do_not_render_one_sequence(tmp_path, monkeypatch, caplog):
    small = route_of_poses(straight(24), "short")
    monkeypatch.setattr(store, "render_frames", fake := Renderings())
    folder = tmp_path / store.folder_name(Variation()) / "sequences"
    folder.mkdir(parents=True)
    with ThreadPoolExecutor(2) as pool:
        with lock_of(folder / "short"):
            waiting = [
                pool.submit(store.render_sequence, small, Variation(), tmp_path) for _ in range(2)
            ]
            while len(caplog.records) < 2 and not any(each.done() for each in waiting):
                time.sleep(0.01)
            assert "another process is rendering it; waiting" in caplog.text
            assert fake.calls == 0
        assert [each.result(timeout=60) for each in waiting] == [folder.parent] * 2
    assert fake.calls == 1


def test_the_lock_of_a_killed_process_keeps_nobody_out(tmp_path, monkeypatch):
    small = route_of_poses(straight(24), "short")
    monkeypatch.setattr(store, "render_frames", fake := Renderings())
    folder = tmp_path / store.folder_name(Variation()) / "sequences"
    folder.mkdir(parents=True)
    (folder / ".short.lock").touch()
    store.render_sequence(small, Variation(), tmp_path)
    assert fake.calls == 1
    assert not list(folder.glob(".short*"))


class Renderings:
    """A replacement of the renderer that writes files without looking at the town."""

    calls = 0
    missing = None

    def __call__(self, route, variation, folder, missing, depth, *_, total):
        self.calls += 1
        self.missing = missing
        for k in missing:
            for side in ("image_0", "image_1"):
                (folder / side / f"{k:06d}.png").write_bytes(b"png")


def there_and_back(n=85):
    T = np.concatenate([straight(n), straight(n)])
    T[n:, 2, 3] = T[n - 1 :: -1, 2, 3]
    T[n:, 0, 3] -= 3.2
    T[n:, :3, :3] = turn(np.pi)
    return T


@pytest.mark.slow
def test_change_between_passes(unpainted):
    route = route_of_poses(there_and_back(), "twice")
    variation = Variation(change=1.0, moving=3)
    town = build_town(route, variation)
    passes = Passes(route, town, variation)
    first, last = passes.at(5), passes.at(len(route.T_wc) - 5)
    assert first.night < 0.05 < 0.8 < last.night
    assert first.light.sun @ last.light.sun < 0.9
    things = [set(m.surfaces.thing.tolist()) for m in (first, last)]
    assert len(things[0] - things[1]) > 10
    assert len(things[1] - things[0]) > 10


def test_sun_stands_still_within_a_pass_and_moves_behind_a_cloud(town):
    poses = there_and_back()
    drive = SimpleNamespace(T_wc=poses)
    passes = Passes(drive, town, Variation(change=0.6))
    starts = pass_starts(poses)
    assert len(starts) == 2
    lights = [passes._light(k, k >= starts[1])[0] for k in range(len(poses))]
    turned = [not np.array_equal(a.sun, b.sun) for a, b in pairwise(lights)]
    assert np.flatnonzero(turned).tolist() == [starts[1] - 1]
    assert lights[starts[1]].direct < 0.02
    assert lights[10].direct == pytest.approx(1.0)
    brightness = np.array([light.direct for light in lights])
    assert np.abs(np.diff(brightness)).max() < 0.12


def test_lamps_cast_pools():
    pools = lamp_pools(np.array([[0.0, 0.0], [30.0, 4.0]]))
    at = np.rint((np.array([[0, 0], [6, 0], [15, -15], [30, 4]]) - pools.frame[:2]) / 0.5)
    under, aside, away, other = pools.light[tuple(at.astype(int).T[::-1])]
    assert under == pytest.approx(other) == pytest.approx(1.0, abs=0.05)
    assert 0.1 < aside < 0.4
    assert away < 0.02


def rounds(n, radius=32.0, laps=1.6):
    angle = np.linspace(0, 2 * np.pi * laps, n)
    T = np.stack([turn(a) for a in angle])
    T = np.concatenate([T, np.zeros((n, 3, 1))], axis=2)
    T = np.concatenate([T, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (n, 1, 1))], axis=1)
    T[:, 0, 3], T[:, 2, 3] = -radius * np.cos(angle), radius * np.sin(angle)
    return T


@pytest.mark.slow
def test_an_interrupted_rendering_ends_its_threads(route, tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr(Renderer, "close", lambda renderer: closed.append(renderer))
    small = replace(route, camera=Camera(45.0, 45.0, 39.0, 12.0, 0.54, 78, 24))

    def interrupted(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.render_sequence(small, Variation(), tmp_path, until=2, on_frame=interrupted)
    with pytest.raises(KeyboardInterrupt):
        render_pairs(small, Variation(), tmp_path, 1, kinds=("shift",), on_frame=interrupted)
    assert len(closed) == 2


@pytest.mark.slow
def test_pairs_are_labelled(tmp_path):
    route = route_of_poses(rounds(160), "round")
    cheap = replace(route, camera=Camera(180.0, 180.0, 155.0, 47.0, 0.54, 310, 94))
    render_pairs(cheap, Variation(seed=1, change=0.6), tmp_path, 20)
    rows = list(csv.DictReader((tmp_path / "pairs.csv").open()))
    assert {row["kind"] for row in rows} == {"shift", "pass", "alike", "random"}
    orb = cv2.ORB_create(600)
    alike = {"1": [], "0": []}
    for row in rows:
        same = row["kind"] in ("shift", "pass")
        assert row["same"] == str(int(same))
        assert (float(row["distance_m"]) < 4.0) == same
        assert abs(float(row["lateral_m"])) <= 1.4
        assert abs(float(row["heading_deg"])) <= 14.0
        assert abs(float(row["height_m"])) <= 0.25
        images = [cv2.imread(str(tmp_path / row[side]), cv2.IMREAD_UNCHANGED) for side in "ab"]
        assert all(image.shape == (94, 310) and image.std() > 15 for image in images)
        ratio = images[1].mean() / images[0].mean()
        assert not same or 0.3 < ratio / float(row["exposure_ratio"]) < 3.0
        features = [orb.detectAndCompute(image, None)[1] for image in images]
        found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(*features, k=2)
        close = [m for m, n in (p for p in found if len(p) == 2) if m.distance < 0.8 * n.distance]
        alike[row["same"]].append(len(close))
    assert np.median(alike["1"]) > 1.5 * np.median(alike["0"])


@pytest.mark.parametrize("name", ROUTES)
def test_routes(name):
    route = built_in_route(name)
    xyz = route.T_wc[:, :3, 3]
    steps = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    assert steps.max() < 3.0
    up = route.terrain.height(xyz[:, [0, 2]])
    np.testing.assert_allclose(-xyz[:, 1] - up, CAMERA_HEIGHT, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(route.T_wc[:, :3, :3]), 1.0, atol=1e-12)
    assert revisits(xyz) >= {"demo": 1, "00": 4, "02": 2, "05": 3}.get(name, 0)
    if name == "00":
        assert len(route.T_wc) >= 1500


def revisits(xyz):
    """Return the parts of a drive that revisit a place.

    A part has at least 15 frames within 4 m of a place that was passed 150 frames before.
    """
    near = [
        i >= 150 and np.linalg.norm(xyz[: i - 149] - xyz[i], axis=1).min() < 4.0
        for i in range(len(xyz))
    ]
    edges = np.flatnonzero(np.diff(np.r_[0, near, 0]))
    return int((np.diff(edges)[::2] >= 15).sum())


def test_a_road_has_one_height_though_the_poses_disagree():
    T = np.concatenate([straight(), straight()])
    T = T[np.r_[0:64, 127:63:-1]]  # there and back
    T[64:, 1, 3] -= 1.2
    route = route_of_poses(T, "drift")
    np.testing.assert_allclose(route.T_wc[10, 1, 3], route.T_wc[117, 1, 3], atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda T: T[:10], "at least 20"),
        (lambda T: np.where(np.arange(len(T))[:, None, None] == 7, np.nan, T), "NaN"),
        (lambda T: T * [[[1, 1, 1, 8]]], "pose 1 is 8.0 m from the one before it"),
        (lambda T: T * [[[1, 1, 1, 0.1]]], "at least 20 m"),
    ],
)
def test_impossible_trajectories(spoil, part):
    with pytest.raises(InputError, match=part):
        route_of_poses(spoil(straight()), "mine")


def test_unknown_route():
    with pytest.raises(InputError, match="choose one of demo, 00"):
        open_sequence("synthetic", None, "77")


def test_disk_too_small_says_how_much_it_needs(route, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000_000))
    with pytest.raises(InputError, match=r"needs 0\.0\d? GB|needs 0\.\d GB"):
        store.render_sequence(route, Variation(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_unwritable_cache(route, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written.*VSLAM_CACHE"):
        store.render_sequence(route, Variation(), tmp_path / "file" / "cache")


def test_a_name_says_how_the_town_varies():
    assert parse_drive("05") == ("05", Variation())
    assert parse_drive("05+change:0.5+moving:6+aliased+seed:3") == (
        "05",
        Variation(3, aliased=True, change=0.5, moving=6),
    )
    assert parse_drive("night") == ("lane", Variation(1, change=1.0))
    assert parse_drive("night+seed:7+moving:2") == ("lane", Variation(7, change=1.0, moving=2))
    for name in ("05+fog", "05+change:2", "05+change", "05+moving:x", "05+seed:", "05+"):
        with pytest.raises(InputError, match=r"--seq 05\+.* is not understood"):
            parse_drive(name)
    with pytest.raises(InputError, match=r"route 77: unknown; choose one of .*, drone, night"):
        open_sequence("synthetic", None, "77+change:0.5")


@pytest.mark.slow
def test_a_drive_with_a_name_of_its_own_is_that_route_in_that_town(tmp_path, monkeypatch):
    monkeypatch.setenv("VSLAM_CACHE", str(tmp_path))
    words = ["synth", "night", "--max-frames", "1"]
    done = CliRunner().invoke(every_command(), words)
    assert done.exit_code == 0, done.output
    folder = tmp_path / "synthetic" / "v2-seed1-change1"
    assert done.stdout.startswith(f"{folder}: ")
    assert CliRunner().invoke(every_command(), [*words, "--quiet"]).output == ""
    assert [path.name for path in (folder / "sequences").iterdir()] == ["lane"]
    found = open_sequence("synthetic", None, "night", max_frames=1)
    assert (found.name, found.dataset, len(found)) == ("night", "synthetic", 1)


@pytest.mark.parametrize("pairs", [[], ["--pairs", "2"]])
@pytest.mark.parametrize(
    ("option", "why"), [("--lateral=0:20", "from -4 to 4"), ("--heading=x", "must be LOW:HIGH")]
)
def test_moves_beyond_the_road_are_refused_before_rendering(tmp_path, pairs, option, why):
    words = ["synth", "demo", *pairs, option, "--out", str(tmp_path / "out")]
    assert why in str(CliRunner().invoke(every_command(), words).exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not has_avx2(), reason="the kernels for AVX2 need a CPU with AVX2")
def test_a_route_is_the_same_on_cpus_with_and_without_avx512():
    """On a CPU with AVX-512, OpenBLAS would use kernels that round differently."""
    code = (
        "from vslam.support.machine import set_up_openblas; set_up_openblas();"
        "from vslam_lab.towns.routes import built_in_route;"
        "print(built_in_route('01').T_wc.tobytes().hex())"
    )
    given = {key: os.environ[key] for key in os.environ if key != "OPENBLAS_CORETYPE"}
    poses = [
        subprocess.run(
            [sys.executable, "-c", code], env=env, check=True, capture_output=True
        ).stdout
        for env in (given, given | {"OPENBLAS_CORETYPE": "Haswell"})
    ]
    assert poses[0] == poses[1]
