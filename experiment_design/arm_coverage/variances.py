"""What does it cost that the noise's variances are estimated?

    python experiment_design/arm_coverage/variances.py ARMS DRAWS [SCENARIO] [KINDS …]

The campaigns of campaigns.py (by default those whose joints settle anew), linear about the true arm
and in a minimal set of parameters, readings drawn anew DRAWS times for each of ARMS campaigns.
Prints how many intervals of parameters, and of compliances alone, hold with the covariance of the
noise known, and with the variances of each of the KINDS of noise estimated ("stated+joints").
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import campaigns
import numpy as np
from scipy import stats

from elastocal.identification.noise_choice import estimate_noise, linearised
from elastocal.identification.solve import PLACED, is_placed, reduce
from elastocal.model.observations import observe

MODEL = campaigns.arm()
SPRING = np.array([p.effect == "joint_compliance" for p in MODEL.parameters])
# Of a whitened row of a fit by the stated noise alone, where the joints scatter besides.
ROUGHLY = 2.0


def main(arms: int, draws: int, scenario: str, kinds: list[str]) -> None:
    rng, found, chosen = np.random.default_rng(5), {}, Counter()
    for number in range(arms):
        campaign = campaigns.Campaign(campaigns.BY_KEY[scenario], number)
        B = MODEL.regressor(campaign.exact, campaign.true).B
        sizes = MODEL.sizes(np.abs(B))
        sizes[is_placed(MODEL)] = PLACED
        kept = reduce(B / campaigns.SIGMA, sizes, MODEL.parameters, ROUGHLY, 1.0).kept
        readings = linearised(MODEL, observe(campaign.exact, MODEL.observe), campaign.true, kept)
        root = np.linalg.cholesky(campaign.covariance)
        A = np.linalg.solve(root, B[:, kept])
        unit = 1 / np.linalg.norm(A, axis=0)
        half = np.linalg.inv(np.linalg.qr(A * unit, mode="r"))
        std = unit * np.sqrt((half**2).sum(axis=1))
        for _ in range(draws):
            e = root @ rng.normal(size=len(root))
            x = np.linalg.lstsq(A * unit, np.linalg.solve(root, e), rcond=None)[0] * unit
            held = {"known": np.abs(x) <= stats.norm.isf(0.025) * std}
            for kind in kinds:
                noise = estimate_noise(replace(readings, e=e.reshape(readings.e.shape)), kind)
                half_width = np.diff(noise.covariance.interval(noise.x), axis=1)[:, 0] / 2
                held[kind] = np.abs(noise.x) <= half_width
                chosen[noise.kind] += 1
            for name, inside in held.items():
                found.setdefault(name, []).append((inside.mean(), inside[SPRING[kept]].mean()))
    for name, rows in found.items():
        share = 100 * np.array(rows)
        mean, spread = share.mean(axis=0), share.std(axis=0) / np.sqrt(len(share))
        print(
            f"| {name} | {len(share)} | {mean[0]:.2f} ± {spread[0]:.2f} | "
            f"{mean[1]:.2f} ± {spread[1]:.2f} |"
        )
    print(dict(chosen))


if __name__ == "__main__":
    told = sys.argv[3:] or ["joints"]
    main(int(sys.argv[1]), int(sys.argv[2]), told[0], told[1:] or ["stated+joints"])
