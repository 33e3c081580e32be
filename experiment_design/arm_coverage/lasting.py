"""What does it cost to take the correlation time of a drift for known?

    python experiment_design/arm_coverage/lasting.py ARMS DRAWS [LASTING]

The drifting campaigns of campaigns.py, linear about the true arm and in a minimal set of
parameters, readings drawn anew DRAWS times for each of ARMS campaigns, the drift lasting LASTING
of the campaign (0.2); `walk`: a random walk, counted from the first reading, by 60 µm in all.
Prints how many predicted coordinates lie inside their 95 and 99.73 %, with the true correlation
time taken for known, with the one that is the most likely, and with the mean over correlation
times; the error over that of the oracle, who knows the covariance; the held-out error over that of
a reading on another day; and how often each time is the most likely.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import campaigns
import numpy as np
from scipy import stats

from elastocal.identification.noise_choice import (
    NoiseFit,
    estimate_noise,
    linearised,
    over_times,
    weights_of,
)
from elastocal.identification.noise_structure import Readings
from elastocal.identification.residuals import as_of_another_campaign, held_out_residual
from elastocal.identification.solve import reduce
from elastocal.model.observations import observe

MODEL = campaigns.arm()
COORDINATES = 100  # at new poses
WALK = 60e-6  # m in each direction, from the first reading to the last


def main(arms: int, draws: int, lasting: str = "0.2") -> None:
    walks = lasting == "walk"
    campaigns.LASTING = 0.2 if walks else float(lasting)
    rng, found, chosen = np.random.default_rng(11), [], Counter()
    for number in range(arms):
        campaign = campaigns.Campaign(campaigns.BY_KEY["drift"], number)
        B = MODEL.regressor(campaign.exact, campaign.true).B
        kept = reduce(B, MODEL.sizes(B), MODEL.parameters, campaigns.SIGMA, 1.0).kept
        observed = observe(campaign.exact, MODEL.observe)
        readings = linearised(MODEL, observed, campaign.true, kept)
        if readings.visits is None or not readings.visits.drifts:
            continue  # these poses happen to follow each other
        V, square = campaign.covariance, campaigns.DRIFT**2
        if walks:
            t = campaign.exact.time / np.ptp(campaign.exact.time)
            V = np.kron(WALK**2 * np.minimum(t[:, None], t), np.eye(3))
            V, square = V + campaigns.SIGMA**2 * np.eye(len(V)), WALK**2 / 2
        root = np.linalg.cholesky(V)
        known = np.linalg.solve(root, B[:, kept])
        new = MODEL.regressor(campaign.test, campaign.true, kept).B[:COORDINATES]
        for _ in range(draws):
            e = root @ rng.normal(size=len(root))
            oracle = np.linalg.lstsq(known, np.linalg.solve(root, e), rcond=None)[0]
            one = replace(readings, e=e.reshape(readings.e.shape))
            stated = replace(readings.visits, lasting=(campaigns.LASTING,))
            of_truth = estimate_noise(replace(one, visits=stated), "independent+time")
            likeliest = estimate_noise(one, "independent+time")
            chosen[likeliest.lasting] += 1
            for fit in (of_truth, likeliest, over_times(likeliest, one)):
                C, off = fit.covariance, new @ fit.x
                dof, share = C.tails(new[:, None])
                std = np.sqrt(share * ((new @ C.matrix) * new).sum(axis=1))
                held = [
                    (np.abs(off) <= stats.t.isf(p / 2, dof) * std).mean() for p in (0.05, 0.0027)
                ]
                error = 3 * np.array([np.mean(off**2), np.mean((new @ oracle) ** 2)])
                reading = error[0] + 3 * (square + campaigns.SIGMA**2)
                found.append([*held, *error, held_out(one, fit), reading])
    first = "a fifth of the campaign" if walks else "the true one, known"
    ways = (first, "the most likely, taken for known", "the mean over five")
    each = np.array(found).reshape(-1, len(ways), 6)
    print("| correlation time | campaigns | 95 % / 99.73 % hold | error | held-out |")
    print("|" + "---|" * 5)
    for name, own in zip(ways, each.transpose(1, 0, 2), strict=True):
        held, spread = 100 * own[:, :2].mean(axis=0), 100 * own[:, 0].std() / np.sqrt(len(own))
        total = own.mean(axis=0)
        print(
            f"| {name} | {len(own)} | {held[0]:.1f} ± {spread:.1f} / {held[1]:.2f} | "
            f"{np.sqrt(total[2] / total[3]):.3f} | {np.sqrt(total[4] / total[5]):.3f}, median "
            f"{np.sqrt(np.median(own[:, 4] / own[:, 5])):.3f} |"
        )
    print(dict(sorted(chosen.items())))


def held_out(readings: Readings, fit: NoiseFit) -> float:
    """Mean square 3-D held-out error, as of another day."""
    B = readings.B.reshape(readings.e.size, -1)
    weights, residual = weights_of(fit, readings), readings.e.ravel() - B @ fit.x
    held = held_out_residual(B, residual, weights, readings.configuration, readings.size)
    held = held * as_of_another_campaign(B, weights, readings.size)
    return float((held.reshape(-1, 3) ** 2).sum(axis=1).mean())


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
