"""Writes and reads the checkpoints of a training run."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import torch
from pydantic import ValidationError

from vslam.support.errors import InputError, write_file
from vslam_lab.training.data import Pairs
from vslam_lab.training.settings import TrainSettings
from vslam_lab.training.siamese import SiameseNetwork

CHECKPOINT = "checkpoint.pt"


@dataclass
class TrainingProgress:
    """The progress of a training run. A checkpoint contains the progress, the weights and the
    moments of Adam."""

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
    """Write everything that is needed to resume an interrupted training run.

    Args:
        pairs: the image pairs of the current epoch. None if the checkpoint is written between two
            epochs.

    Raises:
        ResultsError: the file cannot be written. In this case, an existing file is not changed.
    """
    content = {
        "settings": settings.model_dump_json(),
        "network": network.state_dict(),
        "optimiser": optimiser.state_dict(),
        "progress": vars(progress),
        "pairs": None if pairs is None else [torch.from_numpy(x) for x in vars(pairs).values()],
    }
    file = io.BytesIO()
    torch.save(content, file)
    write_file(path, file.getvalue())


def load_checkpoint(
    path: Path,
    settings: TrainSettings,
    network: SiameseNetwork,
    optimiser: torch.optim.Optimizer,
) -> tuple[TrainingProgress, Pairs | None]:
    """Load a checkpoint into the network and the optimiser.

    Returns:
        The progress, and the image pairs of the current epoch. The pairs are None if the checkpoint
        was written between two epochs.

    Raises:
        InputError: the file is damaged, comes from a different version of vslam, or was written
            with different settings.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        written = TrainSettings.model_validate_json(content["settings"])
    except ValidationError as error:
        raise InputError(
            f"{path}: written by another version of vslam; use another --out."
        ) from error
    except Exception as error:  # torch raises many types
        raise InputError(f"{path}: not a readable checkpoint; remove it to start again.") from error
    # The learning rate may change, so that a training run that has diverged can be resumed.
    # Settings that are used only at the end may change as well.
    free = {key: getattr(settings, key) for key in ("learning_rate", "patience", "learned_share")}
    if written.model_copy(update=free) != settings:
        raise InputError(
            f"{path}: written with other settings; use the settings.json beside it, or another "
            "--out."
        )
    try:
        network.load_state_dict(content["network"])
        optimiser.load_state_dict(content["optimiser"])
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{path}: belongs to another network or another version of vslam; use another --out."
        ) from error
    stored = content["pairs"]
    pairs = None if stored is None else Pairs(*(x.numpy() for x in stored))
    return TrainingProgress(**content["progress"]), pairs
