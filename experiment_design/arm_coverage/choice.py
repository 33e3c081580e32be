"""What does the choice of parameters cost?  Ways of choosing, all else known.

    python experiment_design/arm_coverage/choice.py SCENARIO ARMS DRAWS [ERRORS]

The campaigns of campaigns.py, linear about the true arm and with the covariance of the noise known
up to its scale, so that nothing but the choice differs; errors of the arm and noise are drawn anew
DRAWS times for each of ARMS campaigns.  ERRORS: "typical" geometry errors, "large" ones of three
times that, or "few", a third of it but for one in ten of five times that.  Prints a row per way.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import numpy as np
from campaigns import BY_KEY, GEOMETRY, SIGMA, SPRINGS, Campaign, arm
from scipy import optimize, sparse, stats

from elastocal.identification.residuals import held_out_residual, predicts_better, rms_3d
from elastocal.identification.solve import PLACED, WIDER, Reduction, is_placed, reduce
from elastocal.identification.weighted_problem import Weights

MODEL = arm()
SPRING = np.array([p.effect == "joint_compliance" for p in MODEL.parameters])
FREE = is_placed(MODEL)


class Setting:
    """A campaign made linear: B, B at the new poses, sizes, and both whitenings."""

    def __init__(self, scenario: str, number: int) -> None:
        campaign = Campaign(BY_KEY[scenario], number)
        self.B = MODEL.regressor(campaign.exact, campaign.true).B
        self.new = MODEL.regressor(campaign.test, campaign.true).B
        self.sizes = MODEL.sizes(np.abs(self.B))
        self.sizes[FREE] = PLACED
        self.root = np.linalg.cholesky(campaign.covariance)
        self.true = np.linalg.inv(self.root)
        self.plain = np.eye(len(self.B)) / SIGMA
        self.configuration = campaign.exact.configuration

    def reduced(self, W: np.ndarray, sigma: float, threshold: float) -> Reduction:
        return reduce(W @ self.B, self.sizes, MODEL.parameters, sigma, threshold)


def fitted(B: np.ndarray, y: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Estimate, covariance with the scale estimated, and degrees of freedom."""
    A, z = W @ B, W @ y
    unit = 1 / np.linalg.norm(A, axis=0)
    x, rss, *_ = np.linalg.lstsq(A * unit, z, rcond=None)
    dof = len(z) - len(x)
    inverse = np.linalg.inv(np.linalg.qr(A * unit, mode="r"))
    return x * unit, float(rss[0]) / dof * (inverse @ inverse.T) * np.outer(unit, unit), dof


def widened(s: Setting, y: np.ndarray, start: Reduction, tested: bool) -> Reduction:
    """From the minimal set to wider ones, by held-out error alone or where the test says so."""
    weights = Weights("plain", sparse.csr_array(s.plain), True, "")

    def held(chosen: Reduction) -> tuple[np.ndarray, float]:
        B = s.B[:, chosen.kept]
        residual = y - B @ fitted(B, y, s.plain)[0]
        sigma = np.linalg.norm(residual) / SIGMA / np.sqrt(len(y) - B.shape[1])
        return held_out_residual(B, residual, weights, s.configuration, 3), float(sigma)

    now, (before, sigma) = start, held(start)
    for threshold in WIDER:
        wide = s.reduced(s.plain, sigma, threshold)
        if len(wide.kept) <= len(now.kept):
            continue
        after, other = held(wide)
        if tested:
            better = predicts_better(before, after, weights, s.configuration, 3)
        else:
            better = rms_3d(after, 3) < rms_3d(before, 3)
        if better:
            now, before, sigma = wide, after, other
    return now


