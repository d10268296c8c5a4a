"""What a training depends on beside its data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from vslam.config.section import read_json
from vslam.loopclosure.training.augmentation import STRONG, Augmentation
from vslam.loopclosure.training.branches import CapsuleShape
from vslam.loopclosure.training.siamese import Head


class TrainSettings(BaseModel):
    """Written to ``settings.json`` of a training, read by ``--settings``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    network: str = Field("capsule", description="Network to train.")
    shape: CapsuleShape = Field(
        CapsuleShape(), description="Of a capsule branch; others take its size of images only."
    )
    head: Head | None = Field(None, description="Compares descriptors; null: the network's own.")
    fit: Literal["squash", "crop"] = Field(
        "squash", description="Whole view, or its middle in the aspect of the input."
    )
    seed: int = Field(0, ge=0, description="Of weights, division, pairs and augmentation.")
    loss: Literal["bce", "bce+contrast"] = Field("bce", description="Eq. 3, or with contrast.")
    temperature: float = Field(0.07, gt=0, description="Of the contrast.")
    learning_rate: float = Field(3e-4, gt=0, description="Of Adam. [paper]")
    extractor_rate: float = Field(1.0, ge=0, description="Of the extractor, times that rate.")
    learned_share: float = Field(
        1.0, gt=0, le=1, description="Of what training changed; 1 keeps nothing of the start."
    )
    frozen: int = Field(0, ge=0, description="Blocks of a lite0 extractor that stay, and its stem.")
    schedule: Literal["constant", "cosine"] = "constant"
    mixed_precision: bool | None = Field(
        None, description="bfloat16, but for the routing; null: on a GPU that can."
    )
    batch: int = Field(64, ge=2, description="Pairs. [paper]")
    epochs: int = Field(40, ge=1, description="At most.")
    pairs: int = Field(4096, ge=2, description="Pairs of an epoch.")
    same_share: float = Field(0.5, gt=0, le=1, description="Of the pairs: of one place. [paper]")
    together: int = Field(1, ge=1, description="Pairs in a row that are of one source.")
    emphasis: dict[str, Annotated[float, Field(gt=0)]] = Field(
        {}, description="Of sources by name: how often their images are drawn; 1 for others."
    )
    patience: int = Field(6, ge=1, description="Epochs without a better validation AP.")
    hard_share: float = Field(0.5, ge=0, le=1, description="Of the pairs of two places: mined.")
    mined_images: int = Field(4000, ge=2, description="Images embedded for mining, at most.")
    validation_share: float = Field(0.15, gt=0, lt=1, description="Of the units of each source.")
    validation_images: int = Field(800, ge=2, description="At most.")
    augmentation: Augmentation = Augmentation()
    prune_share: float = Field(
        0.2, gt=0, lt=1, description="Of the capsules, removed when pruning. [paper]"
    )
    prune_iterations: int | None = Field(
        None, ge=1, description="Of the routing after pruning; null: as many as before."
    )


# Small networks need mild changes to learn anything in so short a time (docs/research/training.md).
_MILD = Augmentation(
    homography=0.05, shift=0.05, log_gain=0.2, bias=10.0, log_gamma=0.2, masks=1, noise=3.0,
    blur=0.5,
)  # fmt: skip
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
    # What the paper writes; augmentation strengths and mining are ours, it gives none.
    "paper": TrainSettings(),
    # Every image of a batch is compared with every other, under stronger changes. Most pairs are
    # of one place, since the contrast finds the other places in the batch; half of a batch is
    # of one source, where other places look most alike. Smaller batches and shorter epochs, with
    # less mining and validation, suit the two cores that it was trained on.
    "best": _BEST,
    # The same from ImageNet weights (--weights). Filters for edges and corners stay as they are,
    # the rest of the extractor learns slowly. 129 pixels: see docs/research/training.md.
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
    # One recipe for all architectures, from random weights and with one head
    # (docs/research/rivals.md). No pairs are mined and few images validate, since that would cost
    # slow networks the most.
    "rivals": _BEST.model_copy(
        update={
            "shape": CapsuleShape(pixels=129),
            "head": "distance",
            "learning_rate": 3e-4,
            "mixed_precision": True,
            "batch": 16,
            "epochs": 16,
            "together": 1,
            "hard_share": 0.0,
            "validation_images": 150,
            "augmentation": _MILD,
        }
    ),
}


def load_settings(path: Path) -> TrainSettings:
    """Read settings in JSON; keys left out keep their defaults.

    Raises:
        InputError: missing file, no JSON, unknown key or value out of range.
    """
    return read_json(TrainSettings, path, "settings")
