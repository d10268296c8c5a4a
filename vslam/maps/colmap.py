"""Writes maps in COLMAP's format, as text or binary (https://colmap.github.io/format.html).

COLMAP's poses are ``T_cw`` with x right, y down and z forward, as in vslam. COLMAP's pixel
coordinates begin at the corner of the image, so the centre of the upper left pixel is (0.5, 0.5).
In vslam, this centre is (0, 0). The optional files of rigs and frames are not written, so COLMAP
treats every image as a separate frame.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.maps.reconstruction import PIXEL_CENTRE, Reconstruction
from vslam.types.camera import Camera
from vslam.types.trajectory import quaternions

_CAMERA_ID = 1
_PINHOLE = 1  # number of this model in COLMAP's camera_models
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK = np.dtype([("image", "<u4"), ("point2d", "<u4")])


class _Image(NamedTuple):
    """An image of COLMAP's sparse model.

    ``pose`` is ``(7,)`` qw qx qy qz tx ty tz of ``T_cw``. ``points`` are the keypoints, of type
    ``_POINT2D``.
    """

    id: int
    pose: NDArray[np.float64]
    name: str
    points: NDArray[np.void]


class _Point(NamedTuple):
    """A 3D point of COLMAP's sparse model.

    ``error`` is the mean reprojection error in pixels. ``track`` lists the observations, of type
    ``_TRACK``.
    """

    id: int
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: float
    track: NDArray[np.void]


def save_colmap(
    folder: Path | str,
    reconstruction: Reconstruction,
    names: list[str],
    colours: NDArray[np.uint8],
    *,
    text: bool = False,
) -> None:
    """Write a map as a sparse model in COLMAP's format: ``cameras.bin``, ``images.bin`` and
    ``points3D.bin``, or the same with ``.txt`` if ``text`` is True. Only keypoints that observe a
    landmark are written.

    Args:
        folder: an existing folder, usually ``sparse/0`` of a COLMAP project.
        names: file name of the image of each keyframe.
        colours: ``(L, 3)`` RGB colours of the landmarks.

    Raises:
        OSError: a file cannot be written.
    """
    write = _write_text if text else _write_binary
    images = list(_images(reconstruction, names))
    write(Path(folder), reconstruction.camera, images, list(_points(reconstruction, colours)))


def _images(reconstruction: Reconstruction, names: list[str]) -> Iterator[_Image]:
    r = reconstruction
    xyzw = quaternions(r.T_cw[:, :3, :3])
    poses = np.column_stack([xyzw[:, 3], xyzw[:, :3], r.T_cw[:, :3, 3]])
    points = np.empty(len(r.xy), _POINT2D)
    points["xy"], points["point"] = r.xy + PIXEL_CENTRE, r.landmark + 1
    for keyframe, (pose, name) in enumerate(zip(poses, names, strict=True)):
        yield _Image(keyframe + 1, pose, name, points[r.observations_of(keyframe)])


def _points(reconstruction: Reconstruction, colours: NDArray[np.uint8]) -> Iterator[_Point]:
    r = reconstruction
    track = np.empty(len(r.xy), _TRACK)
    track["image"] = r.keyframe + 1
    track["point2d"] = np.arange(len(r.xy)) - np.searchsorted(r.keyframe, r.keyframe)
    order = np.argsort(r.landmark, kind="stable")
    counts = np.bincount(r.landmark, minlength=len(r.xyz))
    errors = np.bincount(r.landmark, r.reprojection_errors(), len(r.xyz)) / counts
    tracks = np.split(track[order], np.cumsum(counts)[:-1])
    for k, error in enumerate(errors.tolist()):
        yield _Point(k + 1, r.xyz[k], colours[k], error, tracks[k])


def _parameters(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE


def _write_binary(folder: Path, camera: Camera, images: list[_Image], points: list[_Point]) -> None:
    """Write COLMAP's files in little-endian order, as in COLMAP's
    ``reconstruction_io_binary.cc``."""
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QIi2Q", 1, _CAMERA_ID, _PINHOLE, camera.width, camera.height)
        + struct.pack("<4d", *_parameters(camera))
    )
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for image in images:
            file.write(struct.pack("<I7dI", image.id, *image.pose, _CAMERA_ID))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", len(image.points)))
            file.write(image.points.tobytes())
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(points)))
        for point in points:
            file.write(struct.pack("<Q3d3B", point.id, *point.xyz, *point.rgb))
            file.write(struct.pack("<dQ", point.error, len(point.track)) + point.track.tobytes())


def _write_text(folder: Path, camera: Camera, images: list[_Image], points: list[_Point]) -> None:
    with (folder / "cameras.txt").open("w") as file:
        file.write("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]: fx fy cx cy\n")
        file.write(f"{_CAMERA_ID} PINHOLE {camera.width} {camera.height} ")
        file.write(f"{_words(_parameters(camera))}\n")
    with (folder / "images.txt").open("w") as file:
        file.write("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n")
        file.write("# POINTS2D[] as (X, Y, POINT3D_ID)\n")
        for image in images:
            file.write(f"{image.id} {_words(image.pose.tolist())} {_CAMERA_ID} {image.name}\n")
            seen = zip(image.points["xy"].tolist(), image.points["point"].tolist(), strict=True)
            file.write(" ".join(f"{_words(xy)} {point}" for xy, point in seen) + "\n")
    with (folder / "points3D.txt").open("w") as file:
        file.write("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
        for point in points:
            values = (*point.xyz.tolist(), *point.rgb.tolist(), point.error)
            track = " ".join(f"{image} {index}" for image, index in point.track.tolist())
            file.write(f"{point.id} {_words(values)} {track}\n")


def _words(values: tuple[float, ...] | list[float]) -> str:
    """Format numbers with enough digits to be read back exactly, separated by spaces."""
    return " ".join(map(repr, values))
