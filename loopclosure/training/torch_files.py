"""Weight files of PyTorch (``.pth``), which a training can start from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from vslam.errors import InputError


def read_pth(path: Path, fix: str) -> Any:
    """Read a weight file of PyTorch without executing anything in it.

    Args:
        fix: advice for the error message.

    Raises:
        InputError: the file is missing or not a weight file.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds of errors
        raise InputError(f"{path}: not a readable weight file; {fix}.") from error
