"""A Siamese network: one branch for both images, and a head that compares their descriptors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.support.errors import InputError, write_file
from vslam_lab.training.branches import CapsuleBranch, CapsuleShape
from vslam_lab.training.capsules import TINY
from vslam_lab.training.extractors import fold_batch_norms

_SOFTNESS = 0.04  # temperature of the soft maximum over alignments, in units of cosine similarity


def aligned(alike: Tensor, most: Tensor) -> Tensor:
    """Compute the cosine similarity of two images after the best horizontal alignment of their
    views.

    An image is divided into views from left to right, and each view has a descriptor. After a
    rotation of the camera, an object appears in a different view. Therefore, the views of one image
    are shifted to the left or right, by up to half the number of views. For each shift, a cosine
    similarity is computed from the views that overlap.

    The result is the soft maximum of these similarities, because two shifts may fit about equally
    well. The result can slightly exceed 1. Zhou and Sun (2025) compare only whole images.

    Args:
        alike: ``(..., V, V)`` scalar products of the descriptors of views. Element ``[..., i, j]``
            belongs to view i of one image and view j of the other image.
        most: ``(..., V, V)`` products of the lengths of the same two descriptors.
    """
    views = alike.shape[-1]
    v = torch.arange(views, device=alike.device)
    shifts = torch.arange(-(views // 2), views // 2 + 1, device=alike.device)
    overlap = (v[None, :] - v[:, None] == shifts[:, None, None]).to(alike.dtype).flatten(1).T
    cosine = (alike.flatten(-2) @ overlap) / (most.flatten(-2) @ overlap + TINY)
    return _SOFTNESS * torch.logsumexp(cosine / _SOFTNESS, -1)


def cosines(a: Tensor, b: Tensor, views: int = 1) -> Tensor:
    """Compute the ``(N, M)`` cosine similarities of ``(N, D)`` descriptors and ``(M, D)``
    descriptors. If the images have several views, the views are first aligned (:func:`aligned`)."""
    if views == 1:
        return a @ b.T
    a, b = _by_view(a, views), _by_view(b, views)
    # b comes first, because it may contain the thousands of keyframes of a map.
    alike = (b.flatten(0, 1) @ a.flatten(0, 1).T).view(len(b), views, len(a), views)
    most = _lengths(a)[:, None, :, None] * _lengths(b)[None, :, None, :]
    return aligned(alike.permute(2, 0, 3, 1), most)


def _by_view(descriptors: Tensor, views: int) -> Tensor:
    """Split ``(N, V D)`` descriptors of images into the ``(N, V, D)`` descriptors of their V
    views."""
    return descriptors.view(len(descriptors), views, descriptors.shape[1] // views)


def _lengths(views: Tensor) -> Tensor:
    """Compute the ``(N, V)`` lengths of the ``(N, V, D)`` descriptors of views."""
    return torch.linalg.vector_norm(views, dim=2)


class DistanceHead(nn.Module):
    """Computes the probability p that two images show the same place from the distance d of their
    descriptors: ``p = sigmoid(a - b d)`` with a, b > 0 (equations 2 and 10 of Zhou and Sun, 2025).

    If the images have several views, the views are first aligned (:func:`aligned`).
    """

    def __init__(self, views: int = 1) -> None:
        super().__init__()
        self.views = views
        # At d = 1.1, p is 0.5. With random weights, this separates the same place from different
        # places.
        self.log_a = nn.Parameter(torch.tensor(1.5))
        self.log_b = nn.Parameter(torch.tensor(1.4))

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the ``(N,)`` logits of N pairs of descriptors of norm 1. Both arguments are
        ``(N, D)``."""
        a, b = _by_view(a, self.views), _by_view(b, self.views)
        most = _lengths(a)[:, :, None] * _lengths(b)[:, None]
        return self.of_cosine(aligned(a @ b.transpose(1, 2), most))

    def of_cosine(self, cosine: Tensor) -> Tensor:
        """Compute logits from the cosine similarities of descriptors of norm 1. The distance of two
        such descriptors is ``sqrt(2 - 2 cos)``."""
        d = torch.sqrt((2.0 - 2.0 * cosine).clamp_min(0.0) + TINY)
        return self.log_a.exp() - self.log_b.exp() * d

    def compare(self, query: Tensor, gallery: Tensor, lengths: Tensor) -> Tensor:
        """Compare an image with a gallery of M images, using a single matrix product.

        Args:
            query: ``(V, d)`` descriptors of the views of the image.
            gallery: ``(M, V, d)`` descriptors of the views of M images.
            lengths: ``(M, V)`` lengths of the descriptors in ``gallery``.

        Returns:
            ``(M,)`` logits of the probabilities that two images show the same place.
        """
        alike = (gallery @ query.T).transpose(1, 2)
        most = _lengths(query[None])[:, :, None] * lengths[:, None]
        return self.of_cosine(aligned(alike, most))


