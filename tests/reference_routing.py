"""The routing of the paper (Zhou and Sun, Sci Rep 15, 7644 (2025), equations 4 to 7).

Each function implements one equation. There are N images. Each image has I primary capsules of A
numbers, in T types at P places (i = t P + p), and J output capsules of D numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vslam_lab.training.capsules import Over, squash


def predict(u: Tensor, W: Tensor) -> Tensor:
    """Eq. 4: prediction vectors ``û_j|i = W_ij u_i``.

    Args:
        u: ``(N, T, P, A)`` primary capsules.
        W: ``(J, T, A, D)`` matrices, which all places of a type share.

    Returns:
        ``(N, J, I, D)``.
    """
    u_hat = torch.einsum("ntpa,jtad->njtpd", u, W)
    return u_hat.flatten(2, 3)


def couple(b: Tensor, over: Over = "primary") -> Tensor:
    """Eq. 6: coupling coefficients, which are the softmax of the logits ``b``, ``(N, J, I)``.

    With ``primary``, the sum over i is 1, as in the paper. With ``output``, the sum over j is 1, as
    in Sabour et al.
    """
    return torch.softmax(b, dim=2 if over == "primary" else 1)


def combine(c: Tensor, u_hat: Tensor) -> Tensor:
    """Eq. 5: ``s_j = Σ_i c_ij û_j|i``, from ``(N, J, I)`` and ``(N, J, I, D)`` to ``(N, J, D)``."""
    return torch.einsum("nji,njid->njd", c, u_hat)


def agree(u_hat: Tensor, v: Tensor) -> Tensor:
    """Eq. 7: ``û_j|i · v_j``, ``(N, J, I)``, which is added to the logits."""
    return torch.einsum("njid,njd->nji", u_hat, v)


def route(
    u_hat: Tensor, iterations: int = 3, over: Over = "primary", alive: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Dynamic routing as in the paper. Gradients flow only through the last iteration.

    Args:
        u_hat: ``(N, J, I, D)`` prediction vectors.
        iterations: number of iterations, at least 1.
        over: the capsules over which the coupling coefficients are normalised.
        alive: ``(I,)`` bool. A capsule that is not alive is ignored, as if it were removed.

    Returns:
        ``(N, J, D)`` output capsules ``v``, and their ``(N, J, I)`` coupling coefficients.
    """
    n, outputs, primaries, _ = u_hat.shape
    with torch.no_grad():
        b = u_hat.new_zeros((n, outputs, primaries))
        for _ in range(iterations - 1):
            b = b + agree(u_hat, squash(combine(_masked_couple(b, over, alive), u_hat)))
        c = _masked_couple(b, over, alive)
    return squash(combine(c, u_hat)), c


def _masked_couple(b: Tensor, over: Over, alive: Tensor | None) -> Tensor:
    if alive is None:
        return couple(b, over)
    # If coefficients are normalised over outputs, all logits of a removed capsule are -inf, and
    # their softmax is NaN.
    return torch.nan_to_num(couple(b.masked_fill(~alive, -torch.inf), over), nan=0.0)
