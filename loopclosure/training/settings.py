"""The settings of a training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from vslam.config import read_json
from vslam.loopclosure.training.augmentation import STRONG, Augmentation
from vslam.loopclosure.training.branches import CapsuleShape


class TrainSettings(BaseModel):
    """Written to ``settings.json`` of a training, read by ``--settings``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    network: str = Field("capsule", description="Network to train.")
    shape: CapsuleShape = Field(CapsuleShape(), description="Shape of the capsule branch.")
    fit: Literal["squash", "crop"] = Field(
        "squash", description="Whole view, or its middle with the input's aspect ratio."
    )
    seed: int = Field(0, ge=0, description="Seed of weights, division, pairs, augmentation.")
    loss: Literal["bce", "bce+contrast"] = Field("bce", description="Eq. 3, or plus contrast.")
    temperature: float = Field(0.07, gt=0, description="Temperature of the contrast.")
    learning_rate: float = Field(3e-4, gt=0, description="Learning rate of Adam. [paper]")
    extractor_rate: float = Field(1.0, ge=0, description="Factor for the extractor's rate.")
    learned_share: float = Field(
        1.0, gt=0, le=1, description="Share of the change by training; 1 keeps all of it."
    )
    frozen: int = Field(0, ge=0, description="First blocks of lite0 that stay fixed.")
    schedule: Literal["constant", "cosine"] = "constant"
    mixed_precision: bool | None = Field(
        None, description="bfloat16 except for routing; null: if the GPU supports it."
    )
    batch: int = Field(64, ge=2, description="Pairs. [paper]")
    epochs: int = Field(40, ge=1, description="At most.")
    pairs: int = Field(4096, ge=2, description="Pairs per epoch.")
    same_share: float = Field(0.5, gt=0, le=1, description="Share of pairs of one place. [paper]")
    together: int = Field(1, ge=1, description="Consecutive pairs from one source.")
    emphasis: dict[str, Annotated[float, Field(gt=0)]] = Field(
        {}, description="By source: relative frequency of its images; default 1."
    )
    patience: int = Field(6, ge=1, description="Epochs without a better validation AP.")
    hard_share: float = Field(0.5, ge=0, le=1, description="Share of mined pairs of two places.")
    mined_images: int = Field(4000, ge=2, description="Images embedded for mining, at most.")
    validation_share: float = Field(0.15, gt=0, lt=1, description="Share of each source's units.")
    validation_images: int = Field(800, ge=2, description="At most.")
    augmentation: Augmentation = Augmentation()
    prune_share: float = Field(
        0.2, gt=0, lt=1, description="Share of the capsules that pruning removes. [paper]"
    )
    prune_iterations: int | None = Field(
        None, ge=1, description="Routing iterations after pruning; null: unchanged."
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
    # As in the paper, except for augmentation strengths and mining, which it does not give.
    "paper": TrainSettings(),
    # Every image of a batch is compared with every other, under stronger changes. Most pairs show
    # one place, since the contrast uses the other places in the batch. Half of a batch is from one
    # source, because other places look most similar there. Small batches, short epochs and little
    # mining and validation suit the two cores on which it was trained.
    "best": _BEST,
    # The same from ImageNet weights (--weights). Filters for edges and corners stay fixed, and the
    # rest of the extractor learns slowly. For the 129 pixels see docs/research/training.md.
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
    """Read settings in JSON; keys left out keep their defaults.

    Raises:
        InputError: the file is missing or not JSON, a key is unknown, or a value is out of range.
    """
    return read_json(TrainSettings, path, "settings")