class SiameseNetwork(nn.Module):
    """A capsule branch that computes descriptors, and a head that compares them.

    Attributes:
        name: one of ``NETWORKS``.
        size: height and width of the input images.
        dimensions: dimension D of the descriptors.
    """

    def __init__(self, name: str, branch: CapsuleBranch, head: DistanceHead) -> None:
        super().__init__()
        self.name, self.branch, self.head = name, branch, head
        self.size, self.dimensions = branch.size, branch.dimensions

    def embed(self, images: Tensor) -> Tensor:
        """Compute ``(N, D)`` float32 descriptors of norm 1 from ``(N, 3, H, W)`` float32 images in
        [0, 1]."""
        return functional.normalize(self.branch(images).float(), dim=1)

    def cosines(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the ``(N, M)`` cosine similarities of ``(N, D)`` descriptors and ``(M, D)``
        descriptors, after the views of the images are aligned (:func:`aligned`)."""
        return cosines(a, b, self.branch.views)

    def logits(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the ``(N,)`` logits of the probabilities that ``similarity`` returns. The
        training loss is computed from the logits."""
        return self.head(a, b)

    def similarity(self, a: Tensor, b: Tensor) -> Tensor:
        """Compute the ``(N,)`` probabilities, in (0, 1), that two images show the same place, for N
        pairs of descriptors. Both arguments are ``(N, D)``."""
        return torch.sigmoid(self.head(a, b))

    def compare(self, query: Tensor, gallery: Tensor) -> Tensor:
        """Compute the ``(M,)`` probabilities that a query image and each of M gallery images show
        the same place. ``query`` is a ``(D,)`` descriptor, and ``gallery`` contains ``(M, D)``
        descriptors."""
        by_view = _by_view(gallery, self.branch.views)
        query = _by_view(query[None], self.branch.views)[0]
        return torch.sigmoid(self.head.compare(query, by_view, _lengths(by_view)))

    def forward(self, images: Tensor) -> Tensor:
        return self.embed(images)

    def n_parameters(self) -> int:
        return sum(p.numel() for p in self.parameters())


def build_network(name: str, shape: CapsuleShape | None = None) -> SiameseNetwork:
    """Create a network with random weights from torch's global random generator.

    Args:
        name: one of ``NETWORKS``.
        shape: structure of the capsule branch. None gives the structure of Zhou and Sun (2025).
    """
    if name not in NETWORKS:
        raise InputError(f"{name}: no such network; choose one of {', '.join(NETWORKS)}.")
    branch = CapsuleBranch(shape or CapsuleShape())
    return SiameseNetwork(name, branch, DistanceHead(branch.views))


def save_network(
    network: SiameseNetwork, path: Path, about: dict[str, Any], *, half: bool = False
) -> None:
    """Write the weights of a network as safetensors. The metadata contains the structure of the
    network and ``about``.

    Args:
        half: whether the weights are stored in half precision, as for the weights that vslam ships.
    """
    tensors = {
        key: value.detach().half() if half and value.is_floating_point() else value.detach()
        for key, value in network.state_dict().items()
    }
    metadata = {
        "name": network.name,
        "shape": network.branch.shape.model_dump_json(),
        "about": json.dumps(about),
    }
    # Unlike save_file, write_file replaces the file atomically and makes it readable by other
    # users.
    write_file(path, save({k: v.cpu().contiguous() for k, v in tensors.items()}, metadata))


def load_network(path: Path) -> tuple[SiameseNetwork, dict[str, Any]]:
    """Read a network that :func:`save_network` wrote. Returns the network in eval mode, and the
    argument ``about`` of :func:`save_network`.

    Raises:
        InputError: the file is missing, damaged or not from this version of vslam.
    """
    fix = "train it with 'vslam train', or give another file"
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        shape = CapsuleShape.model_validate_json(metadata["shape"])
        network = build_network(metadata["name"], shape)
        wanted = network.state_dict()
        network.load_state_dict({k: v.to(wanted[k].dtype) for k, v in tensors.items()})
        about: dict[str, Any] = json.loads(metadata["about"])
    except OSError as error:
        raise InputError(f"{path}: the weights cannot be read; {fix}.") from error
    except (SafetensorError, KeyError, ValueError, RuntimeError, ValidationError) as error:
        raise InputError(f"{path}: not weights of this version of vslam; {fix}.") from error
    return network.eval(), about


def for_inference(network: SiameseNetwork) -> SiameseNetwork:
    """Prepare a network for inference, in place. The network is set to eval mode, its weights need
    no gradients, and its batch normalisations are folded into the convolutions."""
    network.eval().requires_grad_(False)
    fold_batch_norms(network)
    return network
