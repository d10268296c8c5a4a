"""Reads ROS 1 bags, ROS 2 bags and MCAP files, using the library rosbags.

Images are ``sensor_msgs/Image`` or ``CompressedImage`` messages. Their time stamps are taken from
the message headers.

The images of two topics are paired by time. The two images of a stereo pair are at most 5 ms apart.
An image and its depth are at most 20 ms apart. Images without a partner are skipped.

If the bag has ``camera_info`` topics, the calibration is read from them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.calibration.formats import read_ros
from vslam.calibration.models import Calibration
from vslam.camera import DepthImage, Image, ImageMap
from vslam.datasets.association import DEPTH_NEAR_S, Pairing
from vslam.datasets.bag_messages import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPES,
    Message,
    camera_info,
    colour_of,
    depth_of,
    grey_of,
    is_depth,
    levels_of_messages,
    nav_sat_fix,
    stamp_of,
)
from vslam.datasets.frames import Images, RawSource, Size, TimedFrame, decoded
from vslam.datasets.grey_levels import Levels
from vslam.datasets.image_files import size_text
from vslam.errors import BrokenSourceError, InputError, UnreadableImageError

Bag = Any  # rosbags.highlevel.AnyReader

_FIX_TYPE = "sensor_msgs/msg/NavSatFix"
_MOST_METADATA = 1_000_000  # bytes; a hundred topics need 100,000
_TOLERANCE_NS = 5_000_000
# A Kinect takes images and depth alternately.
_DEPTH_TOLERANCE_NS = round(1e9 * DEPTH_NEAR_S)
_NEEDED = {
    "mono": "an image topic",
    "stereo": "two image topics",
    "rgbd": "an image topic and one of depth",
}
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
) -> BagSource:
    """Open a bag and read its first frame.

    Args:
        path: ``.bag``, ``.mcap`` or ``.db3``, or the folder of a ROS 2 bag.
        topics: the topic of the left images, followed by the topic of the right images or of the
            depth images. If ``topics`` is empty, the bag must have exactly as many image topics as
            the sensor needs. In this case, the first topic in alphabetical order contains the left
            images.
        sensor: ``stereo``, ``rgbd`` or ``mono``. With ``mono``, only the first topic is read. If it
            is None, the sensor is derived from the content of the topics.
        depth_scale: depth image units per metre; None derives it from the encoding.

    Raises:
        InputError: rosbags is not installed, the bag is missing or truncated, topics are missing,
            or the images have no time stamps, cannot be decoded or form no pairs.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; give a bag with --data.")
    with _opened(path) as bag:
        chosen, depth = _choose_topics(path, bag, topics, sensor)
        tolerance = _tolerance(depth)
        pairing = Pairing(
            path,
            f"image of {chosen[-1]}",
            1e-9 * tolerance,
            f"correct the time stamps if those of {chosen[-1]} are late, name other topics with "
            "--topics, or run with --sensor mono",
        )
        first_two = list(islice(_synchronised(_messages(bag, path, chosen), chosen, pairing), 2))
        if not first_two:
            raise InputError(
                f"{path}: no images of {' and '.join(chosen)} have the same time (within "
                f"{tolerance / 1e6:g} ms); name topics of one camera with --topics."
            )
        if all(stamp_of(messages[0]) == 0 for messages in first_two):
            raise InputError(
                f"{path}: the images of {chosen[0]} have no time stamps (header.stamp is 0); "
                "record them again with a driver that sets it."
            )
        grey = chosen[: len(chosen) - depth]
        levels = levels_of_messages(first_two[0][: len(grey)])
        if levels is not None:
            levels = levels_of_messages(_spread(bag, path, grey))
        images = [
            _decoded(path, topic, message, is_depth, depth_scale, levels)
            for topic, message, is_depth in zip(chosen, first_two[0], (False, depth), strict=False)
        ]
        if depth and images[0].shape != images[1].shape:
            raise InputError(
                f"{path}: the depth in {chosen[1]} has {size_text(images[1].shape)} pixels but the "
                f"images in {chosen[0]} have {size_text(images[0].shape)}; name depth that is "
                "registered to the images."
            )
        sizes = tuple((image.shape[1], image.shape[0]) for image in images)
        return BagSource(
            dataset="bag",
            name=path.stem,
            path=path,
            topics=chosen,
            sizes=sizes[:1] if depth else sizes,
            play=partial(_play, path, chosen, sizes, depth, depth_scale, levels, pairing),
            n_expected=_estimated_frames(bag, chosen),
            depth=depth,
            pairing=pairing if len(chosen) == 2 else None,
        )


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

    with _opened(path) as bag:
        for pair in _synchronised(_messages(bag, path, topics), topics, pairing):
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


