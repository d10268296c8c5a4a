"""Writes a small valid file of each kind that vslam reads. ``tools/fuzz.py`` damages these files.

Imports are inside the functions, so that the process that only supervises the readers does not load
the packages.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ring import Ring

    from vslam.slam import Slam


def _camera():
    from vslam.types.camera import Camera

    return Camera(60.0, 60.0, 31.5, 23.5, 0.2, 64, 48)


def noise(n: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    return [rng.integers(0, 256, (48, 64), dtype=np.uint8) for _ in range(n)]


def stereo() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return three images of a wall for each camera. Copies of one image would be refused."""
    return noise(), [np.roll(image, -4, axis=1) for image in noise()]


def images(folder: Path) -> None:
    from source_files import write_calibration, write_images

    names = [f"{k}.png" for k in range(3)]
    write_images(folder, dict(zip(("left", "right"), stereo(), strict=True)), names)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    write_calibration(folder / "stereo.yaml", _camera())


def other_images(folder: Path) -> None:
    """Write an image in each file format. The file names are timestamps."""
    import cv2
    from source_files import write_calibration

    for k, suffix in enumerate(("png", "jpg", "webp", "bmp", "tif", "pgm", "ppm")):
        colour = np.repeat(noise()[0][..., None], 3, axis=2)
        image = colour if suffix == "ppm" else colour[..., 0]
        assert cv2.imwrite(str(folder / f"{1_700_000_000 + k}.{suffix}"), image)
    write_calibration(folder.parent / "mono.yaml", _camera(), mono=True)


def kitti(folder: Path) -> None:
    import cv2

    from vslam.types.trajectory import write_kitti

    sequence = folder / "sequences" / "00"
    for side, images in zip(("image_0", "image_1"), stereo(), strict=True):
        (sequence / side).mkdir(parents=True)
        for k, image in enumerate(images):
            cv2.imwrite(str(sequence / side / f"{k:06d}.png"), image)
    c = _camera()
    rows = (
        f"P{k}: {c.fx} 0 {c.cx} {-c.bf * (k % 2)} 0 {c.fy} {c.cy} 0 0 0 1 0\n" for k in range(4)
    )
    (sequence / "calib.txt").write_text("".join(rows))
    (sequence / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (folder / "poses").mkdir()
    write_kitti(folder / "poses" / "00.txt", np.tile(np.eye(4), (3, 1, 1)))


def tum(folder: Path) -> None:
    import cv2
    from source_files import write_calibration

    for side, images in (("rgb", noise()), ("depth", [i.astype(np.uint16) for i in noise()])):
        (folder / side).mkdir()
        lines = ["# time file\n"]
        for k, image in enumerate(images):
            cv2.imwrite(str(folder / side / f"{k}.png"), image)
            lines.append(f"{100 + 0.1 * k:.2f} {side}/{k}.png\n")
        (folder / f"{side}.txt").write_text("".join(lines))
    (folder / "groundtruth.txt").write_text(
        "".join(f"{99.9 + 0.1 * k:.2f} {k} 0 0 0 0 0 1\n" for k in range(6))
    )
    write_calibration(folder / "calibration.yaml", _camera(), mono=True)


def euroc(folder: Path) -> None:
    import cv2

    for side, images in enumerate(stereo()):
        camera = folder / "mav0" / f"cam{side}"
        (camera / "data").mkdir(parents=True)
        lines = ["#timestamp [ns],filename\n"]
        for k, image in enumerate(images):
            stamp = 1_403_636_579_763_555_584 + 50_000_000 * k
            cv2.imwrite(str(camera / "data" / f"{stamp}.png"), image)
            lines.append(f"{stamp},{stamp}.png\n")
        (camera / "data.csv").write_text("".join(lines))
        (camera / "sensor.yaml").write_text(_EUROC.format(shift=0.1 * side))
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = (
        f"{1_403_636_579_663_555_584 + 50_000_000 * k},{k},0,0,1,0,0,0,0,0,0,0,0,0,0,0,0\n"
        for k in range(9)
    )
    (truth / "data.csv").write_text("#timestamp,p\n" + "".join(rows))
    (truth / "sensor.yaml").write_text("T_BS:\n  data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n")


_EUROC = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, {shift}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60, 60, 31.5, 23.5]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""
CALIBRATIONS = {
    "own.yaml": "left: {size: [64, 48], focal: [60, 60], centre: [31.5, 23.5], lens: fisheye, "
    "distortion: [0.01, 0, 0, 0]}\nright: {size: [64, 48], focal: [60, 60], centre: [31.5, 23.5]}"
    "\nT_left_right: [1,0,0,0.2, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [60, 60, 31.5, 23.5]\n"
    "  distortion_model: equidistant\n  distortion_coeffs: [0.01, 0, 0, 0]\n"
    "  resolution: [64, 48]\ncam1:\n  camera_model: pinhole\n  intrinsics: [60, 60, 31.5, 23.5]\n"
    "  distortion_model: radtan\n  distortion_coeffs: [0.01, 0, 0, 0]\n  resolution: [64, 48]\n"
    "  T_cn_cnm1:\n  - [1, 0, 0, -0.2]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n",
    "euroc.yaml": _EUROC.format(shift=0.0),
    "ros.yaml": "image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    "  data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
    "distortion_coefficients:\n  data: [0.1, 0, 0, 0, 0]\nrectification_matrix:\n"
    "  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nprojection_matrix:\n"
    "  data: [60, 0, 31.5, 0, 0, 60, 23.5, 0, 0, 0, 1, 0]\n",
    "opencv.yml": "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 60., 0., 31.5, 0., 60., 23.5, 0., 0., 1. ]\nD1: !!opencv-matrix\n   data: [0.1, 0,"
    " 0, 0, 0]\nM2: !!opencv-matrix\n   data: [ 60., 0., 31.5, 0., 60., 23.5, 0., 0., 1. ]\n"
    "D2: !!opencv-matrix\n   data: [0, 0, 0, 0, 0]\nR: !!opencv-matrix\n"
    "   data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: !!opencv-matrix\n   data: [-0.2, 0, 0]\n",
    "orbslam2.yaml": "%YAML:1.0\nCamera.fx: 60\nCamera.fy: 60\nCamera.cx: 31.5\nCamera.cy: 23.5\n"
    "Camera.k1: 0.1\nCamera.k2: 0\nCamera.p1: 0\nCamera.p2: 0\nCamera.width: 64\n"
    "Camera.height: 48\nCamera.bf: 12\n",
}


