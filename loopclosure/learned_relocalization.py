"""Relocalisation by learned local descriptors, for lighting in which ORB descriptors fail."""

from __future__ import annotations

from vslam.camera import Camera, Image
from vslam.config import Config
from vslam.features import Features
from vslam.loopclosure.learned_verification import rated, recognise
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.loops import LoopCandidate, Sighting
from vslam.map import Map


class LearnedRelocalisation:
    """Implements ``Recognise`` by the images of keyframes; finds nothing if there are no images."""

    def __init__(self, images: KeyframeImages | None, camera: Camera, config: Config) -> None:
        self._images = images
        self._camera = camera
        self._config = config

    def __call__(
        self, map_: Map, image: Image | None, features: Features, candidates: list[LoopCandidate]
    ) -> Sighting | None:
        """Search for a frame at the candidates whose images are most similar to it; returns None if
        it is found at none of them."""
        images, config = self._images, self._config
        if images is None or image is None:
            return None
        candidates = rated(candidates, lambda: images.glance_at(image), images, config.learned)
        alike = [one for one in candidates if one.alike is not None]
        alike.sort(key=lambda one: -(one.alike or 0.0))
        if not alike:
            return None
        maps = images.network.describe(image)
        for candidate in alike[: config.learned.max_candidates]:
            found = recognise(map_, maps, features, candidate.match, images, self._camera, config)
            if found is not None:
                return found
        return None
