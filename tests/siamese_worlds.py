"""Small networks and small sets of images for tests of the Siamese networks."""

from __future__ import annotations

import copy

import cv2
import numpy as np
import torch

from vslam_lab.training.augmentation import Augmentation
from vslam_lab.training.branches import CapsuleShape
from vslam_lab.training.data import Collection
from vslam_lab.training.settings import TrainSettings
from vslam_lab.training.siamese import SiameseNetwork, build_network

SMALL = CapsuleShape(pixels=64, blocks=((16, 2, 1), (24, 2, 1), (32, 2, 2)), types=8, outputs=8)
MILD = Augmentation(
    homography=0.02, shift=0.02, log_gain=0.1, bias=5, log_gamma=0.1, masks=0, noise=2, blur=0
)


def small_network(seed: int = 0, **shape: object) -> SiameseNetwork:
    """Make a capsule network with 30,000 parameters for images of 64 pixels."""
    torch.manual_seed(seed)
    return build_network("capsule", SMALL.model_copy(update=shape))


def small_settings(**changes: object) -> TrainSettings:
    return TrainSettings(
        shape=SMALL, epochs=2, pairs=16, batch=8, validation_share=0.3, augmentation=MILD,
        learning_rate=3e-3,
    ).model_copy(update=changes)  # fmt: skip


def views(places: int, seed: int = 0) -> Collection:
    """Make two images of each place.

    The images show blobs. In the second image, they are shifted by 3 pixels and darker.
    """
    rng = np.random.default_rng(seed)
    images = []
    for _ in range(places):
        blobs = rng.integers(0, 255, (8, 8)).astype(np.uint8)
        first = cv2.resize(blobs, (64, 64), interpolation=cv2.INTER_CUBIC)
        second = np.roll(first, 3, axis=1) * 0.8 + 20 + rng.normal(0, 4, first.shape)
        images += [first, np.clip(second, 0, 255).astype(np.uint8)]
    place = np.arange(2 * places) // 2
    relation = np.where(place[:, None] == place[None], 1, -1).astype(np.int8)
    names = tuple(f"blobs/all/{k}" for k in range(2 * places))
    return Collection(names, np.stack(images), relation, place, (("blobs", 2 * places),))


def masked(network: SiameseNetwork, drop: torch.Tensor) -> SiameseNetwork:
    """Copy a network and mask the primary capsules ``drop``, ``(T, K)`` bool, in the copy. Masked
    capsules are ignored, but still computed."""
    copied = copy.deepcopy(network)
    layer = copied.branch.capsules
    layer.alive.copy_(~drop.flatten())
    layer.masked = True
    return copied
