"""Writes maps in the formats of other programs: nerfstudio, g2o, PLY and PNG."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.maps.level import T_UPRIGHT_CAMERA
from vslam.maps.reconstruction import PIXEL_CENTRE, Reconstruction
from vslam.types.geometry import transform
from vslam.types.trajectory import quaternions

POINTS = "sparse_pc.ply"
T_CAMERA_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LUMA = np.array([299, 587, 114])  # weights of ITU-R BT.601, in thousandths


def save_nerfstudio(
    folder: Path | str,
    reconstruction: Reconstruction,
    names: list[str],
    colours: NDArray[np.uint8],
    T_saved_world: NDArray[np.float64] = T_UPRIGHT_CAMERA,
) -> None:
    """Write a data set for nerfstudio: ``transforms.json``, and the landmarks as ``sparse_pc.ply``
    (https://docs.nerf.studio/quickstart/data_conventions.html).

    Cameras look along -z with y up (OpenGL). ``transform_matrix`` is the pose of a camera (camera
    to world). The z axis of the world frame points up if the first camera was level.
    ``applied_transform`` is the transformation from vslam's world frame to that of both files.

    Pixel coordinates begin at the corner of the image, as in COLMAP. The rays of nerfstudio go
    through ``column + 0.5`` (``Cameras.get_image_coords``), although its documentation suggests
    that the centre of the first pixel is (0, 0).

    Args:
        folder: an existing folder.
        names: path of the image of each keyframe, relative to the folder.
        colours: ``(L, 3)`` RGB colours of the landmarks.
        T_saved_world: ``(4, 4)``, maps points of vslam's world frame to that of the files.

    Raises:
        OSError: a file cannot be written.
    """
    camera = reconstruction.camera
    poses = T_saved_world @ reconstruction.T_wc @ T_CAMERA_OPENGL
    content = {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + PIXEL_CENTRE,
        "cy": camera.cy + PIXEL_CENTRE,
        "w": camera.width,
        "h": camera.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "applied_transform": T_saved_world[:3].tolist(),
        "ply_file_path": POINTS,
        "frames": [
            {"file_path": name, "transform_matrix": pose.tolist()}
            for name, pose in zip(names, poses, strict=True)
        ],
    }
    folder = Path(folder)
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n")
    save_ply(folder / POINTS, transform(T_saved_world, reconstruction.xyz), colours)


def save_g2o(
    path: Path | str,
    ids: NDArray[np.int64],
    T_wc: NDArray[np.float64],
    edges: NDArray[np.int64],
    T_i_j: NDArray[np.float64],
    sigmas: NDArray[np.float64],
) -> None:
    """Write a pose graph in g2o's text format
    (https://github.com/RainerKuemmerle/g2o/wiki/File-Format).

    Lines with ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT`` contain x y z qx qy qz qw. An edge also has
    the upper triangle of its information matrix, row by row, with the translation first.

    The information of rotations is per square radian, as GTSAM, SE-Sync and the examples of Ceres
    expect. g2o itself uses qx qy qz as the error of a rotation, which is half the angle for small
    angles. Therefore, rotations have only a quarter of their weight in g2o.

    Args:
        ids: ``(N,)`` ids of the vertices.
        T_wc: ``(N, 4, 4)`` poses of the vertices.
        edges: ``(E, 2)`` indices of the two vertices i and j of each edge, in ``ids``.
        T_i_j: ``(E, 4, 4)`` measured pose of j in the frame of i.
        sigmas: ``(E, 6)`` standard deviations of the translation (m) and of the rotation (rad), for
            each axis.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [
        f"VERTEX_SE3:QUAT {vertex} {_words(values)}\n"
        for vertex, values in zip(ids.tolist(), _poses(T_wc).tolist(), strict=True)
    ]
    information = 1.0 / sigmas**2
    upper = np.triu_indices(6)
    for ends, values, diagonal in zip(
        ids[edges].tolist(), _poses(T_i_j).tolist(), information, strict=True
    ):
        triangle = np.diag(diagonal)[upper].tolist()
        lines.append(f"EDGE_SE3:QUAT {ends[0]} {ends[1]} {_words(values)} {_words(triangle)}\n")
    Path(path).write_text("".join(lines))


def _poses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert poses to an ``(N, 7)`` array of x y z qx qy qz qw, with qw >= 0."""
    return np.column_stack([T[:, :3, 3], quaternions(T[:, :3, :3])])


def _words(values: list[float]) -> str:
    return " ".join(f"{value:.15g}" for value in values)


def save_ply(
    path: Path | str, xyz: NDArray[np.float64], colours: NDArray[np.uint8] | None = None
) -> None:
    """Write points as binary PLY.

    Args:
        xyz: ``(N, 3)`` points in the world frame, in metres.
        colours: ``(N, 3)`` uint8 RGB colours of the points. None writes no colours.
    """
    fields = [("xyz", "<f4", 3)]
    properties = [f"property float {axis}\n" for axis in "xyz"]
    if colours is not None:
        fields.append(("rgb", "u1", 3))
        properties += [f"property uchar {channel}\n" for channel in ("red", "green", "blue")]
    vertices = np.empty(len(xyz), fields)
    vertices["xyz"] = xyz
    if colours is not None:
        vertices["rgb"] = colours
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(xyz)}\n{''.join(properties)}end_header\n"
    )
    with Path(path).open("wb") as file:
        file.write(header.encode())
        file.write(vertices.tobytes())


def save_image(image: NDArray[np.uint8], path: Path) -> None:
    """Write an ``(H, W)`` grey or ``(H, W, 3)`` RGB image as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    import cv2

    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8)
    _, encoded = cv2.imencode(".png", image)
    path.write_bytes(encoded.tobytes())


def landmark_colours(
    reconstruction: Reconstruction, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """Return the RGB colour of each landmark as ``(L, 3)`` uint8, taken from its observation with
    the median brightness.

    Args:
        images: ``(H, W)`` grey or ``(H, W, 3)`` RGB image of each keyframe, in order.
    """
    r = reconstruction
    colours = np.empty((len(r.xy), 3), np.uint8)
    for keyframe, image in zip(range(len(r.frames)), images, strict=True):
        seen = r.observations_of(keyframe)
        x, y = np.rint(r.xy[seen]).astype(np.int64).T
        pixels = image[y.clip(0, image.shape[0] - 1), x.clip(0, image.shape[1] - 1)]
        colours[seen] = pixels.reshape(len(pixels), -1)
    order = np.lexsort((colours @ _LUMA, r.landmark))
    counts = np.bincount(r.landmark, minlength=len(r.xyz))
    # The lower median is a colour that was observed, not the mean of two colours.
    middle = order[np.cumsum(counts) - counts + (counts - 1) // 2]
    return colours[middle]