def calibrations(folder: Path) -> None:
    for name, text in CALIBRATIONS.items():
        (folder / name).write_text(text)


def bag(kind: str, encoding: str, folder: Path, compression: str = "") -> None:
    from source_files import LEFT, RIGHT, write_bag

    sides = dict(zip((LEFT, RIGHT), stereo(), strict=True))
    name = {"ros1": "a.bag"}.get(kind, "a")
    write_bag(folder / name, kind, sides, [10**8 * (k + 1) for k in range(3)], encoding=encoding,
              camera=_camera(), compression=compression)  # fmt: skip


def foxglove(encoding: str, folder: Path) -> None:
    from foxglove_files import Recorder, calibration, compressed, raw
    from mcap.writer import CompressionType

    # Otherwise, a checksum would reject every change.
    plain = {"compression": CompressionType.NONE, "enable_crcs": False}
    with Recorder(folder / "a.mcap", encoding, **plain) as recorder:
        for k, pixels in enumerate(noise()[:3]):
            for side, (kind, packed) in enumerate({"Raw": raw, "Compressed": compressed}.items()):
                info = calibration(_camera(), side)
                stamp = 10**8 * (k + 1)
                recorder.send(f"/{side}/info", "CameraCalibration", stamp, frame_id="", **info)
                recorder.send(f"/{side}/a", f"{kind}Image", stamp, frame_id="", **packed(pixels))


def video(folder: Path) -> None:
    from source_files import write_calibration, write_video

    write_video(folder / "a.mkv", noise(8))
    write_video(folder / "b.avi", [np.tile(i, (1, 2)) for i in noise(8)], codec="MJPG")
    write_calibration(folder.parent / "mono.yaml", _camera(), mono=True)
    wide = replace(_camera(), width=2 * _camera().width)
    write_calibration(folder.parent / "wide.yaml", wide, mono=True)


def map_file(folder: Path) -> None:
    from vslam.maps.storage import save_map
    from vslam.maps.stored_map import StoredMap
    from vslam.types.features import (
        PATCH_PIXELS,
        Extracted,
        Features,
        FramePatches,
        KeyframePatches,
    )
    from vslam.types.frame_poses import FrameTable
    from vslam.types.loops import LoopEdge, ResembledPlace
    from vslam.types.map import Map
    from vslam.types.map_kernels import fuse_landmarks, link_many, refresh_landmarks
    from vslam.types.states import (
        Checkpoint,
        ClosingState,
        ConsistencyState,
        FrameObservations,
        MotionState,
        PolicyState,
        PublishedState,
    )
    from vslam.types.track import Track

    rng = np.random.default_rng(3)
    map_ = Map(1.2 ** np.arange(8))
    n = 12
    for k in range(3):
        features = Features(
            rng.uniform(0, 48, (n, 2)).astype(np.float32),
            rng.integers(0, 8, n).astype(np.uint8),
            rng.uniform(0, 6, n).astype(np.float32),
            rng.integers(0, 256, (n, 32)).astype(np.uint8),
            np.full(n, np.nan, np.float32),
        )
        map_.add_keyframe(features, np.eye(4), 0.1 * k, k)
        map_.parents[k] = k - 1
    descriptors = rng.integers(0, 2**63, (n, 4)).astype(np.uint64)
    ids = map_.add_landmarks(rng.uniform(1, 9, (n, 3)), descriptors, 0)
    for k in range(3):
        rows = np.arange(n * k, n * (k + 1))
        link_many(map_.arrays, rows, ids.astype(np.int32))
    refresh_landmarks(map_.arrays, ids, map_.scales)
    fuse_landmarks(map_.arrays, 0, 1)
    map_.cull_keyframe(1)
    waits = LoopEdge(2, 0, 0.5, True, "", T_query_match=np.eye(4))
    patches = KeyframePatches(
        2, np.zeros((n, PATCH_PIXELS), np.uint8), np.zeros((n, 2), np.float32), features.xy
    )
    known_place = FramePatches(
        2,
        ids[2:].astype(np.int32),
        features.octave[2:],
        features.angle[2:],
        patches.pixels[2:],
        patches.shift[2:],
    )
    recent = FrameObservations(
        1,
        2,
        0,
        np.eye(4),
        1.0,
        ids[2:].astype(np.int32),
        features.xy[2:],
        np.ones(n - 2, np.float32),
    )
    last = Track(2, 0.2, np.eye(4), twist=np.zeros(6)).with_features(Extracted(features))
    last = last.matching(np.arange(n), ids.astype(np.int32), map_.arrays.xyz[ids])
    checkpoint = Checkpoint(
        last,
        MotionState(),
        PublishedState(2, 2, 0.2, (patches,), known_place, (recent,)),
        PolicyState(100.0, False),
        ClosingState(ConsistencyState((ResembledPlace(frozenset((0,)), 1),), ((3, waits),), 3)),
    )
    frames = FrameTable(
        0.1 * np.arange(3), np.array([0, 2, 2]), np.tile(np.eye(4), (3, 1, 1)), np.ones(3, bool),
        np.ones(3), np.zeros(3, bool),
    )  # fmt: skip
    stored = StoredMap(map_, _camera(), frames=frames, checkpoint=checkpoint)
    save_map(folder / "map.npz", stored, resumable=True)


