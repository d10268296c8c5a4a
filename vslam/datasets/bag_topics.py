"""Chooses the image topics of a bag, and finds the ``camera_info`` of each of them.

Topics are chosen by the content of their messages. Their names decide only where the content does
not.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.bag_files import Recording, first_message, messages
from vslam.datasets.bag_messages import (
    CAMERA_INFO_TYPES,
    IMAGE_TYPES,
    NUMBER_TYPE,
    TRANSFORM_TYPE,
    Message,
    depth_in,
)
from vslam.support.errors import BrokenSourceError, InputError

_NEEDED = {
    "mono": "an image topic",
    "stereo": "two image topics",
    "rgbd": "an image topic and one of depth",
}
_MOST_EMPTY = 30  # depth images without any depth with which a recording may begin
# Registered depth has the camera matrix of the images, or that of a driver which does not know
# their calibration (TUM's recordings: 3 %). The focal lengths of a Kinect's cameras differ by 10 %.
_SAME_MATRIX = 0.05  # share of the focal length
_SAME_PLACE_M = 0.002
_COLOURS = ("rgb", "bgr", "bayer")
_SIDE = re.compile(r"left|right|\d+", re.IGNORECASE)


@dataclass(frozen=True)
class Chosen:
    """The topics that are read.

    Attributes:
        topics: the topic of the left images. If right images or depth images are used, their topic
            is the second entry.
        depth: whether the second topic contains depth.
    """

    topics: tuple[str, ...]
    depth: bool


def choose_topics(
    path: Path, recording: Recording, topics: tuple[str, ...], sensor: str | None
) -> Chosen:
    """Choose the topics that a sensor needs, or check the topics that the user has chosen.

    Raises:
        InputError: topics are missing, or the user must choose.
    """
    there = sorted(topic for topic, kind in recording.types.items() if kind in IMAGE_TYPES)
    deep = {topic for topic in there if _has_depth(recording, path, topic)}
    if len(there) > 1 and deep == set(there):  # 16-bit images with dead pixels look like depth
        deep = {topic for topic in there if "depth" in topic.lower()}
    grey = [topic for topic in there if topic not in deep]
    named = ", ".join(f"{topic} (depth)" if topic in deep else topic for topic in there)
    listed = f"image topics are {named}" if there else "there are no image topics"
    if not there and recording.others:
        listed += f" (vslam does not read {', '.join(sorted(recording.others)[:5])})"
    for topic in topics:
        if topic not in there:
            raise InputError(f"--topics {topic}: not in {path}; {listed}.")
    n = 1 if sensor == "mono" else 2
    if not topics:
        several = sensor is None and bool(deep) and len(grey) > 1
        sensor = sensor or ("rgbd" if deep and len(grey) == 1 else "stereo")
        if len(there) < n or (sensor == "rgbd" and not (deep and grey)):
            instead = "; run with --sensor mono" if grey and n == 2 else ""
            raise InputError(f"{path}: {sensor} needs {_NEEDED[sensor]}; {listed}{instead}.")
        first = {topic: first_message(recording, path, topic) for topic in there}
        if sensor == "rgbd":
            topics = (*_coloured(grey, first), *sorted(deep))
        elif sensor == "stereo" and not several:
            topics = _left_first(_pair(grey), camera_infos(recording, path), first)
        else:
            topics = tuple(grey)
        if len(topics) != n or several:
            wanted = {"mono": "TOPIC", "stereo": "LEFT,RIGHT", "rgbd": "COLOUR,DEPTH"}[sensor]
            wanted += " or COLOUR,DEPTH" * several
            raise InputError(f"{path}: choose topics with --topics {wanted}; {listed}.")
    if not n <= len(topics) <= 2:
        raise InputError(
            f"--topics {','.join(topics)}: give the topic of the left images and the topic of the "
            "right images or of the depth, or run with --sensor mono."
        )
    if len(set(topics)) < len(topics):
        raise InputError(f"--topics {','.join(topics)}: names one topic twice; {listed}.")
    if topics[0] in deep:
        raise InputError(
            f"--topics {','.join(topics)}: {topics[0]} holds depth; give the topic of the images "
            "first."
        )
    return Chosen(topics[:n], n == 2 and (sensor == "rgbd" or topics[1] in deep))


def _has_depth(recording: Recording, path: Path, topic: str) -> bool:
    try:
        for _, message in islice(messages(recording, path, (topic,)), _MOST_EMPTY):
            if (found := depth_in(message, topic)) is not None:
                return found
    except (BrokenSourceError, ValueError):
        pass
    return False


def _coloured(grey: list[str], first: Mapping[str, Message | None]) -> tuple[str, ...]:
    """Return the topics of colour images, which belong to depth sooner than infrared images do."""
    colour = [t for t in grey if str(getattr(first[t], "encoding", "")).startswith(_COLOURS)]
    return tuple(colour if colour and len(grey) > 1 else grey)


def _pair(grey: list[str]) -> tuple[str, ...]:
    """Return the only two topics whose names differ only in their sides or numbers."""
    pairs = [
        pair
        for pair in combinations(grey, 2)
        if len({_SIDE.sub("?", topic) for topic in pair}) == 1
    ]
    return pairs[0] if len(grey) > 2 and len(pairs) == 1 else tuple(grey)


def _left_first(
    pair: tuple[str, ...], infos: Mapping[str, Message], first: Mapping[str, Message | None]
) -> tuple[str, ...]:
    """Put the left topic first: the one whose projection matrix contains no baseline. If both or
    none contain one, the names decide."""
    if len(pair) != 2:
        return pair
    frames = {topic: frame_of(message) for topic, message in first.items() if message is not None}
    has_baseline = [False, False]
    for side, topic in enumerate(pair):
        info = camera_info_of(topic, frames, infos)
        if info is not None:
            P = np.asarray(_field(infos[info], "P"), np.float64)
            has_baseline[side] = bool(P.reshape(3, 4)[:2, 3].any())
    swapped = "right" in pair[0].lower() and "left" in pair[1].lower()
    if has_baseline[0] != has_baseline[1]:
        swapped = has_baseline[0]
    return pair[::-1] if swapped else pair


def frame_of(message: Message) -> str:
    """Return the ``frame_id`` of a message."""
    return str(message.header.frame_id).strip("/")


def camera_infos(recording: Recording, path: Path) -> dict[str, Message]:
    """Return the first ``camera_info`` message of each topic that has one."""
    return _first_of(recording, path, CAMERA_INFO_TYPES)


def _first_of(recording: Recording, path: Path, kinds: Iterable[str]) -> dict[str, Message]:
    topics = sorted(topic for topic, kind in recording.types.items() if kind in kinds)
    first = {topic: first_message(recording, path, topic) for topic in topics}
    return {topic: message for topic, message in first.items() if message is not None}


def camera_info_of(
    image: str, frames: Mapping[str, str], infos: Mapping[str, Message]
) -> str | None:
    """Find the ``camera_info`` topic of an image topic.

    The best one is ``camera_info`` in the namespace of the images, as ROS defines it. The next best
    are one with the same ``frame_id``, and one that is near in the tree of topics. It must not
    belong to another image topic, or to another frame.

    Args:
        image: the image topic.
        frames: the ``frame_id`` of all image topics, by topic.
        infos: the ``camera_info`` messages, by topic.
    """

    def nearness(image: str, info: str) -> tuple[bool, bool, int, int]:
        plain = re.sub("/compressed(Depth)?$", "", image)
        sibling = info == plain.rpartition("/")[0] + "/camera_info"
        frame = frames.get(image, "")
        levels = _common(plain.strip("/").split("/"), info.strip("/").split("/"))
        return sibling, frame != "" and frame == frame_of(infos[info]), levels, _common(plain, info)

    frame = frames.get(image, "")
    # A frame_id that all image topics share says nothing.
    telling = frame if list(frames.values()).count(frame) == 1 else ""
    found = []
    for info in infos:
        near, other = nearness(image, info), frame_of(infos[info])
        differs = telling and other and not (telling.startswith(other) or other.startswith(telling))
        alone = len(frames) == len(infos) == 1
        if near[0] or (not differs and (near[1] or near[2] or near[3] > 1 or alone)):
            found.append((near, info))
    if not found:
        return None
    best = max(found)
    rivals = [near for near, _ in found if near == best[0]]
    taken = any(nearness(other, best[1]) > best[0] for other in frames)
    return None if taken or len(rivals) > 1 else best[1]


def _common(first: str | list[str], second: str | list[str]) -> int:
    """Return how many elements two sequences have in common at their beginnings."""
    n = 0
    for a, b in zip(first, second, strict=False):
        if a != b:
            break
        n += 1
    return n


def _nearest(topic: str, others: Iterable[str]) -> str | None:
    """Return the topic that has the most levels in common with a topic, at least two."""
    levels = topic.strip("/").split("/")
    near = [(_common(levels, other.strip("/").split("/")), other) for other in others]
    n, best = max(near, default=(0, ""))
    return best if n >= 2 else None


def depth_units(recording: Recording, path: Path, topic: str) -> float | None:
    """Return the units per metre that librealsense records beside a depth topic."""
    message = first_message(recording, path, topic)
    units = float(getattr(message, "depth_units", 0.0))  # since librealsense 2.54
    numbers = (t for t, kind in recording.types.items() if kind == NUMBER_TYPE)
    option = _nearest(topic, (t for t in numbers if t.endswith("/option/Depth_Units/value")))
    if not units > 0.0 and option is not None:
        found = first_message(recording, path, option)
        units = 0.0 if found is None else float(found.data)
    return 1.0 / units if 0.0 < units < np.inf else None


def extrinsics(recording: Recording, path: Path, topic: str) -> NDArray[np.float64] | None:
    """Return ``(4, 4)`` ``T_camera_device`` that librealsense records beside an image topic.

    The topic of the transformation is ``tf/0`` beside the folder ``image`` of the images.
    """
    stream = re.match(r"(.*)/image/[^/]*$", topic)
    where = "" if stream is None else f"{stream[1]}/tf/0"
    if recording.types.get(where) != TRANSFORM_TYPE:
        return None
    message = first_message(recording, path, where)
    if message is None:
        return None
    from scipy.spatial.transform import Rotation

    t, q = message.translation, message.rotation
    rotation, translation = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
    if not rotation.any() or not np.isfinite([*rotation, *translation]).all():
        return None
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(rotation).as_matrix()
    T[:3, 3] = translation
    return T


def why_unregistered(
    recording: Recording, path: Path, image: str, depth: str, frames: Mapping[str, str]
) -> str | None:
    """Return why a depth image of the same size cannot contain the depth of an image's pixels.

    Returns None if the two have the same camera matrix, which only one camera can have, or if
    neither the matrices nor recorded extrinsics tell the two cameras apart.
    """
    infos = camera_infos(recording, path)
    found = [camera_info_of(topic, frames, infos) for topic in (image, depth)]
    K_image, K_depth = (
        np.asarray([] if info is None else _field(infos[info], "K"), np.float64) for info in found
    )
    both = K_image.any() and K_depth.any()
    if both and np.array_equal(K_image, K_depth):
        return None
    T_image, T_depth = (extrinsics(recording, path, topic) for topic in (image, depth))
    if T_image is not None and T_depth is not None:
        apart = float(np.linalg.norm((T_image @ np.linalg.inv(T_depth))[:3, 3]))
        if apart > _SAME_PLACE_M:
            return f"its camera is {1e3 * apart:.0f} mm away from that of the images"
    if both and abs(K_depth - K_image).max() > _SAME_MATRIX * K_image[0]:
        what = (
            f"focal lengths of {K[0]:.0f} and {K[4]:.0f} px and the centre ({K[2]:.0f}, {K[5]:.0f})"
            for K in (K_depth, K_image)
        )
        return "its camera has {} but that of the images has {}".format(*what)
    return None


def _field(info: Message, name: str) -> Any:
    """Return a field of a ``camera_info``, whose name is a capital letter in ROS 1 only."""
    return getattr(info, name, getattr(info, name.lower(), ()))
