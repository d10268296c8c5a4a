"""What an ONNX file of somebody else may ask of this machine.

A graph of a few hundred bytes can loop for ever, or make tensors of any size, and ONNX Runtime sets
no limit. The graphs of vslam have a few dozen operators, and all sizes follow from those of the
inputs: what else there is in a file is refused before it runs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import onnx
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, numpy_helper, shape_inference
from onnx.reference import ReferenceEvaluator

MOST_NUMBERS = 2**27
"""That a graph computes, all tensors together; those of VGG-16 are 104 million."""
MOST_PRODUCTS = 2**38
"""Of all convolutions and matrix products of a graph."""
_MOST_NODES = 10_000
_SMALL = 64  # numbers of a tensor that is a shape, or a part of one
_SIDE = 512  # of an image, where a graph takes any size; descriptors compared, likewise

# Those that the networks of vslam have. None holds a graph of its own.
_OPERATORS = {
    "Abs", "Add", "AveragePool", "Cast", "Clip", "Concat", "Conv", "Div", "Exp", "Expand", "Gather",
    "Gemm", "Greater", "GridSample", "LeakyRelu", "MatMul", "Max", "MaxPool", "Mul", "Pad", "Pow",
    "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceSum", "Relu", "Reshape",
    "ScatterElements", "Shape", "Sigmoid", "Slice", "Split", "Sqrt", "Squeeze", "Sub", "Transpose",
    "Unsqueeze",
}  # fmt: skip
_OF_SHAPES = {"Add", "Cast", "Concat", "Div", "Mul", "Reshape", "Shape", "Squeeze", "Sub"}
_KINDS = {
    TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.UINT8, TensorProto.INT32,
    TensorProto.INT64, TensorProto.BOOL,
}  # fmt: skip


def check_graph(file: bytes) -> None:
    """Refuse a graph of operators that vslam does not use, or beyond the limits.

    Args:
        file: its bytes.

    Raises:
        ValueError: in a few words why.
    """
    try:
        model = onnx.load_model_from_string(file)
    except Exception as error:  # protobuf has kinds of its own
        raise ValueError("not a readable ONNX file") from error
    graph = model.graph
    _check_nodes(model)
    for tensor in graph.initializer:
        if math.prod(tensor.dims) > tensor.ByteSize():
            raise ValueError("its weights are not in it")
        is_weight = tensor.data_type in (TensorProto.FLOAT, TensorProto.FLOAT16)
        if is_weight and math.prod(tensor.dims) > _SMALL:  # only the shape matters from here on
            tensor.CopyFrom(
                TensorProto(name=tensor.name, data_type=tensor.data_type, dims=tensor.dims)
            )
    try:
        shapes = _shapes(model)
        computed = {name for node in graph.node for name in node.output if name}
        numbers = sum(math.prod(shapes[name]) for name in computed)
        products = sum(_products(node, shapes) for node in graph.node)
    except Exception as error:  # of onnx, and KeyError where there is no shape
        raise ValueError("the sizes of its tensors are unknown") from error
    if numbers > MOST_NUMBERS or products > MOST_PRODUCTS:
        raise ValueError(f"it asks for {numbers:.1e} numbers and {products:.1e} products")


def _check_nodes(model: ModelProto) -> None:
    graph = model.graph
    if len(graph.node) > _MOST_NODES or model.functions or graph.sparse_initializer:
        raise ValueError("not a graph as vslam writes them")
    for node in graph.node:
        if node.domain or node.op_type not in _OPERATORS:
            raise ValueError(f"vslam uses no operator {node.op_type[:40]!r}")


def _shapes(model: ModelProto) -> dict[str, tuple[int, ...]]:
    """Of all tensors, whatever the file itself says of those between input and output.

    Raises:
        Exception: they do not follow from those of the inputs, or are of another kind.
    """
    graph = model.graph
    for value in graph.input:
        for length in value.type.tensor_type.shape.dim:
            if not length.HasField("dim_value"):
                length.dim_value = _SIDE
    _compute_shapes(graph)
    del graph.value_info[:]
    for value in graph.output:
        value.type.tensor_type.ClearField("shape")
    inferred: GraphProto = shape_inference.infer_shapes(
        model, check_type=True, strict_mode=True, data_prop=True
    ).graph
    shapes = {tensor.name: tuple(tensor.dims) for tensor in graph.initializer}
    for value in (*inferred.input, *inferred.value_info, *inferred.output):
        kind = value.type.tensor_type
        if kind.elem_type not in _KINDS or not kind.HasField("shape"):
            raise ValueError(value.name)
        if not all(length.dim_value > 0 for length in kind.shape.dim):
            raise ValueError(value.name)
        shapes[value.name] = tuple(length.dim_value for length in kind.shape.dim)
    return shapes


def _compute_shapes(graph: GraphProto) -> None:
    """Replace what follows from the shape of an input by its value: onnx does not divide."""
    known = {
        tensor.name: numpy_helper.to_array(tensor)
        for tensor in graph.initializer
        if math.prod(tensor.dims) <= _SMALL
    }
    images = {
        value.name: np.broadcast_to(
            np.uint8(0), [length.dim_value for length in value.type.tensor_type.shape.dim]
        )
        for value in graph.input
    }
    for node in list(graph.node):
        there = images if node.op_type == "Shape" else known
        if node.op_type not in _OF_SHAPES or not all(name in there for name in node.input):
            continue
        given = {name: there[name] for name in node.input}
        (result,) = ReferenceEvaluator(node).run(None, given)
        value = np.asarray(result)
        if value.size <= _SMALL:
            known[node.output[0]] = value
            graph.initializer.append(numpy_helper.from_array(value, node.output[0]))
            graph.node.remove(node)


def _products(node: NodeProto, shapes: dict[str, Any]) -> int:
    """Multiplications of a node beyond a few for each number of its result."""
    if node.op_type == "Conv":
        return math.prod(shapes[node.output[0]]) * math.prod(shapes[node.input[1]][1:])
    if node.op_type in ("MatMul", "Gemm"):
        return math.prod(shapes[node.output[0]]) * max(shapes[node.input[0]][-2:])
    return 0
