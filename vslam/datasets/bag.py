"""Reads the images and the calibration in ROS 1 bags, ROS 2 bags and MCAP files.

Images are ``sensor_msgs/Image`` or ``CompressedImage`` messages, or Foxglove's ``RawImage`` or
``CompressedImage``. Their time stamps are taken from the message headers.

The images of two topics are paired by time. The two images of a stereo pair are at most 5 ms apart.
An image and its depth are at most 20 ms apart. Images without a partner are left out.

If the bag has ``camera_info`` topics, the calibration is read from them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.files import NEEDED_CALIBRATION
from vslam.calibration.formats import read_ros
from vslam.calibration.models import Calibration
from vslam.datasets.association import DEPTH_NEAR_S, Pairing
from vslam.datasets.bag_files import Recording, first_message, messages, opened
from vslam.datasets.bag_imu import find_imu
from vslam.datasets.bag_messages import (
    FIX_TYPE,
    IMAGE_TYPES,
    Message,
    camera_info,
    colour_of,
    depth_of,
    grey_of,
    levels_of_messages,
    nav_sat_fix,
    stamp_of,
)
from vslam.datasets.bag_topics import (
    camera_info_of,
    camera_infos,
    choose_topics,
    depth_units,
    extrinsics,
    frame_of,
    why_unregistered,
)
from vslam.datasets.frames import Images, RawSource, Size, TimedFrame, decoded
from vslam.datasets.grey_levels import Levels
from vslam.datasets.image_files import size_text
from vslam.support.errors import BrokenSourceError, InputError, UnreadableImageError
from vslam.types.camera import DepthImage, Image, ImageMap

_TOLERANCE_NS = 5_000_000
# A Kinect takes images and depth alternately.
_DEPTH_TOLERANCE_NS = round(1e9 * DEPTH_NEAR_S)
_SAMPLES = 8  # images in which the range of the grey values is measured
_MOST_WAITING = 32  # images of one topic that are kept while they wait for a partner


@dataclass(frozen=True, kw_only=True, eq=False)
class BagSource(RawSource):
    """The images of a bag.

    Attributes:
        path: the bag's file or folder.
        topics: the topic of the left images. If right images or depth images are used, their topic
            is the second entry.
    """

    path: Path
    topics: tuple[str, ...]


def open_bag(
    path: Path | str,
    *,
    topics: tuple[str, ...] = (),
    sensor: str | None = None,
    depth_scale: float | None = None,
    imu_topics: tuple[str, ...] = (),
) -> BagSource:
    """Open a bag and read its first frame.

    Args:
        path: ``.bag``, ``.mcap`` or ``.db3``, or the folder of a ROS 2 bag.
        topics: the topic of the left images, followed by the topic of the right images or of the
            depth images. If ``topics`` is empty, the bag must have exactly as many image topics as
            the sensor needs, or only one pair of them whose names differ in a side or number. In
            this case, the left images are those whose projection matrix has no baseline, or, if
            that does not decide, the first in alphabetical order.
        sensor: ``stereo``, ``rgbd`` or ``mono``. With ``mono``, only the first topic is read. If it
            is None, the sensor is derived from the content of the topics.
        depth_scale: depth image units per metre. None takes what librealsense recorded or, without
            it, derives it from the encoding.
        imu_topics: see `vslam.datasets.bag_imu.find_imu`.

    Raises:
        InputError: a library is not installed, the bag is missing or truncated, topics are missing,
            or the images have no time stamps, cannot be decoded or form no pairs, or the depth is
            not registered to the images.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; give a bag with --data.")
    with opened(path) as recording:
        selection = choose_topics(path, recording, topics, sensor)
        chosen, depth = selection.topics, selection.depth
        if depth and depth_scale is None:
            depth_scale = depth_units(recording, path, chosen[1])
        tolerance = _tolerance(depth)
        pairing = Pairing(
            path,
            f"image of {chosen[-1]}",
            1e-9 * tolerance,
            f"correct the time stamps if those of {chosen[-1]} are late, name other topics with "
            "--topics, or run with --sensor mono",
        )
        read = messages(recording, path, chosen)
        first_two = list(islice(_synchronised(read, chosen, pairing), 2))
        if not first_two:
            raise InputError(
                f"{path}: no images of {' and '.join(chosen)} have the same time (within "
                f"{tolerance / 1e6:g} ms); name topics of one camera with --topics."
            )
        if all(stamp_of(pair[0]) == 0 for pair in first_two):
            raise InputError(
                f"{path}: the images of {chosen[0]} have no time stamps (header.stamp is 0); "
                "record them again with a driver that sets it."
            )
        grey = chosen[: len(chosen) - depth]
        levels = levels_of_messages(first_two[0][: len(grey)])
        if levels is not None:
            levels = levels_of_messages(_spread(recording, path, grey))
        images = [
            _decoded(path, topic, message, is_depth, depth_scale, levels)
            for topic, message, is_depth in zip(chosen, first_two[0], (False, depth), strict=False)
        ]
        if depth:
            _check_registered(path, recording, chosen, [image.shape for image in images])
        sizes = tuple((image.shape[1], image.shape[0]) for image in images)
        imu, warnings = find_imu(path, recording, imu_topics)
        return BagSource(
            dataset="bag",
            name=path.stem,
            path=path,
            topics=chosen,
            sizes=sizes[:1] if depth else sizes,
            play=partial(_play, path, chosen, sizes, depth, depth_scale, levels, pairing),
            n_expected=_estimated_frames(recording, chosen),
            depth=depth,
            pairing=pairing if len(chosen) == 2 else None,
            imu=imu,
            warnings=warnings,
        )