def find_calibration(source: BagSource) -> Calibration | None:
    """Read the calibration from the ``camera_info`` topics that belong to the image topics.

    Returns:
        The calibration. None if a ``camera_info`` topic is missing, or if the focal length in it is
        0, which means that the camera is not calibrated.

    Raises:
        InputError: a ``camera_info`` message cannot be read, or is not a valid calibration.
    """
    path = source.path
    documents = []
    with _opened(path) as bag:
        for topic in source.topics[: 1 if source.depth else None]:
            namespace, _, image = topic.removesuffix("/compressed").rpartition("/")
            info = f"{namespace}/camera_info"
            if not any(c.topic == info and c.msgtype == CAMERA_INFO_TYPE for c in bag.connections):
                return None
            _, message = next(_messages(bag, path, (info,)), (info, None))
            if message is None:
                return None
            rectified = image.startswith("image_rect")
            found = camera_info(message, f"{path}: {info}", rectified)
            if found is None:
                return None
            documents.append(found)
    return read_ros(documents, None)


def read_fixes_of_bag(path: Path) -> NDArray[np.float64]:
    """Read the GPS fixes (``sensor_msgs/NavSatFix``) of a bag.

    Returns:
        ``(M, 7)`` float64. Each row contains the time (s), latitude and longitude (degrees),
        altitude (m), and the standard deviations east, north and up (m). Unknown standard
        deviations are NaN.

    Raises:
        InputError: rosbags is not installed, the bag is damaged, it does not have exactly one topic
            of GPS fixes, no message contains a fix, or a fix has no time stamp.
    """
    with _opened(path) as bag:
        topics = sorted({c.topic for c in bag.connections if c.msgtype == _FIX_TYPE})
        if len(topics) != 1:
            found = f"several ({', '.join(topics)})" if topics else "none"
            raise InputError(
                f"{path}: --gps needs one topic of NavSatFix messages, but the bag has {found}; "
                "write the fixes to a CSV file."
            )
        fixes = [nav_sat_fix(message) for _, message in _messages(bag, path, (topics[0],))]
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


@contextmanager
def _opened(path: Path) -> Iterator[Bag]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        from vslam.datasets.bag_limits import limit_bags
    except ImportError as error:
        raise InputError(
            f"{path}: bags are read by rosbags, which is not installed; pip install 'vslam[bag]'."
        ) from error
    limit_bags()
    try:
        _check_metadata(path / "metadata.yaml")
        bag = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        bag.open()
    except Exception as error:  # rosbags and its parsers raise many kinds for damaged files
        raise InputError(
            f"{path}: cannot be read as a bag ({_reason(error)}); if the recording was cut off, "
            "repair it with 'rosbag reindex', 'ros2 bag reindex' or 'mcap recover'."
        ) from error
    try:
        yield bag
    finally:
        bag.close()


def _check_metadata(file: Path) -> None:
    """Reject a large file, because rosbags needs 30 us and 300 bytes of memory for each byte."""
    if file.is_file() and file.stat().st_size > _MOST_METADATA:
        raise ValueError(f"{file.name} is larger than {_MOST_METADATA / 1e6:.0f} MB")


