"""Joins the maps of several drives by loop closures between them.

Each of the other maps is appended to the first map as a sub-map at an unknown place. For each
keyframe of the appended map, the detector of the first map proposes loop candidates. These
candidates are verified and closed as in a run. The first loop moves the sub-map to its place. Later
loops correct drift and fuse landmarks. At the end, a global bundle adjustment optimises the joined
map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vslam.config import Config
from vslam.loopclosure.consistency import MIN_SHARED
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loopclosure.verifier import Verifier
from vslam.maps.stored_map import StoredMap, appended
from vslam.method.closing import LoopClosing
from vslam.types.camera import same_camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.loops import LoopCandidate, LoopEdge
from vslam.types.map import Map

Memory = tuple[LoopDetector, KeyframeImages | None]


@dataclass(frozen=True)
class JoinedMaps:
    """The result of joining several maps. A map is identified by its index in the input.

    Attributes:
        stored: the first map, together with all maps that were joined to it.
        joined: the maps that were joined to the first map, in the order in which they were joined.
        left_out: the maps that no verified loop connects to the first map.
        loops: for each joined map, the loops that connect it to the maps that were joined earlier.
    """

    stored: StoredMap
    joined: list[int]
    left_out: list[int]
    loops: dict[int, list[LoopEdge]]


def join_maps(
    maps: Sequence[StoredMap],
    config: Config,
    create: Callable[[], Memory],
    on_keyframe: Callable[[], None] = lambda: None,
) -> JoinedMaps:
    """Join maps to the first map.

    A map need not overlap the first map if it overlaps another map. Such a map is joined after the
    map that it overlaps.

    Args:
        maps: two or more maps with the same camera, pyramid and detector.
        create: function that creates an empty loop detector of the same kind as the detector of the
            maps, and the store of its images.
        on_keyframe: function that is called after the search for loops at each keyframe.

    Raises:
        ValueError: the maps cannot be joined. The message gives the reason in a few words.
    """
    whole, waiting = maps[0].compact(), dict(enumerate(maps))
    del waiting[0]
    for other in waiting.values():
        _require_alike(whole, other)
    joined: list[int] = []
    loops: dict[int, list[LoopEdge]] = {}
    progress = True
    while waiting and progress:
        progress = False
        for number, other in list(waiting.items()):
            found = join(whole, other.compact(), config, create(), on_keyframe)
            if found is not None:
                whole, loops[number] = found
                joined.append(number)
                del waiting[number]
                progress = True
    return JoinedMaps(whole, joined, list(waiting), loops)


def join(
    one: StoredMap,
    other: StoredMap,
    config: Config,
    memory: Memory,
    on_keyframe: Callable[[], None] = lambda: None,
) -> tuple[StoredMap, list[LoopEdge]] | None:
    """Join two maps that ``StoredMap.compact`` returned.

    The joined map has the world frame of the first map.

    Args:
        memory: an empty loop detector of the same kind as that of the maps, and its image store.

    Returns:
        The joined map, and the loops that were closed between the two maps. None if no loop was
        closed.

    Raises:
        ValueError: the detector differs from that of the maps.
    """
    detector, images = memory
    detector.restore(one.detector)
    both = appended(one, other)
    if images is not None and both.images is not None:
        images.restore(both.images, one.camera.width)
    # With threads=1, global bundle adjustment runs only in finish(), after the last loop.
    context = Context.create(one.camera, config)
    closing = LoopClosing(detector, Verifier(context, images), context, threads=1)
    closing.closed.extend(both.loops)
    map_, n = both.map, one.map.n_keyframes
    for keyframe in range(n, map_.n_keyframes):
        candidates = _candidates(map_, keyframe, detector, images)
        closing.consider(map_, keyframe, candidates)
        on_keyframe()
    if not closing.corrections:
        return None
    closing.finish(map_)
    found = [correction.edge for correction in closing.corrections]
    return replace(both, loops=tuple(closing.closed)).compact(), found


def _candidates(
    map_: Map,
    keyframe: int,
    detector: LoopDetector,
    images: KeyframeImages | None,
) -> list[LoopCandidate]:
    """Find keyframes of the first map that may show the same place as a keyframe of the second map.

    Keyframes that already share enough landmarks with this keyframe are left out.
    """
    image = images.image(keyframe) if images is not None and keyframe in images else None
    found = detector.locate(image, features_of(map_, keyframe), map_)
    joined = set(map_.covisible(keyframe, MIN_SHARED)[0].tolist())
    return [replace(one, query=keyframe) for one in found if one.match not in joined]


def features_of(map_: Map, keyframe: int) -> Features:
    """Return the features of a keyframe."""
    a, rows = map_.arrays, map_.rows(keyframe)
    descriptors = a.descriptor[rows].view(np.uint8)
    return Features(a.xy[rows], a.octave[rows], a.angle[rows], descriptors, a.u_right[rows])


def _require_alike(one: StoredMap, other: StoredMap) -> None:
    if not same_camera(one.camera, other.camera):
        raise ValueError("one was made with another camera")
    if not np.array_equal(one.map.scales, other.map.scales):
        raise ValueError("one was made with another image pyramid")
    if other.detector.name != one.detector.name:
        raise ValueError(
            f"one was made with the detector {other.detector.name}, not {one.detector.name}"
        )
    if other.detector.fingerprint != one.detector.fingerprint:
        raise ValueError(
            f"one was made with another vocabulary or other weights of {one.detector.name}"
        )