def _check_registered(
    path: Path, recording: Recording, topics: tuple[str, ...], shapes: list[tuple[int, ...]]
) -> None:
    image, depth = topics
    if shapes[0] != shapes[1]:
        sizes = [size_text(shape) for shape in shapes]
        raise InputError(
            f"{path}: the depth in {depth} has {sizes[1]} pixels but the images in {image} have "
            f"{sizes[0]}; name depth that is registered to the images, or run with --sensor mono."
        )
    why = why_unregistered(recording, path, image, depth, _frames(recording, path))
    if why is not None:
        raise InputError(
            f"{path}: the depth in {depth} is not registered to the images in {image}, because "
            f"{why}; name depth that is registered to the images, or run with --sensor mono."
        )


def _frames(recording: Recording, path: Path) -> dict[str, str]:
    """Return the ``frame_id`` of each image topic that has messages."""
    images = sorted(topic for topic, kind in recording.types.items() if kind in IMAGE_TYPES)
    first = {topic: first_message(recording, path, topic) for topic in images}
    return {topic: frame_of(message) for topic, message in first.items() if message is not None}


def _play(
    path: Path,
    topics: tuple[str, ...],
    sizes: tuple[Size, ...],
    depth: bool,
    scale: float | None,
    levels: Levels | None,
    pairing: Pairing,
) -> Iterator[TimedFrame]:
    def read(messages: tuple[Message, ...], image_map: ImageMap) -> Images:
        sides = zip(messages, topics, sizes, (False, depth), strict=False)
        return decoded([partial(of_size, *side) for side in sides], image_map)

    def of_size(message: Message, topic: str, size: Size, is_depth: bool) -> Image | DepthImage:
        image = _decoded(path, topic, message, is_depth, scale, levels)
        if image.shape[::-1] != size:
            raise UnreadableImageError(
                path,
                f"an image of {topic} has {size_text(image.shape)} pixels but the first image has "
                f"{size_text(size[::-1])}.",
            )
        return image

    with opened(path) as recording:
        for pair in _synchronised(messages(recording, path, topics), topics, pairing):
            yield TimedFrame(
                stamp_of(pair[0]) / 10**9,
                partial(read, pair),
                colour=partial(_in_colour, path, topics[0], levels, pair[0]),
            )


def _in_colour(
    path: Path, topic: str, levels: Levels | None, message: Message
) -> NDArray[np.uint8]:
    try:
        return colour_of(message, levels)
    except ValueError as error:
        raise UnreadableImageError(path, f"{topic}: {error}.") from error


def find_calibration(source: BagSource) -> Calibration:
    """Read the calibration from the ``camera_info`` topics that belong to the image topics.

    If the projection matrices of a stereo pair contain no baseline, the extrinsics are used that
    librealsense records beside the images.

    Raises:
        InputError: an image topic has no ``camera_info``, or its camera is not calibrated (the
            camera matrix is 0), or the ``camera_info`` is not a valid calibration.
    """
    path = source.path
    topics = source.topics[: 1 if source.depth else None]
    documents = []
    with opened(path) as recording:
        infos, frames = camera_infos(recording, path), _frames(recording, path)
        T_device = [extrinsics(recording, path, topic) for topic in topics]
    for topic, size in zip(topics, source.sizes, strict=True):
        info = camera_info_of(topic, frames, infos)
        if info is None:
            there = f" belongs to {topic}; there is {', '.join(infos)}" if infos else ""
            raise _uncalibrated(f"no camera_info in the bag{there}")
        rectified = topic.removesuffix("/compressed").rpartition("/")[2].startswith("image_rect")
        document = camera_info(infos[info], f"{path}: {info}", rectified, size)
        if document is None:
            raise _uncalibrated(f"the camera matrix in {info} is 0")
        documents.append(document)
    has_baseline = any(document.matrix("P", 3, 4)[:2, 3].any() for document in documents)
    T_left, T_right = T_device if len(T_device) == 2 else (None, None)
    if has_baseline or T_left is None or T_right is None:
        return read_ros(documents, None)
    left, right = (read_ros([document], None).left for document in documents)
    where = " and ".join(document.source for document in documents)
    return Calibration(left, right, T_left @ np.linalg.inv(T_right), source=where)


