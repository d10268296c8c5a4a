"""The training losses, and the validation and calibration of a network."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor
from torch.nn import functional

from vslam_lab.precision_recall import balanced_accuracy, summary
from vslam_lab.sources.image_source import DIFFERENT, SAME, UNKNOWN
from vslam_lab.training.augmentation import Augmentation, augment
from vslam_lab.training.data import Collection
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.siamese import SiameseNetwork

_MOST_SAME = 5  # a validation query is compared with at most this many images of its place


def cross_entropy(logits: Tensor, same: Tensor) -> Tensor:
    """Compute the binary cross-entropy from the logits of p (equation 3 of Zhou and Sun, 2025): the
    mean over all pairs of ``-(y log p + (1 - y) log(1 - p))``."""
    return functional.binary_cross_entropy_with_logits(logits, same.to(logits.dtype))


def contrast(alike: Tensor, same: Tensor, relation: Tensor, temperature: float) -> Tensor:
    """Compute the InfoNCE loss (van den Oord et al., 2018) in the symmetric form of CLIP. For each
    pair of images of the same place, this loss compares their similarity with the similarities to
    all images of other places in the batch.

    Zhou and Sun (2025) do not use this loss.

    Args:
        alike: ``(2 N, 2 N)`` cosine similarities of the images of N pairs. The first images of all
            pairs come first, followed by the second images.
        same: ``(N,)`` bool, True for pairs of the same place.
        relation: ``(2 N, 2 N)`` int8 relation of each two of these images. The value is 1 for the
            same place, -1 for different places, and 0 if this is unknown.
    """
    if not bool(same.any()):
        return alike.sum() * 0.0
    n = len(same)
    partner = torch.arange(2 * n, device=alike.device).roll(n)
    alike = alike / temperature
    positive = alike.gather(1, partner[:, None])
    others = alike.masked_fill(relation != DIFFERENT, -torch.inf)
    losses = torch.logsumexp(torch.cat([positive, others], 1), 1) - positive[:, 0]
    return losses[same.repeat(2)].mean()


@torch.no_grad()
def embed_all(
    network: SiameseNetwork, images: NDArray[np.uint8], device: torch.device, batch: int = 64
) -> NDArray[np.float32]:
    """Compute the ``(N, D)`` descriptors of ``(N, H, W)`` uint8 images. The network is set to eval
    mode."""
    network.eval()
    parts = [
        network.embed(to_tensor(images[k : k + batch]).to(device)).cpu()
        for k in range(0, len(images), batch)
    ]
    return torch.cat(parts).numpy()


@torch.no_grad()
def score_matrix(
    network: SiameseNetwork,
    queries: NDArray[np.float32],
    gallery: NDArray[np.float32],
    device: torch.device,
) -> NDArray[np.float32]:
    """Compute the ``(Q, M)`` similarities of ``(Q, D)`` query descriptors and ``(M, D)`` gallery
    descriptors."""
    network.eval()
    all_images = torch.from_numpy(gallery).to(device)
    rows = [network.compare(q, all_images).cpu() for q in torch.from_numpy(queries).to(device)]
    return torch.stack(rows).numpy()


def validate(
    network: SiameseNetwork,
    collection: Collection,
    chosen: NDArray[np.int64],
    strength: Augmentation,
    device: torch.device,
) -> tuple[dict[str, float], NDArray[np.float32], NDArray[np.bool_]]:
    """Measure how well a network recognises augmented copies of the validation images.

    Only pairs of images with a known relation are used. Each augmented copy is paired with at most
    five images of its place, and with all images that are known to show different places.
    Therefore, most pairs show different places, as in a SLAM run. Every call uses the same
    augmentations and pairs.

    Returns:
        The measures of :func:`vslam_lab.precision_recall.summary`, and the scores and
        labels of the pairs.
    """
    images = collection.images[chosen]
    augmented = np.stack(
        [augment(one, strength, np.random.default_rng([7, k])) for k, one in enumerate(images)]
    )
    gallery = embed_all(network, images, device)
    scores = score_matrix(network, embed_all(network, augmented, device), gallery, device)
    relation = collection.relation[np.ix_(chosen, chosen)].copy()
    for k, row in enumerate(relation):
        # Without this limit, fifty pictures of one webcam would outweigh all streets.
        same_place = np.flatnonzero(row == SAME)
        dropped = np.random.default_rng([8, k]).permutation(same_place)[_MOST_SAME:]
        row[dropped] = UNKNOWN
    known = relation != UNKNOWN
    same, score = relation[known] == SAME, scores[known]
    figures = summary(same, score)
    for threshold in (0.5, 0.9):
        name = f"balanced_accuracy_at_{threshold}"
        figures[name] = balanced_accuracy(same, score, threshold)
    return figures, score, same


@torch.no_grad()
def blend(network: SiameseNetwork, before: dict[str, Tensor], share: float) -> None:
    """Interpolate the weights of a network in place. If ``share`` is 0, the result has the weights
    ``before``. If it is 1, the current weights do not change.

    Interpolated weights keep most of what fine-tuning has learned, and more of what the original
    network had learned (WiSE-FT, Wortsman et al., CVPR 2022).
    """
    after = network.state_dict()
    mixed = {
        key: torch.lerp(before[key].to(value.device), value, share)
        for key, value in after.items()
        if value.is_floating_point()
    }
    network.load_state_dict(after | mixed)


def calibrate(network: SiameseNetwork, score: NDArray, same: NDArray) -> None:
    """Fit the parameters a and b of the network's head, ``p = sigmoid(a - b d)``, in place, so that
    p is a calibrated probability.

    In the fit, the pairs of the same place have the same total weight as the pairs of different
    places. The order of the scores and the average precision do not change.
    """
    head = network.head
    a, b = head.log_a.exp().item(), head.log_b.exp().item()
    p = np.clip(np.asarray(score, np.float64), 1e-12, 1 - 1e-12)
    d = (a - np.log(p / (1 - p))) / b
    same = np.asarray(same, bool)
    weight = np.where(same, 0.5 / same.sum(), 0.5 / (~same).sum())
    sign = np.where(same, 1.0, -1.0)

    def cost(x: NDArray) -> float:
        return float(weight @ np.logaddexp(0.0, -sign * (np.exp(x[0]) - np.exp(x[1]) * d)))

    best = minimize(cost, np.log([a, b]), method="Nelder-Mead").x
    with torch.no_grad():
        head.log_a.fill_(float(best[0]))
        head.log_b.fill_(float(best[1]))
