"""Sparse Cholesky factorisation of symmetric systems with one row of 6x6 blocks per keyframe.

The structure of the matrix is analysed once for all iterations of an optimiser. The analysis finds
a minimum degree elimination order (George and Liu, "The evolution of the minimum degree ordering
algorithm", SIAM Review 1989). It also finds the fill-in. The elimination is simulated on bit sets,
which is feasible for a few thousand keyframes.

The numeric factorisation is left-looking (Davis, "Direct Methods for Sparse Linear Systems",
section 4.8) and works on blocks. The same input produces byte-identical output on every run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import inner_kernel, kernel, popcount

BLOCK = 6


class Structure(NamedTuple):
    """Positions of the nonzero blocks in the Cholesky factor of a system of ``n`` block rows.

    Block rows and columns are in elimination order. A "slot" is the position of one nonzero block
    in memory.

    Attributes:
        order: ``(n,)`` int64. Entry i is the original index of the block row that is eliminated as
            number i.
        first: ``(n + 1,)`` int64; the slots of column c are ``first[c]:first[c + 1]``.
        row: ``(slots,)`` int32 block row of each slot, ascending within a column. The first slot of
            a column is on the diagonal.
        row_first: ``(n + 1,)`` int64; the blocks of row r to the left of the diagonal are
            ``row_slot[row_first[r]:row_first[r + 1]]``.
        row_slot, row_column: ``(slots - n,)`` int32 slot and ``(slots - n,)`` int32 column of each
            block below the diagonal, sorted by row, then by column.
    """

    order: NDArray[np.int64]
    first: NDArray[np.int64]
    row: NDArray[np.int32]
    row_first: NDArray[np.int64]
    row_slot: NDArray[np.int32]
    row_column: NDArray[np.int32]


def analyse(n: int, pairs: NDArray[np.int64]) -> Structure:
    """Compute the elimination order and the fill-in of a sparse system of ``n`` block rows. This
    takes ``n * n / 8`` bytes of temporary memory.

    Args:
        pairs: ``(M, 2)`` pairs of block rows that are coupled, in any order; repetitions are
            allowed.
    """
    return Structure(*_analyse(n, np.ascontiguousarray(pairs, np.int64).reshape(-1, 2)))


@kernel
def _analyse(n, pairs):
    one = np.uint64(1)
    words = (n + 63) // 64
    adjacent = np.zeros((n, words), np.uint64)
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        if i != j:
            adjacent[i, j // 64] |= one << np.uint64(j % 64)
            adjacent[j, i // 64] |= one << np.uint64(i % 64)
    degree = np.zeros(n, np.int64)
    for i in range(n):
        for word in range(words):
            degree[i] += np.int64(popcount(adjacent[i, word]))
    order = np.empty(n, np.int64)
    position = np.full(n, -1, np.int64)
    first = np.zeros(n + 1, np.int64)
    for step in range(n):
        # Choose a block of minimum degree. If several blocks have this degree, choose the one with
        # the lowest index, which belongs to the oldest keyframe.
        chosen, least = -1, n
        for i in range(n):
            if position[i] < 0 and degree[i] < least:
                chosen, least = i, degree[i]
        order[step], position[chosen] = chosen, step
        first[step + 1] = first[step] + least + 1
        # The neighbours of the chosen block become neighbours of each other. The chosen block keeps
        # its set of neighbours, which are the blocks of its column of the factor.
        for i in range(n):
            if not adjacent[chosen, i // 64] >> np.uint64(i % 64) & one:
                continue
            count = 0
            for word in range(words):
                adjacent[i, word] |= adjacent[chosen, word]
            adjacent[i, i // 64] &= ~(one << np.uint64(i % 64))
            adjacent[i, chosen // 64] &= ~(one << np.uint64(chosen % 64))
            for word in range(words):
                count += np.int64(popcount(adjacent[i, word]))
            degree[i] = count
    # Sort by transposing twice. Visiting the columns in ascending order sorts the columns of each
    # row. Then visiting the rows in ascending order sorts the rows of each column.
    slots = first[n]
    row_first = np.zeros(n + 1, np.int64)
    for step in range(n):
        for i in range(n):
            if adjacent[order[step], i // 64] >> np.uint64(i % 64) & one:
                row_first[position[i] + 1] += 1
    for r in range(n):
        row_first[r + 1] += row_first[r]
    row_column = np.empty(slots - n, np.int32)
    filled = row_first[:n].copy()
    for step in range(n):
        for i in range(n):
            if adjacent[order[step], i // 64] >> np.uint64(i % 64) & one:
                row_column[filled[position[i]]] = step
                filled[position[i]] += 1
    row = np.empty(slots, np.int32)
    row_slot = np.empty(slots - n, np.int32)
    filled = first[:n].copy()
    for r in range(n):
        row[filled[r]] = r
        filled[r] += 1
        for k in range(row_first[r], row_first[r + 1]):
            column = row_column[k]
            row[filled[column]] = r
            row_slot[k] = filled[column]
            filled[column] += 1
    return order, first, row, row_first, row_slot, row_column


@kernel
def panel(structure, column):
    """Return where the panel of a matrix column begins in the array ``S``, and the width of the
    panel.

    A panel holds the transposed blocks of one column side by side. Element (i, j) of the k-th block
    is ``S[begin + j * width + 6 * k + i]``. The rows of a panel are long, so that vector
    instructions are efficient.
    """
    first = structure.first[column]
    return BLOCK * BLOCK * first, BLOCK * (structure.first[column + 1] - first)


@kernel
def factor_solve(structure, S, x):
    """Solve the sparse linear system ``S x = rhs`` in place by Cholesky factorisation. Returns
    False if S is not positive definite.

    Args:
        structure: the ``Structure`` of S.
        S: ``(36 * slots,)`` float64 lower triangle of the matrix in elimination order, one panel
            per column (see ``panel``). The blocks of the fill-in must be zero. S is overwritten
            with the factor.
        x: ``(n, 6)`` float64 right-hand side in elimination order. It is overwritten with the
            solution.
    """
    first, row = structure.first, structure.row
    n = len(x)
    widest = 0
    for column in range(n):
        widest = max(widest, first[column + 1] - first[column])
    place = np.zeros(n, np.int64)
    update = np.zeros((BLOCK, BLOCK * widest))
    for column in range(n):
        start, end = first[column], first[column + 1]
        for slot in range(start, end):
            place[row[slot]] = BLOCK * (slot - start)
        for k in range(structure.row_first[column], structure.row_first[column + 1]):
            source = structure.row_column[k]
            add_product(
                S, first[source], structure.row_slot[k], first[source + 1], row, place, update
            )
        base, width = panel(structure, column)
        for j in range(BLOCK):
            for i in range(width):
                S[base + j * width + i] -= update[j, i]
                update[j, i] = 0.0
        if not factor_panel(S, base, width):
            return False
    for column in range(n):
        base, width = panel(structure, column)
        for j in range(BLOCK):
            value = x[column, j]
            for k in range(j):
                value -= S[base + k * width + j] * x[column, k]
            x[column, j] = value / S[base + j * width + j]
        for slot in range(first[column] + 1, first[column + 1]):
            block, r = base + BLOCK * (slot - first[column]), row[slot]
            for j in range(BLOCK):
                for i in range(BLOCK):
                    x[r, i] -= S[block + j * width + i] * x[column, j]
    for column in range(n - 1, -1, -1):
        base, width = panel(structure, column)
        for slot in range(first[column] + 1, first[column + 1]):
            block, r = base + BLOCK * (slot - first[column]), row[slot]
            for j in range(BLOCK):
                for i in range(BLOCK):
                    x[column, j] -= S[block + j * width + i] * x[r, i]
        for j in range(BLOCK - 1, -1, -1):
            value = x[column, j]
            for i in range(j + 1, BLOCK):
                value -= S[base + j * width + i] * x[column, i]
            x[column, j] = value / S[base + j * width + j]
    return True


@inner_kernel
def add_product(S, start, pivot, end, row, place, update):
    """Add the contribution of an earlier column of the factor, with the slots ``start:end``, to
    ``update``. The caller subtracts ``update`` from the current column.

    ``pivot`` is the slot of the earlier column whose row equals the index of the current column.
    Blocks that are adjacent in both columns are multiplied together, because long rows fill vector
    registers.
    """
    width = np.uintp(BLOCK * (end - start))
    begin = np.uintp(BLOCK * BLOCK * start)
    b = begin + np.uintp(BLOCK * (pivot - start))
    slot = pivot
    while slot < end:
        target = place[row[slot]]
        after = slot + 1
        while after < end and place[row[after]] == target + BLOCK * (after - slot):
            after += 1
        # Indices are unsigned. For signed indices, the compiler would test whether they are
        # negative, which prevents vectorisation.
        t, length = np.uintp(target), np.uintp(BLOCK * (after - slot))
        a0 = begin + np.uintp(BLOCK * (slot - start))
        a1, a2, a3 = a0 + width, a0 + width + width, a0 + width + width + width
        a4, a5 = a2 + width + width, a3 + width + width
        for j in range(np.uintp(BLOCK)):
            b0, b1, b2 = S[b + j], S[b + (a1 - a0) + j], S[b + (a2 - a0) + j]
            b3, b4, b5 = S[b + (a3 - a0) + j], S[b + (a4 - a0) + j], S[b + (a5 - a0) + j]
            for i in range(length):
                update[j, t + i] += (
                    b0 * S[a0 + i]
                    + b1 * S[a1 + i]
                    + b2 * S[a2 + i]
                    + b3 * S[a3 + i]
                    + b4 * S[a4 + i]
                    + b5 * S[a5 + i]
                )
        slot = after


@inner_kernel
def factor_panel(S, base, width):
    """Factorise the diagonal block of a column, and divide the blocks below it by the factor.
    Returns False if the diagonal block is not positive definite."""
    begin, columns = np.uintp(base), np.uintp(width)
    for j in range(np.uintp(BLOCK)):
        own = begin + j * columns
        for k in range(j):
            earlier = begin + k * columns
            factor = S[earlier + j]
            for i in range(columns):
                S[own + i] -= factor * S[earlier + i]
        if not S[own + j] > 0.0:
            return False
        inverse = 1.0 / np.sqrt(S[own + j])
        for i in range(columns):
            S[own + i] *= inverse
    return True
