"""Prunes a network: removes the primary capsules with the lowest coupling coefficients.

Zhou and Sun (Sci Rep 15, 7644, 2025) set the matrices of the 20 % of the primary capsules with the
lowest coupling coefficients to 0. Zeros do not make the network faster. Therefore, this module
removes the capsules from the network.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable

import torch
from torch import Tensor

from vslam.support.errors import InputError
from vslam_lab.training.branches import CapsuleBranch
from vslam_lab.training.siamese import SiameseNetwork


@torch.no_grad()
def mean_couplings(network: SiameseNetwork, batches: Iterable[Tensor]) -> Tensor:
    """Compute the ``(T, K)`` activity of the primary capsules: the mean of the coupling
    coefficients c_ij of capsule i over all images and all output capsules j.

    Args:
        network: the network, which must be in eval mode.
        batches: batches of training images, ``(N, 3, H, W)`` each.
    """
    branch = network.branch
    total, count = None, 0
    for images in batches:
        c = branch.routed(images)[1]
        summed = c.mean(1).sum(0)
        total = summed if total is None else total + summed
        count += len(c)
    if total is None:
        raise InputError(
            "pruning: there are no images to rank the capsules with; give training data."
        )
    return (total / count).view(branch.shape.types, -1)


def lowest(activity: Tensor, fraction: float = 0.2) -> Tensor:
    """Select the least active ``fraction`` of the primary capsules of each type. Returns a
    ``(T, K)`` bool mask.

    Zhou and Sun (2025) do not say how many capsules they remove from each type. This function
    selects the same number for all types, so that a single dense matrix product can still compute
    all types together. If capsules have equal activity, the capsule with the lower index is
    selected first.
    """
    dropped = round(fraction * activity.shape[1])
    order = torch.argsort(activity, dim=1, stable=True)
    out = torch.zeros_like(activity, dtype=torch.bool)
    return out.scatter_(1, order[:, :dropped], True)


def pruned(network: SiameseNetwork, drop: Tensor, name: str = "capsule-pruned") -> SiameseNetwork:
    """Copy a network without the primary capsules ``drop``, ``(T, K)`` bool. The number of removed
    capsules must be the same for each type.

    Args:
        name: name of the copy, one of ``PRUNED``.
    """
    branch = network.branch
    layer = branch.capsules
    kept = (~drop).nonzero()[:, 1].view(len(drop), -1)
    shape = branch.shape.model_copy(update={"kept": kept.shape[1]})
    smaller = SiameseNetwork(name, CapsuleBranch(shape), copy.deepcopy(network.head))
    state = network.state_dict()
    prefix = "branch.capsules."
    rows = kept[:, :, None].expand(-1, -1, layer.gains.shape[2])
    state[prefix + "gains"] = torch.gather(layer.gains.detach(), 1, rows)
    state[prefix + "place"] = torch.gather(layer.place, 1, kept)
    state[prefix + "alive"] = layer.alive.view(len(drop), -1).gather(1, kept).flatten()
    smaller.load_state_dict(state)
    return smaller.to(layer.W.device).train(network.training)


def with_iterations(network: SiameseNetwork, iterations: int) -> SiameseNetwork:
    """Copy a network and give the copy a different number of routing iterations. Zhou and Sun
    (2025) do not do this."""
    copied = copy.deepcopy(network)
    branch = copied.branch
    branch.shape = branch.shape.model_copy(update={"iterations": iterations})
    branch.capsules.iterations = iterations
    return copied
