"""Fixtures that several test files use."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.cli import main as cli
from vslam.datasets.kitti import open_kitti
from vslam.run.warmup import compile_kernels
from vslam.types.camera import Camera
from vslam.types.geometry import se3_exp
from vslam.types.map import Map
from vslam.types.trajectory import write_kitti
from vslam_lab.towns.routes import built_in_route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import render_sequence


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels before several workers start, each of which would compile them."""
    if config.getoption("numprocesses", None):
        compile_kernels()


METRES_PER_TEXEL = 0.02
PLANES = (  # normal . X = offset in metres, in the world frame (x right, y down, z forward)
    (np.array([0.0, 1.0, 0.0]), 1.5),  # ground
    (np.array([1.0, 0.0, 0.0]), -4.0),  # left wall
    (np.array([1.0, 0.0, 0.0]), 4.5),  # right wall
    (np.array([0.0, 0.0, 1.0]), 32.0),  # end wall
)
AXES = ((0, 2), (2, 1), (2, 1), (0, 1))  # world axes along each plane's texture
CEILING = -6.0  # the walls end at this y; above them is the sky


@dataclass(frozen=True)
class StereoSequence:
    """The ``left`` and ``right`` images, the ``timestamps`` and the true ``T_wc`` of N frames."""

    camera: Camera
    left: list[np.ndarray]
    right: list[np.ndarray]
    timestamps: np.ndarray
    T_wc: np.ndarray

    def __len__(self) -> int:
        return len(self.left)


