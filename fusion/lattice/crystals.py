"""Which inputs of an ensemble belong into one lattice: those that act on each other."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from fusion.lattice.checks import refusal
from fusion.lattice.subsets import random_features

RIDGE = 1e-3
"""Weight of the squared coefficients of a pair, as a share of the rows."""
MOST_SWEEPS = 50
"""Passes over all swaps; a pass without a better swap ends them."""


def twists(x: ArrayLike, y: ArrayLike) -> Float[np.ndarray, "d d"]:
    r"""How much each pair of inputs acts together: the squared twist of its 2 x 2 lattice.

    .. math:: y \approx a + \sum_i b_i u_i + \sum_{i<j} c_{ij} u_i u_j, \qquad T_{ij} = c_{ij}^2

    Symbols: :math:`u_i` is the rank of `x[:, i]`, from -1/2 to 1/2. The right side is an ensemble
    of all 2 x 2 lattices, and :math:`c_{ij}` is what the corners of one add up to crosswise.

    Args:
        x: `[N, D]` inputs in any units; y: `[N]`, what is to be predicted.

    Returns:
        Symmetric, zero on the diagonal.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.

    Example:
        >>> x = np.random.default_rng(0).normal(size=(500, 3))
        >>> t = twists(x, x[:, 0] * x[:, 2] + x[:, 1])
        >>> bool(t[0, 2] > 100 * max(t[0, 1], t[1, 2]))
        True
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 2 or y.shape != x.shape[:1] or len(y) < 2:
        raise ValueError(
            f"x.shape={x.shape}, y.shape={y.shape}: expected [N, D] and [N] with N > 1; one row "
            "for each example"
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("x, y=NaN or infinity among them: expected finite numbers; fill them")
    n, d = x.shape
    # Equal values have equal ranks, the mean of theirs.
    ranks = [np.unique(column, return_inverse=True, return_counts=True)[1:] for column in x.T]
    u = np.stack([((np.cumsum(c) - 0.5 * (c + 1)) / max(n - 1, 1))[i] for i, c in ranks], axis=1)
    u -= 0.5
    pairs = list(itertools.combinations(range(d), 2))
    columns = [np.ones(n), *u.T, *(u[:, i] * u[:, j] for i, j in pairs)]
    design = np.stack(columns, axis=1)
    penalty = np.r_[np.full(1 + d, 1e-9), np.full(len(pairs), RIDGE)] * n
    coefficients = np.linalg.solve(design.T @ design + np.diag(penalty), design.T @ y)
    found = np.zeros((d, d))
    for (i, j), c in zip(pairs, coefficients[1 + d :], strict=True):
        found[i, j] = found[j, i] = c**2
    return found


def crystals(
    x: ArrayLike,
    y: ArrayLike,
    n_lattices: int,
    rank: int,
    *,
    seed: int = 0,
) -> tuple[tuple[int, ...], ...]:
    r"""Subsets of the inputs for an ensemble, so that inputs that act together share a lattice.

    .. math:: \max \sum_{\text{pairs } i, j \text{ that share a lattice}} T_{ij}

    by swaps of two inputs between two lattices, from balanced random subsets, until no swap raises
    the sum. A pair counts once, however many lattices hold it, and inputs keep the number of
    lattices that they start with.

    Args:
        x, y: inputs and what is to be predicted, as in `twists`, of training rows only.
        n_lattices: subsets; rank: inputs in each.
        seed: of the first subsets.

    Returns:
        `n_lattices` tuples of `rank` different inputs, for `EnsembleConfig.features`.

    Raises:
        ValueError: see `twists` and `random_features`.

    Source: Canini et al. (2016), Fast and flexible monotonic functions with ensembles of lattices,
    section 6: crystals. Deviation: the first fit is a ridge regression, solved at once; pairs count
    once.

    Example:
        >>> x = np.random.default_rng(0).normal(size=(500, 4))
        >>> crystals(x, x[:, 0] * x[:, 2] + x[:, 1] * x[:, 3], n_lattices=2, rank=2)
        ((0, 2), (1, 3))
    """
    gain = twists(x, y)
    subsets = [list(s) for s in random_features(seed, gain.shape[0], n_lattices, rank)]
    if n_lattices < 2 and rank < gain.shape[0]:
        raise refusal("n_lattices", n_lattices, "2 or more", "one lattice leaves inputs out")
    best = _shared(subsets, gain)
    for _ in range(MOST_SWEEPS):
        before = best
        for a, b in itertools.combinations(range(n_lattices), 2):
            for i, j in itertools.product(range(rank), repeat=2):
                one, other = subsets[a][i], subsets[b][j]
                if one in subsets[b] or other in subsets[a]:
                    continue
                subsets[a][i], subsets[b][j] = other, one
                if (now := _shared(subsets, gain)) > best * (1 + 1e-12):
                    best = now
                else:
                    subsets[a][i], subsets[b][j] = one, other
        if best == before:
            break
    return tuple(sorted(tuple(sorted(subset)) for subset in subsets))


def _shared(subsets: list[list[int]], gain: np.ndarray) -> float:
    """Sum of the twists of pairs that share a lattice."""
    there = np.zeros(gain.shape, bool)
    for subset in subsets:
        there[np.ix_(subset, subset)] = True
    return float(gain[there].sum())
