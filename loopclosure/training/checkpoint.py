"""Checkpoints of a training."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from pydantic import ValidationError

from vslam.errors import InputError, ResultsError
from vslam.loopclosure.training.data import Pairs
from vslam.loopclosure.training.settings import TrainSettings
from vslam.loopclosure.training.siamese import SiameseNetwork

CHECKPOINT = "checkpoint.pt"


@dataclass
class TrainingProgress:
    """Where a training stands: what a checkpoint holds beside weights and moments."""

    epoch: int = 0
    step: int = 0
    best: float = -1.0
    stale: int = 0
    loss_sum: float = 0.0
    seconds: float = 0.0
    images: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


def save_checkpoint(
    path: Path,
    settings: TrainSettings,
    network: SiameseNetwork,
    optimiser: torch.optim.Optimizer,
    progress: TrainingProgress,
    pairs: Pairs | None,
) -> None:
    """Write everything that a killed training goes on from.

    Args:
        pairs: of the epoch that is under way; None between two.

    Raises:
        ResultsError: the file cannot be written; the one before it stays.
    """
    content = {
        "settings": settings.model_dump_json(),
        "network": network.state_dict(),
        "optimiser": optimiser.state_dict(),
        "progress": vars(progress),
        "pairs": None if pairs is None else [torch.from_numpy(x) for x in vars(pairs).values()],
    }
    temporary = path.with_suffix(".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.save(content, temporary)
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        raise ResultsError(f"{path}: the checkpoint cannot be written ({error}).") from error


def load_checkpoint(
    path: Path,
    settings: TrainSettings,
    network: SiameseNetwork,
    optimiser: torch.optim.Optimizer,
) -> tuple[TrainingProgress, Pairs | None]:
    """Read one into the network and the optimiser; the pairs are those of the epoch under way.

    Raises:
        InputError: damaged, or written by another version or with other settings.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        written = TrainSettings.model_validate_json(content["settings"])
    except ValidationError as error:
        raise InputError(f"{path}: of another version of vslam; use another --out.") from error
    except Exception as error:  # torch raises half a dozen kinds
        raise InputError(f"{path}: not a readable checkpoint; remove it to start anew.") from error
    # A lower learning rate is what a diverged training is resumed with; what is done at its end may
    # be decided there.
    free = {key: getattr(settings, key) for key in ("learning_rate", "patience", "learned_share")}
    if written.model_copy(update=free) != settings:
        raise InputError(
            f"{path}: written with other settings; use those of settings.json beside it, or "
            "another --out."
        )
    try:
        network.load_state_dict(content["network"])
        optimiser.load_state_dict(content["optimiser"])
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{path}: of another network, or of another version of vslam; use another --out."
        ) from error
    stored = content["pairs"]
    pairs = None if stored is None else Pairs(*(x.numpy() for x in stored))
    return TrainingProgress(**content["progress"]), pairs
