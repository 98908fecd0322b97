"""Random subsets of inputs, one for each lattice of an ensemble."""

from __future__ import annotations

import numpy as np

from fusion.lattice.checks import refusal


def random_features(
    seed: int,
    n_inputs: int,
    n_lattices: int,
    rank: int,
    *,
    together: tuple[tuple[int, ...], ...] = (),
) -> tuple[tuple[int, ...], ...]:
    """Random subsets of the inputs, every input in as equal a number of them as can be.

    Args:
        seed: of numpy's generator; the same seed gives the same subsets.
        n_inputs: inputs to choose from.
        n_lattices: subsets.
        rank: inputs in each, at most `n_inputs`.
        together: groups of inputs that are in the same subsets, as constraints between them ask;
            groups that share an input are one.

    Returns:
        `n_lattices` tuples of `rank` different inputs.

    Raises:
        ValueError: `rank` is out of range, the lattices have too few places for all inputs, or the
            groups do not fit into subsets of this rank.

    Source: Canini et al. (2016), Fast and flexible monotonic functions with ensembles of
    lattices: random tiny lattices. Deviation: they draw subsets independently; here counts are
    balanced, so that no input is left out.
    """
    if not 1 <= rank <= n_inputs:
        raise refusal("rank", rank, f"1..{n_inputs}, the number of inputs", "lower the rank")
    if n_lattices * rank < n_inputs:
        raise refusal(
            "n_lattices",
            n_lattices,
            f"{-(-n_inputs // rank)} or more: {n_inputs} inputs need a place at rank {rank}",
            "use more lattices or a higher rank",
        )
    units = _units(n_inputs, together)
    rng = np.random.default_rng(seed)
    used = np.zeros(len(units))
    subsets = []
    for _ in range(n_lattices):
        # The least used inputs first, ties at random; passed over where the rest could not fill up.
        order = np.lexsort((rng.random(len(units)), used))
        sums = [{0}]
        for place in order[::-1]:
            sums.append(sums[-1] | {total + len(units[place]) for total in sums[-1]})
        chosen: list[int] = []
        for place, rest in zip(order, sums[-2::-1], strict=True):
            if rank - len(chosen) - len(units[place]) in rest:
                chosen += units[place]
                used[place] += 1
        subsets.append(tuple(sorted(chosen)))
    if any(len(subset) != rank for subset in subsets) or not used.all():
        raise refusal(
            "together", together, f"groups that fill subsets of {rank} inputs and leave none out",
            "use another rank, or more lattices",
        )  # fmt: skip
    return tuple(subsets)


def _units(n_inputs: int, together: tuple[tuple[int, ...], ...]) -> list[list[int]]:
    """Single inputs, and the groups that stay together in place of theirs."""
    unit = {i: [i] for i in range(n_inputs)}
    for group in together:
        if not all(0 <= i < n_inputs for i in group):
            raise refusal(
                "together", group, f"inputs of 0..{n_inputs - 1}", "name them by position"
            )
        merged = sorted({i for member in group for i in unit[member]})
        unit |= dict.fromkeys(merged, merged)
    return [list(members) for members in dict.fromkeys(tuple(m) for m in unit.values())]
