"""From relaxed weights to numbers of poses: efficient rounding within groups and the cap."""

from __future__ import annotations

import numpy as np

from elastocal.design.problem import Array, DesignProblem, IntArray

# A candidate without weight counts as this share of the smallest weight of its group: it is used
# only where those with weight cannot fill the share under the cap.
FLOOR = 1e-6


def efficient_rounding(weights: Array, n: int, most: int | None = None) -> IntArray:
    """Counts ν (k,) with Σ ν_i = n that lose least against positive weights w (k,), k ≤ n.

    Starts from ν_i = ⌈(n − k/2) w_i⌉; a pose too few goes where ν_i/w_i is smallest, one too many
    is taken where (ν_i − 1)/w_i is largest.  Among all roundings this has the largest
    min_i ν_i/(n w_i), which bounds the efficiency of the rounded plan for every criterion
    (Pukelsheim & Rieder 1992, Biometrika 79, 763–770).  With `most`, ν_i ≤ most ≥ n/k.
    """
    w = weights / weights.sum()
    cap = n if most is None else most
    counts = np.clip(np.ceil((n - len(w) / 2) * w), 1, cap).astype(np.int64)
    while counts.sum() < n:
        counts[np.argmin(np.where(counts < cap, counts / w, np.inf))] += 1
    while counts.sum() > n:
        counts[np.argmax(np.where(counts > 1, (counts - 1) / w, -np.inf))] -= 1
    return counts


def round_weights(
    problem: DesignProblem, weights: Array, rng: np.random.Generator | None = None
) -> IntArray:
    """A plan (n_poses,), sorted, from relaxed weights (N,): shares and cap hold exactly.

    A relaxed optimum spreads over more candidates than a share has poses, so in every group the
    largest weights are rounded efficiently and the rest dropped.  With `rng` those kept are drawn
    without replacement in proportion to their weights (the largest log w_i + Gumbel noise), for
    starts that differ.
    """
    plan = [np.empty(0, dtype=np.int64)]
    for label, share in enumerate(problem.shares):
        members = np.flatnonzero(problem.group == label)
        if share == 0:
            continue
        w = np.maximum(weights[members], 0.0)
        positive = int(np.count_nonzero(w))
        w = np.maximum(w, FLOOR * w[w > 0].min() if positive else 1.0)
        fewest = -(-int(share) // problem.most)
        kept = min(max(fewest, positive), int(share))
        score = np.log(w) if rng is None else np.log(w) + rng.gumbel(size=len(w))
        order = np.argsort(-score, kind="stable")[:kept]
        counts = efficient_rounding(w[order], int(share), problem.most)
        plan.append(np.repeat(members[order], counts))
    return np.sort(np.concatenate(plan))