def _drive(places: range, seed: int) -> Slam:
    """Make a ``Slam`` that has mapped these places of a ring of points."""
    from ring import CAMERA

    from vslam.slam import Slam

    slam = Slam(CAMERA, None, "bow", threads=1)
    drive_on(slam, places, seed, 0.0)
    slam.finish()
    return slam


def drive_on(slam: Slam, places: range, seed: int, start: float) -> None:
    from vslam.types.features import Extracted, Features

    camera = slam.context.camera  # the camera of the map may differ
    for i, place in enumerate(places):
        seen = _ring().see(place, seed)
        inside = (seen.xy < (camera.width, camera.height)).all(1)
        seen = Features(**{name: column[inside] for name, column in vars(seen).items()})
        slam.step_features(Extracted(seen), start + 0.1 * i)


@cache
def _ring() -> Ring:
    from ring import Ring

    return Ring.create()


def drives(folder: Path) -> None:
    """Write a map with a checkpoint, a loop and a GPS position, and a map that overlaps with it."""
    from vslam.maps.storage import save_map
    from vslam.maps.stored_map import TruthAlignment
    from vslam.types.loops import LoopEdge

    stored = _drive(range(24), 0).stored_map("ring 0")
    n = stored.map.n_keyframes
    loop = LoopEdge(n - 1, 0, 0.5, True, "closed", 40, 30, np.eye(4))
    stored = replace(stored, loops=(loop,), truth_alignment=TruthAlignment("ring", np.eye(4)))
    save_map(folder / "map.npz", stored, resumable=True)
    save_map(folder / "other.npz", _drive(range(18, 40), 1).stored_map("ring 1"))


def config_or_report(kind: str, folder: Path) -> None:
    from vslam.config import Config

    if kind == "config":
        (folder / "config.json").write_text(Config().model_dump_json())
        return
    from test_report import make_outcome, report_of

    report_of(make_outcome(20), folder)


def vocabulary(folder: Path) -> None:
    from vslam.loopclosure.vocabulary import from_children
    from vslam.loopclosure.vocabulary_text import write_vocabulary

    rng = np.random.default_rng(1)
    descriptors = rng.integers(0, 2**63, (13, 4)).astype(np.uint64)
    descriptors[0] = 0
    children = np.array([3, 3, 3, 3] + [0] * 9, np.uint8)
    made = from_children(3, 2, descriptors, children, rng.uniform(0.1, 1, 9).astype(np.float32))
    for name in ("words.npz", "words.txt"):
        write_vocabulary(made, folder / name)


def trajectories(folder: Path) -> None:
    from vslam.types.trajectory import Trajectory, write_euroc, write_kitti, write_tum

    T_wc = np.tile(np.eye(4), (5, 1, 1))
    write_kitti(folder / "a.kitti", T_wc)
    write_tum(folder / "a.tum", Trajectory(0.1 * np.arange(5), T_wc))
    write_euroc(folder / "a.csv", Trajectory(0.1 * np.arange(5), T_wc))


def onnx(folder: Path) -> None:
    from vslam.loopclosure.siamese.weights import SHIPPED

    shutil.copy(SHIPPED / "capsule-pruned.onnx", folder / "net.onnx")


def weights(folder: Path) -> None:
    from vslam.loopclosure.siamese.weights import SHIPPED

    shutil.copy(SHIPPED / "capsule-pruned.safetensors", folder / "net.safetensors")
