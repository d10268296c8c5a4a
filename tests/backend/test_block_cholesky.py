"""Sparse block Cholesky, compared with NumPy on dense copies of the same systems."""

from __future__ import annotations

import numpy as np
import pytest

from vslam.backend.block_cholesky import Structure, analyse, factor_solve, panel


def chain(n: int, reach: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, min(n, i + reach + 1))]


def random_pairs(n: int, m: int, seed: int = 0) -> list[tuple[int, int]]:
    return [tuple(p) for p in np.random.default_rng(seed).integers(0, n, (m, 2)).tolist()]


SYSTEMS = {
    "one block": (1, []),
    "no coupling": (7, []),
    "chain": (40, chain(40, 3)),
    "chain with loops": (80, chain(80, 4) + [(i, i + 55) for i in range(10)] + [(3, 79)]),
    "arrow, tip first": (30, [(0, j) for j in range(1, 30)]),
    "arrow, tip last": (30, [(j, 29) for j in range(29)]),
    "disconnected": (50, chain(20, 3) + [(25 + i, 25 + j) for i, j in chain(20, 5)]),
    "random": (70, random_pairs(70, 150)),
    "beyond one word": (130, chain(130, 2) + random_pairs(130, 40)),
    "dense": (20, chain(20, 19)),
}


def random_system(n: int, pairs: list[tuple[int, int]], seed: int = 0) -> np.ndarray:
    """Make a dense symmetric positive definite matrix with a block for each pair."""
    rng = np.random.default_rng(seed)
    dense = np.zeros((6 * n, 6 * n))
    for i, j in pairs:
        if i != j:
            rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            A = rng.normal(size=(12, 12))
            dense[np.ix_(rows, rows)] += A @ A.T
    return dense + np.eye(6 * n)


def in_panels(structure: Structure, dense: np.ndarray) -> np.ndarray:
    """Convert the lower triangle of a dense matrix, in the caller's order, to panels."""
    S = np.zeros(36 * len(structure.row))
    for c in range(len(structure.order)):
        begin, width = panel(structure, c)
        columns = S[begin : begin + 6 * width].reshape(6, width)
        for k, slot in enumerate(range(structure.first[c], structure.first[c + 1])):
            i, j = structure.order[structure.row[slot]], structure.order[c]
            block = dense[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            columns[:, 6 * k : 6 * k + 6] = (np.tril(block) if i == j else block).T
    return S


@pytest.mark.parametrize("name", SYSTEMS)
def test_solution_is_numpys(name):
    n, pairs = SYSTEMS[name]
    dense = random_system(n, pairs)
    structure = analyse(n, np.array(pairs).reshape(-1, 2))
    b = np.random.default_rng(1).normal(size=(n, 6))
    x = b[structure.order]
    S = in_panels(structure, dense)
    # Every block of the matrix is in the structure.
    assert np.abs(S).sum() == pytest.approx(np.abs(np.tril(dense)).sum())
    assert factor_solve(structure, S, x)
    expected = np.linalg.solve(dense, b.ravel()).reshape(n, 6)
    np.testing.assert_allclose(x[np.argsort(structure.order)], expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", SYSTEMS)
def test_structure_is_that_of_elimination(name):
    """The reference is a slow elimination that keeps the neighbours of each block in sets."""
    n, pairs = SYSTEMS[name]
    structure = analyse(n, np.array(pairs).reshape(-1, 2))
    assert sorted(structure.order.tolist()) == list(range(n))
    position = np.argsort(structure.order)
    neighbours = {i: set() for i in range(n)}
    for i, j in pairs:
        if i != j:
            neighbours[i].add(j)
            neighbours[j].add(i)
    for c, chosen in enumerate(structure.order.tolist()):
        assert len(neighbours[chosen]) == min(map(len, neighbours.values())), "minimum degree"
        mine = neighbours.pop(chosen)
        for i in mine:
            neighbours[i] |= mine - {i}
            neighbours[i].discard(chosen)
        rows = structure.row[structure.first[c] : structure.first[c + 1]].tolist()
        assert rows == [c, *sorted(position[list(mine)].tolist())]
    for r in range(n):
        left = slice(structure.row_first[r], structure.row_first[r + 1])
        columns, slots = structure.row_column[left], structure.row_slot[left]
        assert (np.diff(columns) > 0).all()
        assert (structure.row[slots] == r).all()
        inside = (structure.first[columns] < slots) & (slots < structure.first[columns + 1])
        assert inside.all(), "a slot lies in its column"


def test_arrows_and_chains_do_not_fill():
    for name, slots in (("arrow, tip first", 59), ("arrow, tip last", 59), ("chain", 40 + 3 * 38)):
        n, pairs = SYSTEMS[name]
        assert len(analyse(n, np.array(pairs)).row) == slots


def test_a_long_chain_with_loops_stays_sparse():
    """Each of a thousand keyframes is coupled to twenty others. Two places are revisited."""
    pairs = chain(1000, 10)
    pairs += [(a + s, b + s + t) for a, b in ((0, 700), (300, 850)) for s in range(100)
              for t in range(-5, 5)]  # fmt: skip
    structure = analyse(1000, np.array(pairs))
    couplings = len(set(pairs))
    assert len(structure.row) < 2.5 * couplings
    assert np.diff(structure.first).max() < 80


def test_a_block_outside_the_structure_has_no_slot():
    assert len(analyse(5, np.array([[0, 1]])).row) == 5 + 1


def test_repeated_and_reversed_pairs_change_nothing():
    n, pairs = SYSTEMS["chain with loops"]
    once = analyse(n, np.array(pairs))
    again = analyse(n, np.array([(j, i) for i, j in pairs] + pairs + [(4, 4)]))
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan])
def test_refuses_what_is_not_positive_definite(bad):
    n, pairs = SYSTEMS["chain"]
    dense = random_system(n, pairs)
    dense[100, 100] = bad
    structure = analyse(n, np.array(pairs))
    assert not factor_solve(structure, in_panels(structure, dense), np.ones((n, 6)))
