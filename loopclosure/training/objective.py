"""The losses of training, and the validation and calibration of a network."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor
from torch.nn import functional

from vslam.loopclosure.precision_recall import balanced_accuracy, summary
from vslam.loopclosure.siamese.image_source import DIFFERENT, SAME, UNKNOWN
from vslam.loopclosure.training.augmentation import Augmentation, augment
from vslam.loopclosure.training.data import Collection
from vslam.loopclosure.training.preprocessing import to_tensor
from vslam.loopclosure.training.siamese import SiameseNetwork

_MOST_SAME = 5  # most images of its place that count for a validation image


def cross_entropy(logits: Tensor, same: Tensor) -> Tensor:
    """Eq. 3: ``-(y log p + (1 - y) log(1 - p))``, mean over pairs, from logits of p."""
    return functional.binary_cross_entropy_with_logits(logits, same.to(logits.dtype))


def contrast(alike: Tensor, same: Tensor, relation: Tensor, temperature: float) -> Tensor:
    """InfoNCE: contrasts each pair of one place with all images of other places in the batch.

    Van den Oord et al. 2018, symmetric as in CLIP. Not in the paper.

    Args:
        alike: ``(2 N, 2 N)`` cosines of the images of N pairs: all first ones, then all second.
        same: ``(N,)`` bool.
        relation: ``(2 N, 2 N)`` int8 of the same images.
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
    """Descriptors ``(N, D)`` of ``(N, H, W)`` images, in eval mode."""
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
    """Similarity ``(Q, M)`` of each query with each image of the gallery."""
    network.eval()
    stored = torch.from_numpy(gallery).to(device)
    rows = [network.compare(q, stored).cpu() for q in torch.from_numpy(queries).to(device)]
    return torch.stack(rows).numpy()


def validate(
    network: SiameseNetwork,
    collection: Collection,
    chosen: NDArray[np.int64],
    strength: Augmentation,
    device: torch.device,
) -> tuple[dict[str, float], NDArray[np.float32], NDArray[np.bool_]]:
    """Measure retrieval among the validation images; the augmented images are the queries.

    All pairs with a known relation count, but for each query at most five of its own place. Most
    pairs thus show two places, as in a SLAM run. Augmentations and choice are the same at every
    call.

    Returns:
        Figures of :func:`vslam.loopclosure.precision_recall.summary`, and the scores and labels
        of the pairs behind them.
    """
    images = collection.images[chosen]
    changed = np.stack(
        [augment(s, strength, np.random.default_rng([7, k])) for k, s in enumerate(images)]
    )
    gallery = embed_all(network, images, device)
    scores = score_matrix(network, embed_all(network, changed, device), gallery, device)
    relation = collection.relation[np.ix_(chosen, chosen)].copy()
    for k, row in enumerate(relation):
        # Otherwise, fifty pictures of one webcam would outweigh all streets.
        others = np.flatnonzero(row == SAME)
        dropped = np.random.default_rng([8, k]).permutation(others)[_MOST_SAME:]
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
    """Interpolate in place between the weights ``before`` (share 0) and the current ones (1).

    Between a network and its fine-tuned version, there are weights that forget less and keep most
    of what was learned (WiSE-FT, Wortsman et al., CVPR 2022).
    """
    after = network.state_dict()
    mixed = {
        key: torch.lerp(before[key].to(value.device), value, share)
        for key, value in after.items()
        if value.is_floating_point()
    }
    network.load_state_dict(after | mixed)


def calibrate(network: SiameseNetwork, score: NDArray, same: NDArray) -> None:
    """Fit a and b of ``p = sigmoid(a - b d)`` in place, with equal weight for true and false pairs.

    The order of the scores, and so AP, does not change; p becomes a calibrated probability.
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
