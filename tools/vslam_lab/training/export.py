"""Exports a trained network as one ONNX file, for vslam and for programs in other languages."""

from __future__ import annotations

import base64
import copy
import json
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from vslam.loopclosure.siamese.inference import (
    ABOUT,
    COMPARISON,
    FORMAT,
    NAME,
    VERSION,
    OnnxNetwork,
)
from vslam.support.errors import ResultsError, write_file
from vslam_lab.training.siamese import SiameseNetwork, for_inference

TOLERANCE = 1e-4  # largest accepted difference from torch in a descriptor of norm 1
SIMILARITY_TOLERANCE = 0.02  # large: the square root magnifies rounding at small distances
_SMALL = 64  # half precision saves nothing for tensors with fewer elements


class _Embedding(nn.Module):
    """A module that computes the ``(D,)`` descriptor of a grey ``(H, W)`` uint8 image."""

    def __init__(self, network: SiameseNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        grey = image.float() / 255.0
        return self.network.embed(grey.expand(1, 3, -1, -1))[0]


class _Comparison(nn.Module):
    """A module that computes the ``(N,)`` similarities of a query image to N gallery images.

    The inputs are the ``(V, d)`` descriptors of the V views of the query image, the ``(N, V, d)``
    descriptors of the views of the gallery images, and the ``(N, V)`` lengths of the gallery
    descriptors.
    """

    def __init__(self, network: SiameseNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, query: Tensor, gallery: Tensor, lengths: Tensor) -> Tensor:
        return torch.sigmoid(self.network.head.compare(query, gallery, lengths))


def export_onnx(network: SiameseNetwork, path: Path, about: dict[str, Any] | None = None) -> float:
    """Write a network as one ONNX file, in the format that :class:`inference.OnnxNetwork` reads.

    The main graph maps ``image`` to ``descriptor``. The input is a grey ``(H, W)`` uint8 image of
    the size that the network needs. The output is a ``(D,)`` float32 descriptor of norm 1.

    The metadata of the file contains a second graph in base64, which compares a query image with N
    gallery images. This graph computes ``similarity``, ``(N,)``, from three inputs. ``query``,
    ``(V, d)``, and ``gallery``, ``(N, V, d)``, are the descriptors of the V views of each image,
    with ``V d = D``. ``lengths``, ``(N, V)``, are the lengths of the descriptors in ``gallery``.

    Args:
        about: description of the origin of the weights.

    Returns:
        The largest absolute difference between the descriptors that torch and ONNX Runtime compute
        for random images.

    Raises:
        ResultsError: the file cannot be written, or ONNX Runtime and torch give different results.
    """
    parameters = network.n_parameters()
    network = for_inference(copy.deepcopy(network).cpu())
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, *network.size), np.uint8)
    examples = [torch.from_numpy(image) for image in images]
    with torch.no_grad():
        expected = torch.stack([_Embedding(network)(image) for image in examples])
        # An image is not compared with itself: at distance 0, only rounding would be compared.
        alike = network.compare(expected[0], expected[1:]).numpy()
    embedding = to_onnx(_Embedding(network), (examples[0],), ["image"], ["descriptor"])
    any_number = torch.export.Dim("N")
    by_view = expected.view(len(expected), network.branch.views, -1)
    comparison = to_onnx(
        _Comparison(network), (by_view[0], by_view, torch.linalg.vector_norm(by_view, dim=2)),
        ["query", "gallery", "lengths"], ["similarity"],
        dynamic_shapes={"query": None, "gallery": {0: any_number}, "lengths": {0: any_number}},
    )  # fmt: skip
    metadata = {
        FORMAT: VERSION,
        NAME: network.name,
        ABOUT: json.dumps({**(about or {}), "parameters": parameters}),
        COMPARISON: base64.b64encode(comparison.SerializeToString()).decode(),
    }
    write_onnx(embedding, path, metadata)
    written = OnnxNetwork(path)
    descriptors = np.stack([written.embed(image) for image in images])
    difference = float(np.abs(descriptors - expected.numpy()).max())
    apart = float(np.abs(written.compare(descriptors[0], descriptors[1:]) - alike).max())
    if not (difference < TOLERANCE and apart < SIMILARITY_TOLERANCE):
        path.unlink()
        raise ResultsError(
            f"{path}: not kept, because its descriptors differ from torch by {difference:.1e} and "
            f"its similarities by {apart:.1e}; train longer, or report it."
        )
    return difference


def to_onnx(
    module: nn.Module, inputs: tuple[Tensor, ...], names: list[str], outputs: list[str],
    dynamic_shapes: Any = None,
) -> onnx.ModelProto:  # fmt: skip
    """Convert a torch module to an ONNX graph. A tensor is stored in half precision if no precision
    is lost."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # hides warnings about missing torchvision and renamed inputs
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                module.eval(), inputs, input_names=names, output_names=outputs, dynamo=True,
                dynamic_shapes=dynamic_shapes, external_data=False, verbose=False,
            )  # fmt: skip
    finally:
        log.setLevel(level)
    assert program is not None
    model = program.model_proto
    _halve(model.graph)
    for node in model.graph.node:  # the metadata contains file paths of this machine
        del node.metadata_props[:]
    del model.graph.metadata_props[:]
    return model


def write_onnx(model: onnx.ModelProto, path: Path, metadata: dict[str, str]) -> None:
    helper.set_model_props(model, metadata)
    write_file(path, model.SerializeToString())


def _halve(graph: onnx.GraphProto) -> None:
    """Store the tensors of a graph in half precision if no precision is lost. Nodes that convert
    these tensors back to single precision are added to the graph."""
    casts = []
    for tensor in graph.initializer:
        if tensor.data_type != TensorProto.FLOAT:
            continue
        values = numpy_helper.to_array(tensor)
        half = values.astype(np.float16)
        if values.size < _SMALL or not np.array_equal(half.astype(np.float32), values):
            continue
        name, stored = tensor.name, f"{tensor.name}.half"
        tensor.CopyFrom(numpy_helper.from_array(half, stored))
        casts.append(helper.make_node("Cast", [stored], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