def corridor_mipmaps(seed: int = 7) -> list[np.ndarray]:
    """Mipmaps of a texture of square blocks with random grey values and several sizes."""
    rng = np.random.default_rng(seed)
    side = 2048
    texture = np.full((side, side), 128.0, np.float32)
    for block, contrast in ((4, 18.0), (16, 30.0), (64, 30.0)):
        grey = rng.uniform(-contrast, contrast, (side // block, side // block))
        texture += np.kron(grey, np.ones((block, block))).astype(np.float32)
    levels = [np.clip(cv2.GaussianBlur(texture, (0, 0), 0.7), 0, 255)]
    while len(levels) < 7:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels


def render(mipmaps: list[np.ndarray], camera: Camera, T_wc: np.ndarray) -> np.ndarray:
    """Render the corridor for a pinhole camera at ``T_wc``, by ray casting without aliasing."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1
    )
    rays, centre = rays @ T_wc[:3, :3].T, T_wc[:3, 3]
    depth = np.full(u.shape, np.inf)
    s, t = np.zeros(u.shape), np.zeros(u.shape)
    footprint = np.ones(u.shape)
    for plane, ((normal, offset), (i, j)) in enumerate(zip(PLANES, AXES, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (offset - normal @ centre) / (rays @ normal)
        hit = centre + along[..., None] * rays
        texel_s, texel_t = hit[..., i] / METRES_PER_TEXEL, hit[..., j] / METRES_PER_TEXEL
        size = np.maximum(
            np.hypot(*np.gradient(texel_s)),
            np.hypot(*np.gradient(texel_t)),
        )
        nearer = (along > 0.05) & (along < depth) & (hit[..., 1] > CEILING)
        depth[nearer] = along[nearer]
        s[nearer] = texel_s[nearer] + 517 * plane
        t[nearer] = texel_t[nearer] + 923 * plane
        footprint[nearer] = size[nearer]
    level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0, len(mipmaps) - 1.001)
    image = np.zeros(u.shape)
    for k, texture in enumerate(mipmaps):
        weight = np.maximum(0.0, 1.0 - np.abs(level - k))
        if not weight.any():
            continue
        scale = 0.5**k
        side = len(texture)
        seen = cv2.remap(
            texture,
            (((s + 0.5) * scale - 0.5) % side).astype(np.float32),
            (((t + 0.5) * scale - 0.5) % side).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )
        image += weight * seen
    image[~np.isfinite(depth)] = 200.0
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def corridor() -> StereoSequence:
    """28 stereo frames at 10 Hz along a textured corridor.

    The camera moves by 0.35 m per frame and turns slightly.
    """
    camera = Camera(240.0, 240.0, 239.5, 79.5, 0.5, 480, 160)
    mipmaps = corridor_mipmaps()
    frames = 28
    T_wc = [np.eye(4)]
    for k in range(1, frames):
        yaw = 0.012 if 8 <= k < 20 else 0.0  # rad per frame
        T_wc.append(T_wc[-1] @ se3_exp(np.array([0.0, 0.0, 0.35, 0.0, yaw, 0.0])))
    poses = np.array(T_wc)
    T_left_right = np.eye(4)
    T_left_right[0, 3] = camera.baseline
    left = [render(mipmaps, camera, T) for T in poses]
    right = [render(mipmaps, camera, T @ T_left_right) for T in poses]
    return StereoSequence(camera, left, right, 100.0 + 0.1 * np.arange(frames), poses)


@pytest.fixture(scope="session")
def round_the_block(tmp_path_factory):
    """Every second frame of a drive round a block from noon to midnight, at half resolution."""
    route = built_in_route("block")
    camera = route.camera
    camera = replace(
        camera,
        fx=camera.fx / 2,
        fy=camera.fy / 2,
        cx=(camera.cx - 0.5) / 2,
        cy=(camera.cy - 0.5) / 2,
        width=camera.width // 2,
        height=camera.height // 2,
    )
    smaller = replace(route, camera=camera, T_wc=route.T_wc[::2])
    cache = tmp_path_factory.mktemp("night")
    return open_kitti(render_sequence(smaller, Variation(seed=3, change=1.0), cache), "block")


@pytest.fixture(scope="session")
def kitti_tree(corridor: StereoSequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The corridor as KITTI odometry sequence 00 with ground truth. Tests must not change it."""
    root = tmp_path_factory.mktemp("kitti")
    folder = root / "sequences" / "00"
    for side, images in (("image_0", corridor.left), ("image_1", corridor.right)):
        (folder / side).mkdir(parents=True)
        for k, image in enumerate(images):
            assert cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    c = corridor.camera
    lines = []
    for side in range(4):
        shift = -c.bf if side % 2 else 0.0
        numbers = [c.fx, 0, c.cx, shift, 0, c.fy, c.cy, 0, 0, 0, 1, 0]
        lines.append(f"P{side}: " + " ".join(f"{x:.12e}" for x in numbers) + "\n")
    (folder / "calib.txt").write_text("".join(lines))
    times = corridor.timestamps - corridor.timestamps[0]
    (folder / "times.txt").write_text("".join(f"{t:.6e}\n" for t in times))
    (root / "poses").mkdir()
    write_kitti(root / "poses" / "00.txt", corridor.T_wc)
    return root


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of a run with 150 frames, brightness:1, detector none and seed 3."""
    from test_report import make_outcome, report_of

    folder = tmp_path_factory.mktemp("run")
    report_of(make_outcome(150, lost=slice(20, 22)), folder)
    return folder


@pytest.fixture
def stub(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder whose files control tests/stub_runner.py."""
    folder = tmp_path / "stub"
    folder.mkdir()
    for name in ("report.json", "trajectory.tum", "ground_truth_kitti.txt"):
        (folder / name).write_bytes((run_folder / name).read_bytes())
    monkeypatch.setenv("STUB_FOLDER", str(folder))
    return folder


@pytest.fixture(scope="session")
def check_map() -> Callable[[Map], None]:
    """A function that asserts every invariant of a map in plain Python."""
    return _check_map


def _check_map(map_: Map) -> None:
    a = map_.arrays
    landmark = a.landmark[: map_.n_rows].tolist()
    following = a.next_row[: map_.n_rows].tolist()
    keyframe = a.keyframe[: map_.n_rows].tolist()
    stereo = np.isfinite(a.u_right[: map_.n_rows]).tolist()
    alive = a.landmark_alive[: map_.n_landmarks].tolist()
    rows_of: dict[int, list[int]] = {}
    for row, observed in enumerate(landmark):
        if observed >= 0:
            rows_of.setdefault(observed, []).append(row)
            assert a.keyframe_alive[keyframe[row]], f"row {row} of a culled keyframe observes"
        else:
            assert observed == -1
            assert following[row] == -1, f"free row {row} hangs in a chain"
    for k in range(map_.n_keyframes):
        rows = map_.rows(k)
        assert set(keyframe[rows]) <= {k}
        seen = [x for x in landmark[rows] if x >= 0]
        assert len(seen) == len(set(seen)), f"keyframe {k} observes a landmark twice"
    for i in range(map_.n_landmarks):
        chain = []
        row = int(a.head[i])
        while row >= 0:
            assert len(chain) <= map_.n_keyframes, f"chain of landmark {i} has a cycle"
            chain.append(row)
            row = following[row]
        assert sorted(chain) == rows_of.get(i, []), f"chain of landmark {i}"
        assert a.n_observations[i] == sum(2 if stereo[r] else 1 for r in chain), f"landmark {i}"
        if not alive[i]:
            assert not chain, f"culled landmark {i} is observed"
        if a.fused_into[i] >= 0:
            assert not alive[i]
            assert a.fused_into[i] != i


def corridor_depth(camera: Camera, T_wc: np.ndarray) -> np.ndarray:
    """``(H, W)`` depth of the corridor along the camera's z axis in metres; 0 in the sky."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1
    )
    rays, centre = rays @ T_wc[:3, :3].T, T_wc[:3, 3]
    depth = np.full(u.shape, np.inf)
    for normal, offset in PLANES:
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (offset - normal @ centre) / (rays @ normal)
        hit = centre + along[..., None] * rays
        nearer = (along > 0.05) & (along < depth) & (hit[..., 1] > CEILING)
        depth[nearer] = along[nearer]
    return np.where(np.isfinite(depth), depth, 0.0)


@pytest.fixture
def call(monkeypatch, capsys, tmp_path):
    """A function that runs ``vslam`` with the given words in an empty folder.

    It returns the exit code, stdout and stderr.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("KITTI_ROOT", raising=False)

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vslam", *map(str, words)])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        output = capsys.readouterr()
        return code, output.out, output.err

    return run