def _uncalibrated(why: str) -> InputError:
    return InputError(f"--calib: no calibration, and {why}; {NEEDED_CALIBRATION}.")


def read_fixes_of_bag(path: Path) -> NDArray[np.float64]:
    """Read the GPS fixes (``sensor_msgs/NavSatFix``) of a bag.

    Returns:
        ``(M, 7)`` float64. Each row contains the time (s), latitude and longitude (degrees),
        altitude (m), and the standard deviations east, north and up (m). Unknown standard
        deviations are NaN.

    Raises:
        InputError: a library is not installed, the bag is damaged, it does not have exactly one
            topic of GPS fixes, no message contains a fix, or a fix has no time stamp.
    """
    with opened(path) as recording:
        topics = sorted(topic for topic, kind in recording.types.items() if kind == FIX_TYPE)
        if len(topics) != 1:
            found = f"several ({', '.join(topics)})" if topics else "none"
            raise InputError(
                f"{path}: --gps needs one topic of NavSatFix messages, but the bag has {found}; "
                "write the fixes to a CSV file."
            )
        fixes = [nav_sat_fix(fix) for _, fix in messages(recording, path, (topics[0],))]
    rows = np.array(fixes, np.float64).reshape(-1, 7)
    rows = rows[np.isfinite(rows[:, 1:4]).all(axis=1)]
    if not len(rows):
        raise InputError(f"{path}: no message of {topics[0]} is a fix; give another file.")
    if not rows[:, 0].all():
        raise InputError(
            f"{path}: the fixes of {topics[0]} have no time stamps (header.stamp is 0); record "
            "them again with a driver that sets it."
        )
    return rows


def _spread(recording: Recording, path: Path, topics: tuple[str, ...]) -> Iterator[Message]:
    """Yield messages of each topic that are spread over the bag, as far as it can be read."""
    times = np.linspace(*recording.span, _SAMPLES, endpoint=False)
    try:
        for start in times.astype(np.int64).tolist():
            for topic in topics:
                yield from (m for _, m in islice(messages(recording, path, (topic,), start), 1))
    except BrokenSourceError:
        return


def _tolerance(depth: bool) -> int:
    return _DEPTH_TOLERANCE_NS if depth else _TOLERANCE_NS


def _synchronised(
    messages: Iterator[tuple[str, Message]], topics: tuple[str, ...], pairing: Pairing
) -> Iterator[tuple[Message, ...]]:
    """Yield pairs of messages of two topics that have nearly the same time stamp.

    A message is paired only when no later message of the other topic can be nearer in time.
    """
    pairing.restart()
    if len(topics) == 1:
        yield from ((message,) for _, message in messages)
        return
    waiting = {topic: deque[Message](maxlen=_MOST_WAITING) for topic in topics}
    first, second = waiting.values()
    tolerance = round(1e9 * pairing.within_s)

    def leave_out(message: Message) -> None:
        pairing.left_out.append(stamp_of(message) / 10**9)

    def pairs(enough: int) -> Iterator[tuple[Message, ...]]:
        while min(len(first), len(second)) >= enough:
            apart = stamp_of(first[0]) - stamp_of(second[0])
            early, late = (first, second) if apart < 0 else (second, first)
            behind = abs(stamp_of(early[1]) - stamp_of(late[0])) if len(early) > 1 else tolerance
            if abs(apart) <= min(behind, tolerance):
                pairing.add_pair()
                yield first.popleft(), second.popleft()
                continue
            # After a clock was set back, the next late message is nearer to the early one.
            is_old = len(late) > 1 and abs(stamp_of(late[1]) - stamp_of(early[0])) < abs(apart)
            if (late if is_old else early) is first:
                leave_out(first.popleft())
            else:
                second.popleft()

    for topic, message in messages:
        if topic == topics[1]:
            pairing.seconds.append(stamp_of(message) / 10**9)
        elif len(first) == _MOST_WAITING:
            leave_out(first[0])
        waiting[topic].append(message)
        yield from pairs(2)
    yield from pairs(1)
    for message in first:
        leave_out(message)


def _estimated_frames(recording: Recording, topics: tuple[str, ...]) -> int | None:
    n = min(recording.counts.get(topic, 0) for topic in topics)
    return n if n > 0 else None


def _decoded(
    path: Path,
    topic: str,
    message: Message,
    depth: bool,
    scale: float | None,
    levels: Levels | None,
) -> Image | DepthImage:
    try:
        return depth_of(message, scale) if depth else grey_of(message, levels)
    except ValueError as error:
        raise UnreadableImageError(path, f"{topic}: {error}.") from error
