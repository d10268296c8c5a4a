"""Checks that an ONNX file from an untrusted source needs only limited time and memory.

A graph of a few hundred bytes can loop forever or create tensors of any size, and ONNX Runtime sets
no limits. The graphs of vslam use only a few dozen operators, and the sizes of all tensors follow
from the sizes of the inputs. Any other graph is refused before it is run.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import onnx
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, numpy_helper, shape_inference
from onnx.reference import ReferenceEvaluator

MOST_NUMBERS = 2**27
"""Maximum total number of elements in all tensors that a graph computes. For VGG-16, the number is
104 million."""
MOST_PRODUCTS = 2**38
"""Maximum total number of multiplications in all convolutions and matrix products of a graph."""
_MOST_NODES = 10_000
_SMALL = 64  # tensors with more elements cannot be shapes
_SIDE = 512  # assumed size of each input dimension that the graph leaves open

# The operators that the networks of vslam use. None of them contains another graph.
_OPERATORS = {
    "Abs", "Add", "Cast", "Clip", "Concat", "Conv", "Div", "Exp", "Expand", "Gather",
    "Greater", "GridSample", "MatMul", "Max", "Mul", "Pad", "Pow",
    "ReduceL2", "ReduceLogSumExp", "ReduceMax", "ReduceMean", "ReduceSum", "Relu", "Reshape",
    "ScatterElements", "Shape", "Sigmoid", "Slice", "Split", "Sqrt", "Squeeze", "Sub", "Transpose",
    "Unsqueeze",
}  # fmt: skip
# Operators that compute shapes from shapes.
_SHAPE_OPERATORS = {"Add", "Cast", "Concat", "Div", "Mul", "Reshape", "Shape", "Squeeze", "Sub"}
_DTYPES = {
    TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.UINT8, TensorProto.INT32,
    TensorProto.INT64, TensorProto.BOOL,
}  # fmt: skip


def check_graph(file: bytes) -> None:
    """Check that a graph uses only the operators of vslam and stays within the limits.

    Args:
        file: contents of the ONNX file.

    Raises:
        ValueError: the file is not an ONNX file, or its graph is refused. The message gives the
            reason.
    """
    try:
        model = onnx.load_model_from_string(file)
    except Exception as error:  # protobuf raises its own exception types
        raise ValueError("not a readable ONNX file") from error
    graph = model.graph
    _check_nodes(model)
    for tensor in graph.initializer:
        if math.prod(tensor.dims) > tensor.ByteSize():
            raise ValueError("it does not contain its weights")
        is_weight = tensor.data_type in (TensorProto.FLOAT, TensorProto.FLOAT16)
        if is_weight and math.prod(tensor.dims) > _SMALL:  # from here on, only the shape matters
            tensor.CopyFrom(
                TensorProto(name=tensor.name, data_type=tensor.data_type, dims=tensor.dims)
            )
    try:
        shapes = _shapes(model)
        computed = {name for node in graph.node for name in node.output if name}
        numbers = sum(math.prod(shapes[name]) for name in computed)
        products = sum(_products(node, shapes) for node in graph.node)
    except Exception as error:  # errors of onnx, and KeyError for a tensor without a shape
        raise ValueError("the sizes of its tensors are unknown") from error
    if numbers > MOST_NUMBERS or products > MOST_PRODUCTS:
        raise ValueError(
            f"it computes {numbers:.1e} numbers and {products:.1e} products, more than the "
            f"{MOST_NUMBERS:.1e} and {MOST_PRODUCTS:.1e} that are allowed"
        )


def _check_nodes(model: ModelProto) -> None:
    graph = model.graph
    if len(graph.node) > _MOST_NODES or model.functions or graph.sparse_initializer:
        raise ValueError("its graph has too many nodes, functions or sparse weights")
    for node in graph.node:
        if node.domain or node.op_type not in _OPERATORS:
            raise ValueError(f"vslam does not use the operator {node.op_type[:40]!r}")


def _shapes(model: ModelProto) -> dict[str, tuple[int, ...]]:
    """Infer the shapes of all tensors of a graph from the shapes of its inputs. Shapes that the
    file states for other tensors are ignored."""
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
        if kind.elem_type not in _DTYPES or not kind.HasField("shape"):
            raise ValueError(value.name)
        if not all(length.dim_value > 0 for length in kind.shape.dim):
            raise ValueError(value.name)
        shapes[value.name] = tuple(length.dim_value for length in kind.shape.dim)
    return shapes


def _compute_shapes(graph: GraphProto) -> None:
    """Replace the nodes that compute shapes with their results, because the shape inference of onnx
    does not evaluate divisions."""
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
        values = images if node.op_type == "Shape" else known
        if node.op_type not in _SHAPE_OPERATORS or not all(name in values for name in node.input):
            continue
        (result,) = ReferenceEvaluator(node).run(None, {name: values[name] for name in node.input})
        value = np.asarray(result)
        if value.size <= _SMALL:
            known[node.output[0]] = value
            graph.initializer.append(numpy_helper.from_array(value, node.output[0]))
            graph.node.remove(node)


def _products(node: NodeProto, shapes: dict[str, Any]) -> int:
    """Count the multiplications of a convolution or a matrix product. The result is 0 for other
    nodes, because they need only a few operations for each element of their output."""
    if node.op_type == "Conv":
        return math.prod(shapes[node.output[0]]) * math.prod(shapes[node.input[1]][1:])
    if node.op_type == "MatMul":
        return math.prod(shapes[node.output[0]]) * max(shapes[node.input[0]][-2:])
    return 0
