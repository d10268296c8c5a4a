"""The settings of a training run, and the presets of these settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from vslam.config import read_json
from vslam_lab.training.augmentation import STRONG, Augmentation
from vslam_lab.training.branches import CapsuleShape


class TrainSettings(BaseModel):
    """The settings of a training run. They are stored in the file ``settings.json``, and the option
    ``--settings`` reads such a file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    network: str = Field("capsule", description="Network to train.")
    shape: CapsuleShape = Field(CapsuleShape(), description="Shape of the capsule branch.")
    fit: Literal["squash", "crop"] = Field(
        "squash",
        description="Squash the whole image, or crop its middle to the input's aspect ratio.",
    )
    seed: int = Field(0, ge=0, description="Seed of weights, split, pairs and augmentation.")
    loss: Literal["bce", "bce+contrast"] = Field(
        "bce", description="Cross entropy (Eq. 3) alone, or together with InfoNCE."
    )
    temperature: float = Field(0.07, gt=0, description="Temperature of InfoNCE.")
    learning_rate: float = Field(3e-4, gt=0, description="Learning rate of Adam. [paper]")
    extractor_rate: float = Field(
        1.0, ge=0, description="Factor for the learning rate of the extractor."
    )
    learned_share: float = Field(
        1.0,
        gt=0,
        le=1,
        description="Weight of the trained network in its average with the initial one.",
    )
    frozen: int = Field(
        0, ge=0, description="Number of blocks of lite0, from the first, that are frozen."
    )
    schedule: Literal["constant", "cosine"] = "constant"
    mixed_precision: bool | None = Field(
        None,
        description="Use bfloat16 except in the routing; null uses it if a GPU supports it.",
    )
    batch: int = Field(64, ge=2, description="Number of pairs per batch. [paper]")
    epochs: int = Field(40, ge=1, description="Largest number of epochs.")
    pairs: int = Field(4096, ge=2, description="Number of pairs per epoch.")
    same_share: float = Field(
        0.5, gt=0, le=1, description="Share of the pairs that show the same place. [paper]"
    )
    together: int = Field(
        1, ge=1, description="Number of consecutive pairs whose first images share a source."
    )
    emphasis: dict[str, Annotated[float, Field(gt=0)]] = Field(
        {}, description="Relative frequency of the images of each source; default 1."
    )
    patience: int = Field(
        6, ge=1, description="Training stops after this many epochs without a better validation AP."
    )
    hard_share: float = Field(
        0.5, ge=0, le=1, description="Share of the pairs of different places that come from mining."
    )
    mined_images: int = Field(
        4000, ge=2, description="Largest number of images that are embedded for mining."
    )
    validation_share: float = Field(
        0.15, gt=0, lt=1, description="Share of the units that are used for validation."
    )
    validation_images: int = Field(800, ge=2, description="Largest number of validation images.")
    augmentation: Augmentation = Augmentation()
    prune_share: float = Field(
        0.2, gt=0, lt=1, description="Share of the capsules that pruning removes. [paper]"
    )
    prune_iterations: int | None = Field(
        None, ge=1, description="Routing iterations after pruning; null keeps the number."
    )


_BEST = TrainSettings(
    loss="bce+contrast",
    schedule="cosine",
    learning_rate=1e-3,
    augmentation=STRONG,
    batch=32,
    pairs=2048,
    same_share=0.8,
    together=16,
    patience=10,
    mined_images=1500,
    validation_images=400,
)
PRESETS = {
    # The settings of Zhou and Sun (2025). Their paper does not state the strengths of the
    # augmentation or how pairs are mined.
    "paper": TrainSettings(),
    # The contrastive loss compares every image of a batch with every other image. The augmentation
    # is stronger. Most pairs show the same place, because this loss takes images of different
    # places from the other pairs. Half of a batch comes from one source, because different places
    # look most similar within a source. Small batches, short epochs, and little mining and
    # validation suit training on two cores.
    "best": _BEST,
    # The same settings for training that starts from ImageNet weights (--weights). The first blocks
    # of the extractor, which detect edges and corners, are frozen. The rest of the extractor learns
    # slowly.
    "pretrained": _BEST.model_copy(
        update={
            "shape": CapsuleShape(extractor="lite0", pixels=129),
            "extractor_rate": 0.2,
            "frozen": 3,
            "pairs": 4096,
            "epochs": 16,
            "augmentation": STRONG.model_copy(update={"turn": 30.0}),
        }
    ),
}


def load_settings(path: Path) -> TrainSettings:
    """Read the settings of a training run from a JSON file. Settings that are missing in the file
    keep their defaults."""
    return read_json(TrainSettings, path, "settings")
