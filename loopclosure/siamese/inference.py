"""Trained networks in ONNX Runtime, on one thread: what runs use. torch is not imported."""

from __future__ import annotations

import base64
import json
from functools import cached_property
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.loopclosure.siamese.images import Size
from vslam.loopclosure.siamese.weights import SHIPPED, find_weights

# Keys of the metadata.
FORMAT, NAME, ABOUT, COMPARISON = "vslam", "name", "about", "comparison"
VERSION = "1"  # of the format
_NO_RUNTIME = "learned loop detectors need ONNX Runtime: pip install onnxruntime."


_FOREIGN = "not a network of this version of vslam"
_FIX = "write one with 'vslam export onnx', or name another file"


class OnnxNetwork:
    """A network that ``vslam export onnx`` wrote: images to descriptors, and what compares them.

    Attributes:
        name: one of ``NETWORKS``.
        size: height and width of the images it takes.
        dimensions: D of its descriptors.
        fingerprint: of the file.
        about: what the weights were made of; ``parameters``, numbers learned.
    """

    def __init__(self, path: Path) -> None:
        """Load it.

        Raises:
            InputError: missing, damaged or foreign file, or no ONNX Runtime.
        """
        self._embedding = open_session(path, path, "image")
        metadata = self._embedding.get_modelmeta().custom_metadata_map
        if metadata.get(FORMAT) != VERSION:
            raise InputError(f"{path}: {_FOREIGN}; {_FIX}.")
        self.fingerprint = fingerprint_of(path)
        try:
            comparison = base64.b64decode(metadata[COMPARISON])
            self._comparison = open_session(path, comparison, "query")
            compared = self._comparison.get_inputs()
            self._views = tuple(compared[0].shape)
            self._compared = [one.name for one in compared]
            self.name: str = metadata[NAME]
            self.about: dict[str, Any] = json.loads(metadata[ABOUT])
            height, width = self._embedding.get_inputs()[0].shape
            self.size: Size = (height, width)
            self.dimensions: int = self._embedding.get_outputs()[0].shape[0]
            if path.parent != SHIPPED:
                blank = self.embed(np.zeros(self.size, np.uint8))
                self.compare(blank, blank[None])
                self.about["parameters"] + 0
        except InputError:
            raise
        except Exception as error:  # what a file may lack, and a dozen kinds of onnxruntime
            raise InputError(f"{path}: {_FOREIGN}; {_FIX}.") from error

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Descriptor ``(D,)`` of norm 1 of a grey image ``(H, W)`` of the network's size."""
        (descriptor,) = self._embedding.run(None, {"image": image})
        return np.asarray(descriptor, np.float32)

    def compare(
        self, query: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Probability ``(N,)`` in (0, 1) that a descriptor ``(D,)`` and each of ``(N, D)`` show
        one place."""
        views = gallery.reshape(-1, *self._views)
        # onnxruntime takes four times as long for the lengths as NumPy.
        lengths = np.sqrt(np.einsum("nvd,nvd->nv", views, views))
        given = {"query": query.reshape(self._views), "gallery": views, "lengths": lengths}
        (similarity,) = self._comparison.run(None, {name: given[name] for name in self._compared})
        return np.asarray(similarity, np.float32)


class LateNetwork:
    """A network that is loaded when the first image comes: most of a drive never needs it.

    Attributes:
        name, fingerprint: as of :class:`OnnxNetwork`.
    """

    def __init__(self, name: str) -> None:
        """The network of that name that vslam ships.

        Raises:
            InputError: unknown name, no weights shipped, or ONNX Runtime is not installed.
        """
        if find_spec("onnxruntime") is None:
            raise InputError(_NO_RUNTIME)
        self.name = name
        self.fingerprint = fingerprint_of(find_weights(name, None))

    @cached_property
    def _loaded(self) -> OnnxNetwork:
        return open_network(self.name)

    @property
    def size(self) -> Size:
        """See :class:`OnnxNetwork`."""
        return self._loaded.size

    @property
    def dimensions(self) -> int:
        """See :class:`OnnxNetwork`."""
        return self._loaded.dimensions

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """See :class:`OnnxNetwork`."""
        return self._loaded.embed(image)

    def compare(
        self, query: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """See :class:`OnnxNetwork`."""
        return self._loaded.compare(query, gallery)


def fingerprint_of(path: Path) -> str:
    """What tells the weights of a file from all others."""
    return sha256(path.read_bytes()).hexdigest()[:16]


def open_network(name: str, weights: Path | None = None) -> OnnxNetwork:
    """The network of that name.

    Args:
        name: one of ``NETWORKS``.
        weights: ONNX file; None for the one that vslam ships.

    Raises:
        InputError: unknown name, no weights, or weights of another network.
    """
    path = find_weights(name, weights)
    network = OnnxNetwork(path)
    if network.name != name:
        raise InputError(f"{path}: weights of {network.name}, not of {name}; name another file.")
    return network


def open_session(path: Path, model: Path | bytes, first_input: str) -> Any:
    """An ``onnxruntime.InferenceSession`` on one thread: its sums, and so its bits, do not depend
    on the number of cores.

    Args:
        path: of the file, for the message.
        model: the file, or its bytes.
        first_input: name of the first input, without which it is no graph of ours.

    Raises:
        InputError: it cannot be read, is no such graph, or ONNX Runtime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(_NO_RUNTIME) from error
    try:
        given = model if isinstance(model, bytes) else model.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the weights cannot be read ({error.strerror}).") from error
    if path.parent != SHIPPED:
        _refuse_beyond_limits(path, given)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what it says of damaged files is in the exception, too
    options.enable_mem_pattern = False  # it saves no time here, and takes 10 MB
    options.enable_cpu_mem_arena = False  # activations are given back after each image
    try:
        session = onnxruntime.InferenceSession(given, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a dozen kinds
        raise InputError(f"{path}: not a readable ONNX file; name another file.") from error
    if [one.name for one in session.get_inputs()][:1] != [first_input]:
        raise InputError(f"{path}: {_FOREIGN}; {_FIX}.")
    return session


def _refuse_beyond_limits(path: Path, file: bytes) -> None:
    try:
        from vslam.loopclosure.siamese.onnx_limits import check_graph
    except ImportError as error:
        raise InputError(
            f"{path}: weights that vslam does not ship are checked by the package onnx, which is "
            "not installed; pip install 'vslam[train]'."
        ) from error
    try:
        check_graph(file)
    except ValueError as error:
        raise InputError(f"{path}: {_FOREIGN} ({error}); {_FIX}.") from error