def _messages(
    bag: Bag, path: Path, topics: tuple[str, ...], start: int | None = None
) -> Iterator[tuple[str, Message]]:
    """Yield the topics and messages of a bag, from the time ``start`` (ns) at which the bag was
    recorded."""
    connections = [c for c in bag.connections if c.topic in topics]
    try:
        for connection, _, data in bag.messages(connections=connections, start=start):
            yield connection.topic, bag.deserialize(data, connection.msgtype)
    except Exception as error:  # rosbags raises many kinds, as in _opened
        raise BrokenSourceError(
            f"{path}: the bag is damaged or cut off ({_reason(error)}); copy it again."
        ) from error


def _spread(bag: Bag, path: Path, topics: tuple[str, ...]) -> Iterator[Message]:
    """Yield messages of each topic that are spread over the bag, as far as it can be read."""
    times = np.linspace(bag.start_time, bag.end_time, _SAMPLES, endpoint=False)
    try:
        for start in times.astype(np.int64).tolist():
            for topic in topics:
                yield from (m for _, m in islice(_messages(bag, path, (topic,), start), 1))
    except BrokenSourceError:
        return


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")


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
                pairing.n_pairs += 1
                yield first.popleft(), second.popleft()
            elif early is first:
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


def _choose_topics(
    path: Path, bag: Bag, topics: tuple[str, ...], sensor: str | None
) -> tuple[tuple[str, ...], bool]:
    """Return the topics to read, and whether the second one contains depth."""
    there = sorted({c.topic for c in bag.connections if c.msgtype in IMAGE_TYPES})
    listed = f"image topics are {', '.join(there)}" if there else "there are no image topics"
    for topic in topics:
        if topic not in there:
            raise InputError(f"--topics {topic}: not in {path}; {listed}.")
    with_depth = tuple(topic for topic in there if _has_depth(bag, path, topic))
    n = 1 if sensor == "mono" else 2
    if not topics:
        grey = tuple(topic for topic in there if topic not in with_depth)
        sensor = sensor or ("rgbd" if with_depth and len(grey) == 1 else "stereo")
        topics = (*grey, *with_depth) if sensor == "rgbd" else grey
        if len(there) < n or (sensor == "rgbd" and not (with_depth and grey)):
            instead = "; run with --sensor mono" if grey and n == 2 else ""
            raise InputError(f"{path}: {sensor} needs {_NEEDED[sensor]}; {listed}{instead}.")
        if len(topics) != n:
            wanted = {"mono": "TOPIC", "stereo": "LEFT,RIGHT", "rgbd": "COLOUR,DEPTH"}[sensor]
            raise InputError(f"{path}: choose topics with --topics {wanted}; {listed}.")
    if not n <= len(topics) <= 2:
        raise InputError(
            f"--topics {','.join(topics)}: give the topic of the left images and the topic of the "
            "right images or of the depth, or run with --sensor mono."
        )
    if len(set(topics)) < len(topics):
        raise InputError(f"--topics {','.join(topics)}: names one topic twice; {listed}.")
    if topics[0] in with_depth:
        raise InputError(
            f"--topics {','.join(topics)}: {topics[0]} holds depth; give the topic of the images "
            "first."
        )
    depth = n == 2 and (sensor == "rgbd" or (sensor is None and topics[1] in with_depth))
    return topics[:n], depth


def _estimated_frames(bag: Bag, topics: tuple[str, ...]) -> int | None:
    try:
        n = min(bag.topics[topic].msgcount for topic in topics)
    except TypeError:
        return None
    return n if isinstance(n, int) and n > 0 else None


def _has_depth(bag: Bag, path: Path, topic: str) -> bool:
    try:
        _, message = next(_messages(bag, path, (topic,)))
    except (StopIteration, BrokenSourceError):
        return False
    return is_depth(message, topic)


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
