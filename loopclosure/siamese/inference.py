"""Runs trained Siamese networks in ONNX Runtime on a single thread, without torch."""

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

from vslam.loopclosure.siamese.images import Size
from vslam.loopclosure.siamese.weights import SHIPPED, find_weights
from vslam.support.errors import InputError

# Keys of the metadata of an ONNX file.
FORMAT, NAME, ABOUT, COMPARISON = "vslam", "name", "about", "comparison"
VERSION = "1"  # value of FORMAT
_NO_RUNTIME = "learned loop detectors need ONNX Runtime: pip install onnxruntime."
_FOREIGN = "not a network of this version of vslam"
_FIX = "write one with 'vslam export onnx', or give another file"


class OnnxNetwork:
    """A Siamese network, loaded from a file that ``vslam export onnx`` wrote.

    Attributes:
        name: one of ``NETWORKS``.
        size: height and width of its input images.
        dimensions: length D of its descriptors.
        fingerprint: hash of the file.
        about: description of the training of the weights. Its entry ``parameters`` is the number of
            learned parameters.
    """

    def __init__(self, path: Path) -> None:
        """Load the network from an ONNX file.

        Raises:
            InputError: the file is missing, damaged or not a network of vslam, or ONNX Runtime is
                not installed.
        """
        self._embedding = open_session(path, path, "image")
        metadata = self._embedding.get_modelmeta().custom_metadata_map
        if metadata.get(FORMAT) != VERSION:
            raise InputError(f"{path}: {_FOREIGN}; {_FIX}.")
        self.fingerprint = fingerprint_of(path)
        try:
            comparison = base64.b64decode(metadata[COMPARISON])
            self._comparison = open_session(path, comparison, "query")
            self._views = tuple(self._comparison.get_inputs()[0].shape)
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
        except Exception as error:  # missing metadata, or a dozen types raised by onnxruntime
            raise InputError(f"{path}: {_FOREIGN}; {_FIX}.") from error

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Compute the ``(D,)`` float32 descriptor of a uint8 image with the height and width
        ``size``. The descriptor has norm 1."""
        (descriptor,) = self._embedding.run(None, {"image": image})
        return np.asarray(descriptor, np.float32)

    def compare(
        self, query: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Compare a query descriptor ``(D,)`` with N gallery descriptors ``(N, D)``.

        Returns:
            ``(N,)`` probabilities in (0, 1) that the query and each gallery image show the same
            place.
        """
        views = gallery.reshape(-1, *self._views)
        # NumPy computes the lengths four times as fast as onnxruntime does.
        lengths = np.sqrt(np.einsum("nvd,nvd->nv", views, views))
        given = {"query": query.reshape(self._views), "gallery": views, "lengths": lengths}
        (similarity,) = self._comparison.run(None, given)
        return np.asarray(similarity, np.float32)


class LateNetwork:
    """A network that vslam ships, which is loaded only when the first image arrives. Many drives
    never need the network.

    Attributes:
        name, fingerprint: see :class:`OnnxNetwork`.
    """

    def __init__(self, name: str) -> None:
        """Check that the network can be loaded, without loading it.

        Args:
            name: one of ``NETWORKS``.

        Raises:
            InputError: the name is unknown, vslam ships no weights for it, or ONNX Runtime is not
                installed.
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
        return self._loaded.size

    @property
    def dimensions(self) -> int:
        return self._loaded.dimensions

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._loaded.embed(image)

    def compare(
        self, query: NDArray[np.float32], gallery: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        return self._loaded.compare(query, gallery)


def fingerprint_of(path: Path) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a file."""
    return sha256(path.read_bytes()).hexdigest()[:16]


def open_network(name: str, weights: Path | None = None) -> OnnxNetwork:
    """Load a Siamese network by its name.

    Args:
        name: one of ``NETWORKS``.
        weights: ONNX file; None uses the file that vslam ships.

    Raises:
        InputError: the name is unknown, or the weights are missing or belong to a different
            network.
    """
    path = find_weights(name, weights)
    network = OnnxNetwork(path)
    if network.name != name:
        raise InputError(f"{path}: weights of {network.name}, not of {name}; give another file.")
    return network


def open_session(path: Path, model: Path | bytes, first_input: str) -> Any:
    """Open an ``onnxruntime.InferenceSession`` that uses one thread, so that the results do not
    depend on the number of cores.

    Args:
        path: path of the file, for error messages.
        model: the file, or its bytes.
        first_input: expected name of the first input. Graphs whose first input has a different name
            are refused.

    Raises:
        InputError: the file cannot be read, does not contain such a graph, or needs too much time
            or memory, or ONNX Runtime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(_NO_RUNTIME) from error
    try:
        given = model if isinstance(model, bytes) else model.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: the weights cannot be read ({error.strerror}); give another file."
        ) from error
    if path.parent != SHIPPED:
        _check_limits(path, given)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised as exceptions anyway
    options.enable_mem_pattern = False  # it would take 10 MB and save no time here
    options.enable_cpu_mem_arena = False  # so that activations are freed after each image
    try:
        session = onnxruntime.InferenceSession(given, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a dozen types
        raise InputError(f"{path}: not a readable ONNX file; give another file.") from error
    if [one.name for one in session.get_inputs()][:1] != [first_input]:
        raise InputError(f"{path}: {_FOREIGN}; {_FIX}.")
    return session


def _check_limits(path: Path, file: bytes) -> None:
    """Refuse a file from an untrusted source whose graph needs too much time or memory."""
    try:
        from vslam.loopclosure.siamese.onnx_limits import check_graph
    except ImportError as error:
        raise InputError(
            f"{path}: the package onnx, which checks weights that vslam does not ship, is not "
            "installed; run pip install 'vslam[train]'."
        ) from error
    try:
        check_graph(file)
    except ValueError as error:
        raise InputError(f"{path}: {_FOREIGN} ({error}); {_FIX}.") from error
