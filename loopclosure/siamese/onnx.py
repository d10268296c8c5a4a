"""ONNX of a branch, for programs in other languages (the paper deploys in C++)."""

from __future__ import annotations

import copy
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from vslam.errors import InputError, ResultsError
from vslam.loopclosure.siamese.siamese import SiameseNetwork, for_inference

TOLERANCE = 1e-4  # of a descriptor of length 1


def export_onnx(network: SiameseNetwork, path: Path) -> float:
    """Write image ``(1, 3, H, W)`` float32 in [0, 1] to ``descriptor`` ``(1, D)`` of norm 1.

    It holds those of all views; :func:`siamese.cosines` compares them.

    Returns:
        The largest difference between torch and onnxruntime on a random image.

    Raises:
        InputError: the packages of the extra ``export`` are not installed.
        ResultsError: the file cannot be written, or says something else than torch.
    """
    if missing := [name for name in ("onnx", "onnxscript", "onnxruntime") if not find_spec(name)]:
        raise InputError(
            f"vslam export: {', '.join(missing)} not installed; pip install 'vslam[export]'."
        )
    import onnxruntime

    network = for_inference(copy.deepcopy(network).cpu())
    torch.manual_seed(0)
    image = torch.rand(1, 3, *network.size)
    try:
        torch.onnx.export(
            network, (image,), str(path), input_names=["image"], output_names=["descriptor"],
            dynamo=True, external_data=False, verbose=False,
        )  # fmt: skip
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written ({error.strerror}).") from error
    (descriptor,) = session.run(None, {"image": image.numpy()})
    with torch.no_grad():
        expected = network.embed(image).numpy()
    difference = float(np.abs(np.asarray(descriptor) - expected).max())
    if not difference < TOLERANCE:
        raise ResultsError(f"{path}: differs from torch by {difference:.1e}; do not use it.")
    return difference
