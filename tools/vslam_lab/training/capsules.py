"""Implements capsules and dynamic routing between them.

The module implements equations 4 to 9 of Zhou and Sun, Sci Rep 15, 7644 (2025), which are based on
Sabour et al., NIPS 2017. In the shapes of arrays, N is the number of images. There are I primary
capsules of dimension A, and J output capsules of dimension D. Primary capsules have T types at P
places. A type is a group of channels of the extractor, and a place is a cell of the feature grid.
The index of a primary capsule is ``i = t P + p``.

All places of a type share the same matrices. Therefore, ``route`` sums over the places first, and
never computes the prediction vectors of single capsules. ``tests/reference_routing.py`` implements
the equations of the paper literally.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

Over = Literal["primary", "output"]
_DEVIATION = 0.12  # initial deviation of prediction vectors over sqrt(number of capsules)
TINY = 1e-12  # added so that the square root is differentiable at 0


def squash(s: Tensor) -> Tensor:
    """Compute ``|s|² / (1 + |s|²) · s / |s|`` along the last axis (equation 8 of Zhou and Sun). The
    length of the result is below 1."""
    squared = (s * s).sum(-1, keepdim=True)
    return s * (torch.sqrt(squared + TINY) / (1.0 + squared))


def route(
    u: Tensor, W: Tensor, iterations: int = 3, over: Over = "primary", alive: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute output capsules from primary capsules by dynamic routing. Gradients flow only through
    the last iteration.

    The sums are rearranged as ``s_j = Σ_t W_tj (Σ_p c_tpj u_tp)`` and the scalar products as
    ``û_j|i·v_j = u_tp·(W_tjᵀ v_j)``. In this form, the ``I J D`` elements of the prediction vectors
    need not be computed.

    Args:
        u: ``(N, T, P, A)`` primary capsules.
        W: ``(J, T, A, D)`` matrices, shared by the places of a type.
        iterations: number of iterations, at least 1.
        over: axis of the softmax. With ``primary``, the coupling coefficients sum to 1 over i, as
            in Zhou and Sun. With ``output``, they sum to 1 over j, as in Sabour et al.
        alive: ``(I,)`` bool, False for primary capsules that are ignored, as if they did not exist.
            None uses all capsules.

    Returns:
        The output capsules ``v``, ``(N, J, D)``, and two arrays from which :func:`couplings`
        computes the coupling coefficients: the numerators ``e``, ``(N, T, J, P)``, and the
        denominators ``total``, ``(N, 1, J, 1)`` or ``(1,)``. The coefficients are not computed
        here, because dividing only the sums over P needs a sixth of the divisions.
    """
    n, types, places, size = u.shape
    outputs, _, _, depth = W.shape
    W_j = W.reshape(outputs, types * size, depth)
    rows = u.reshape(n * types, places, size)
    present = None if alive is None else alive.view(types, 1, places)

    def weighted_sums(e: Tensor, total: Tensor) -> Tensor:
        """Compute the sums ``s``, ``(N, J, D)``, for the coupling coefficients ``e / total``."""
        pooled = torch.bmm(e.view(n * types, outputs, places), rows)
        pooled = pooled.view(n, types, outputs, size) / total
        pooled = pooled.permute(2, 0, 1, 3).reshape(outputs, n, types * size)
        return torch.bmm(pooled, W_j).transpose(0, 1)

    def agreements(v: Tensor) -> Tensor:
        """Compute the ``(N, T, J, P)`` agreements of the prediction vectors with output
        capsules."""
        back = torch.bmm(v.transpose(0, 1), W_j.transpose(1, 2)).view(outputs, n, types, size)
        back = back.permute(1, 2, 0, 3).reshape(n * types, outputs, size)
        return torch.bmm(back, rows.transpose(1, 2)).view(n, types, outputs, places)

    def softmax_parts(b: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the numerators and the denominator of the softmax of ``(N, T, J, P)`` logits
        (equation 6 of Zhou and Sun). The logits are overwritten."""
        if over == "output":
            c = torch.softmax(b, dim=2)
            return c if present is None else c * present, b.new_ones(1)
        if present is not None:
            b.masked_fill_(~present, -torch.inf)
        # Subtracting the maximum avoids overflow and does not change a softmax. Reducing one axis
        # after the other is several times faster than reducing both axes at once.
        b -= b.amax(3, keepdim=True).amax(1, keepdim=True)
        e = torch.exp(b)
        return e, e.sum(3, keepdim=True).sum(1, keepdim=True)

    with torch.no_grad():
        if iterations == 1:
            e, total = softmax_parts(u.new_zeros((n, types, outputs, places)))
        else:
            # With b = 0, all couplings are equal. The first sums are therefore means, which are the
            # same for all outputs and need no softmax.
            counted = rows
            if present is not None:
                counted = rows * present.view(types, places, 1).repeat(n, 1, 1)
            count = places * types if alive is None else alive.sum()
            share = 1.0 / (count if over == "primary" else outputs)
            means = counted.sum(1).view(n, types * size) * share
            s = torch.bmm(means.expand(outputs, -1, -1), W_j).transpose(0, 1)
            b = agreements(squash(s))
            for _ in range(iterations - 2):
                b += agreements(squash(weighted_sums(*softmax_parts(b))))
            e, total = softmax_parts(b)
    return squash(weighted_sums(e, total)), e, total


def couplings(e: Tensor, total: Tensor) -> Tensor:
    """Compute the ``(N, J, I)`` coupling coefficients from the numerators and denominators that
    :func:`route` returned."""
    return (e / total).transpose(1, 2).flatten(2)


class CapsuleLayer(nn.Module):
    """The layer that computes output capsules from primary capsules.

    Each primary capsule i has a type t(i) and a place, which is a cell of the feature grid. Its
    transform to output capsule j is ``W_ij = W_t(i)j diag(g_i)``: a matrix for each pair of type
    and output capsule, and a gain vector of size A for each primary capsule. A separate matrix for
    each i and j would need tens of millions of parameters.

    Pruned capsules have no entry in ``gains`` and ``place``, and are not computed.

    Attributes:
        W: ``(J, T, A, D)`` matrices.
        gains: ``(T, K, A)`` gain vectors of the K kept places of each type. Before pruning, all
            places are kept.
        place: ``(T, K)`` int64 buffer with the indices of the kept places.
        alive: ``(T K,)`` bool buffer, True for capsules that are not masked. Tests use the mask to
            check that masking and removal of capsules give the same results.
    """

    place: Tensor
    alive: Tensor

    def __init__(
        self,
        types: int,
        places: int,
        size: int,
        outputs: int,
        depth: int,
        iterations: int = 3,
        over: Over = "primary",
        kept: int | None = None,
    ) -> None:
        super().__init__()
        kept = places if kept is None else kept
        self.iterations, self.over, self.places = iterations, over, places
        # A mean over thousands of capsules is a short vector. The deviation makes up for this. With
        # half of this deviation, the couplings stay equal. With twice this deviation, a few
        # capsules get nearly all of the coupling.
        deviation = _DEVIATION * (types * places / size) ** 0.5 if over == "primary" else 1.0
        self.W = nn.Parameter(torch.randn(outputs, types, size, depth) * deviation)
        self.gains = nn.Parameter(torch.ones(types, kept, size))
        self.register_buffer("place", torch.arange(kept).repeat(types, 1))
        self.register_buffer("alive", torch.ones(types * kept, dtype=torch.bool))
        self.masked = False

    def forward(self, u: Tensor) -> Tensor:
        """Compute ``(N, J, D)`` output capsules from ``(N, T, P, A)`` primary capsules."""
        return self._route(u)[0]

    def routed(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the ``(N, J, D)`` output capsules and the ``(N, J, T K)`` coupling
        coefficients."""
        v, e, total = self._route(u)
        return v, couplings(e, total)

    def _route(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if self.place.shape[1] < self.places:
            types, kept = self.place.shape
            first = self.places * torch.arange(types, device=u.device)[:, None]
            rows = u.flatten(1, 2).index_select(1, (first + self.place).flatten())
            u = rows.unflatten(1, (types, kept))  # torch.gather takes five times as long
        alive = self.alive if self.masked else None
        # Routing sums thousands of products. It therefore never runs in half precision.
        with torch.autocast(u.device.type, enabled=False):
            u = u.float() * self.gains
            return route(u, self.W, self.iterations, self.over, alive)
