"""Training of PCANet by principal components instead of gradients."""

from __future__ import annotations

import math
import time
from pathlib import Path

from vslam.loopclosure.training.checkpoint import TrainingProgress
from vslam.loopclosure.training.data import Collection, divide, validation_images
from vslam.loopclosure.training.pcanet import PcaNetBranch
from vslam.loopclosure.training.settings import TrainSettings
from vslam.loopclosure.training.siamese import build_network
from vslam.loopclosure.training.training import (
    TrainingOutcome,
    calibrated,
    open_device,
    write_log,
)

_LEARNED_IMAGES = 1500  # most images from which components are learned: 200 MB


def learn_components(
    collection: Collection, settings: TrainSettings, folder: Path, *, device: str = "cpu"
) -> TrainingOutcome:
    """Learn PCANet from the training images, like :func:`training.train` but without gradients and
    epochs.

    Raises:
        InputError: too little data, or an unknown device.
        ResultsError: the results cannot be written.
    """
    where = open_device(device)
    train_images, validation = divide(collection, settings.seed, settings.validation_share)
    validation = validation_images(validation, settings.validation_images, settings.seed)
    learned = train_images[:: -(-len(train_images) // _LEARNED_IMAGES)]
    network = build_network(settings.network, settings.shape, settings.head)
    assert isinstance(network.branch, PcaNetBranch)
    began = time.monotonic()
    network.branch.learn(collection.images[learned])
    network.to(where)
    weights = folder / f"{settings.network}.safetensors"
    figures = calibrated(network, {}, collection, validation, settings, weights, where)
    seconds = time.monotonic() - began
    row = {"epoch": 0.0, "loss": math.nan, **figures, "seconds": seconds}
    progress = TrainingProgress(
        epoch=1, best=figures["average_precision"], seconds=seconds, images=len(learned),
        history=[row],
    )  # fmt: skip
    write_log(folder / "log.csv", progress.history)
    return TrainingOutcome(True, figures, progress, weights, train_images, validation)
