"""What does it cost to take the correlation time of a drift for known?

    python experiment_design/arm_coverage/lasting.py ARMS DRAWS [LASTING]

The drifting campaigns of campaigns.py, linear about the true arm and in a minimal set of
parameters, readings drawn anew DRAWS times for each of ARMS campaigns, the drift lasting LASTING
of the campaign (0.2).  Prints how many predicted coordinates lie inside their 95 and 99.73 %, with
the correlation time that is the most likely, and with the mean over correlation times.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import campaigns
import numpy as np
from scipy import stats

from elastocal.identification import reduce
from elastocal.identification.noise_choice import estimate_noise, linearised, over_times
from elastocal.model import observe

MODEL = campaigns.arm()
COORDINATES = 100  # at new poses


def main(arms: int, draws: int, lasting: float = 0.2) -> None:
    campaigns.LASTING = lasting
    rng, found = np.random.default_rng(11), []
    for number in range(arms):
        campaign = campaigns.Campaign(campaigns.BY_KEY["drift"], number)
        B = MODEL.regressor(campaign.exact, campaign.true).B
        kept = reduce(B, MODEL.sizes(B), MODEL.parameters, campaigns.SIGMA, 1.0).kept
        observed = observe(campaign.exact, MODEL.observe)
        readings = linearised(MODEL, observed, campaign.true, kept)
        if readings.visits is None or not readings.visits.drifts:
            continue  # these poses happen to follow each other
        root = np.linalg.cholesky(campaign.covariance)
        new = MODEL.regressor(campaign.test, campaign.true, kept).B[:COORDINATES]
        for _ in range(draws):
            e = (root @ rng.normal(size=len(root))).reshape(readings.e.shape)
            one = estimate_noise(replace(readings, e=e), "independent+time")
            off = np.abs(new @ one.x)
            for fit in (one, over_times(one, replace(readings, e=e))):
                C = fit.covariance
                dof, share = C.tails(new[:, None])
                std = np.sqrt(share * ((new @ C.matrix) * new).sum(axis=1))
                t = [stats.t.isf(p / 2, dof) for p in (0.05, 0.0027)]
                found.append([(off <= q * std).mean() for q in t])
    held = 100 * np.array(found).reshape(-1, 2, 2)
    for k, name in enumerate(("the most likely", "the mean over all")):
        mean, spread = held[:, k].mean(axis=0), held[:, k].std(axis=0) / np.sqrt(len(held))
        print(f"| {name} | {len(held)} | {mean[0]:.1f} ± {spread[0]:.1f} / {mean[1]:.2f} |")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *map(float, sys.argv[3:]))