def shrunk(
    s: Setting, full: Reduction, x: np.ndarray, C: np.ndarray, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior of the complete set under normal errors of `factor` typical sizes."""
    variance = np.where(FREE, 1e3 * s.sizes, factor * s.sizes) ** 2
    M = full.mixing
    P = np.diag(variance[full.kept]) + (M * variance[full.dropped]) @ M.T
    unit = 1 / np.sqrt(np.diag(C))
    C, P = C * np.outer(unit, unit), P * np.outer(unit, unit)
    K = np.linalg.solve(P + C, C).T
    return x - K @ (x * unit) / unit, (C - K @ C) / np.outer(unit, unit)


UNIT = np.array([p.unit for p in MODEL.parameters])
OFFSET = np.array([p.effect == "joint_offset" for p in MODEL.parameters])
KINDS = [SPRING, OFFSET, ~SPRING & ~OFFSET & (UNIT == "rad"), ~SPRING & ~OFFSET & (UNIT == "m")]


def estimated(
    s: Setting, full: Reduction, x: np.ndarray, C: np.ndarray, kinds: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior of the complete set under normal errors whose scale the readings tell for each of
    the `kinds`: marginal likelihood x ~ N(0, C + Σ κ_g² P_g), and to the covariance what the
    scales' own uncertainty adds (Kass and Steffey 1989, J. Am. Stat. Assoc. 84, 717)."""
    M, unit = full.mixing, 1 / np.sqrt(np.diag(C))

    def prior(variance: np.ndarray) -> np.ndarray:
        P = np.diag(variance[full.kept]) + (M * variance[full.dropped]) @ M.T
        return P * np.outer(unit, unit)

    C, x = C * np.outer(unit, unit), x * unit
    parts = [prior(np.where(kind & ~FREE, s.sizes, 0.0) ** 2) for kind in kinds]
    others = ~FREE & ~np.logical_or.reduce(kinds)
    fixed = C + prior(np.where(FREE, 1e3 * s.sizes, np.where(others, s.sizes, 0.0)) ** 2)

    def whole(log: np.ndarray) -> np.ndarray:
        share = np.exp(2 * np.clip(log, -5, 5))  # beyond, a scale is zero, or none
        return fixed + np.tensordot(share, parts, 1)

    def cost(log: np.ndarray) -> float:
        L = np.linalg.cholesky(whole(log))
        z = np.linalg.solve(L, x)
        # A prior on log κ as wide as a factor of 50, so that one nobody sees ends somewhere.
        return float(0.5 * z @ z + np.log(np.diag(L)).sum() + 0.5 * np.sum((log / 4) ** 2))

    best = optimize.minimize(cost, np.zeros(len(parts)), method="BFGS")
    step = 1e-3 * np.eye(len(parts))
    mean = lambda log: x - C @ np.linalg.solve(whole(log), x)  # noqa: E731
    J = np.array([(mean(best.x + d) - mean(best.x - d)) / 2e-3 for d in step])
    left = C - C @ np.linalg.solve(whole(best.x), C) + J.T @ best.hess_inv @ J
    return mean(best.x) / unit, left / np.outer(unit, unit)


def drawn(errors: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """Geometry errors (n,) in m and rad."""
    few = np.where(rng.random(n) < 0.1, 5.0, 1 / 3) if errors == "few" else 1.0
    return GEOMETRY * rng.normal(size=n) * (3.0 if errors == "large" else few)


def campaign(s: Setting, full: Reduction, rng: np.random.Generator, found: dict, kind: str) -> None:
    errors = np.clip(rng.normal(size=len(FREE)), -2, 2) * SPRINGS * s.sizes
    errors = np.where(SPRING, errors, drawn(kind, len(FREE), rng))
    errors[FREE] = 0.0
    y = s.B @ errors + s.root @ rng.normal(size=len(s.B))

    def judge(
        name: str, chosen: Reduction, factor: float | None = None, kinds: list | None = None
    ) -> None:
        kept, dropped = chosen.kept, chosen.dropped
        x, C, dof = fitted(s.B[:, kept], y, s.true)
        if factor is not None:
            x, C = shrunk(s, chosen, x, C, factor)
        if kinds is not None:
            x, C = estimated(s, chosen, x, C, kinds)
        std = np.sqrt(np.diag(C))
        told = np.abs(chosen.mixing) * s.sizes[dropped] > 0.1 * std[:, None]
        truth = errors[kept] + np.where(told, chosen.mixing, 0.0) @ errors[dropped]
        t = [np.abs(x - truth) / std / stats.t.isf(p / 2, dof) <= 1 for p in (0.05, 0.0027)]
        B = s.new[:, kept]
        off = B @ x - s.new @ errors
        spread = np.sqrt(np.einsum("ij,jk,ik->i", B, C, B)) * stats.t.isf(0.025, dof)
        found[name].append(
            [len(x), t[0].sum(), t[1].sum(), SPRING[kept].sum(), t[0][SPRING[kept]].sum(),
             (off**2).mean(), (np.abs(off) <= spread).mean(), len(x) > len(least.kept)]
        )  # fmt: skip

    whitened = s.plain @ (y - s.B[:, full.kept] @ fitted(s.B[:, full.kept], y, s.plain)[0])
    sigma = np.linalg.norm(whitened) / np.sqrt(len(y) - len(full.kept))
    least = s.reduced(s.plain, sigma, 1.0)
    judge("complete set", full)
    judge("minimal set", least)
    judge("minimal set, by the weights of the noise", s.reduced(s.true, 1.0, 1.0))
    judge("wider where held out better", widened(s, y, least, tested=False))
    judge("wider where a test says so", widened(s, y, least, tested=True))
    judge("prior of typical size", full, 1.0)
    judge("… three times as wide", full, 3.0)
    judge("… a third as wide", full, 1 / 3)
    judge("prior, one scale of all geometry estimated", full, kinds=[~SPRING])
    judge("… a scale each: springs, offsets, angles, lengths", full, kinds=KINDS)


def main(scenario: str, arms: int, draws: int, errors: str = "typical") -> None:
    rng, found = np.random.default_rng(7), defaultdict(list)
    for number in range(arms):
        s = Setting(scenario, number)
        full = s.reduced(s.plain, 1.0, 0.0)
        for _ in range(draws):
            campaign(s, full, rng, found, errors)
    oracle = np.array(found["complete set"])[:, 5].mean()
    for name, rows in found.items():
        n, at95, at9973, springs, held, error, inside, wider = np.array(rows, dtype=float).T
        print(
            f"| {name} | {100 * at95.sum() / n.sum():.2f} / {100 * at9973.sum() / n.sum():.2f} | "
            f"{100 * held.sum() / springs.sum():.2f} | {np.sqrt(error.mean() / oracle):.3f} | "
            f"{100 * inside.mean():.2f} | {100 * wider.mean():.1f} % |"
        )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:])
