"""How far off are estimates because the readings are not linear in the parameters?

    python experiment_design/arm_coverage/second_order.py SCENARIO FIRST NUMBER

Identifies NUMBER campaigns of campaigns.py from FIRST, with independent noise or one size per axis.
From the error of each estimate, what was dropped counted by its true value, goes what the noise
does in the first order; the rest is beside the room that its interval has for it (`solve.bent`).
Prints both as root mean squares over campaigns, in standard deviations, the largest first, and how
many of all intervals hold the truth.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import campaigns
import numpy as np
import study

from elastocal.identification import estimates
from elastocal.identification.identify import identify

MOST = 12  # lines


def main(key: str, first: int, number: int) -> None:
    model, seen, room_for = campaigns.arm(), {}, estimates.bent

    def kept(solution, covariance):  # type: ignore[no-untyped-def]
        seen["room"] = room_for(solution, covariance)
        seen["std"] = np.sqrt(np.diag(covariance))
        seen["solution"] = solution
        return seen["room"]

    estimates.bent = kept
    found, held = defaultdict(list), {True: [], False: []}
    for n in range(first, first + number):
        campaign = campaigns.Campaign(campaigns.BY_KEY[key], n)
        result = identify(model, campaign.table)
        error, std, dof = study.estimates(result, campaign.true)
        inside = study.holds(error, std, dof, 0.95)
        for name, holds in zip(result.determined, inside, strict=True):
            held[result[name].identifiable].append(holds)
        x, chosen = seen["solution"].fit.x, seen["solution"].reduction
        size = seen["solution"].sizes[chosen.kept]
        w = 1 / np.sqrt(np.diag(campaign.covariance))
        B = model.regressor(campaign.exact, x, chosen.kept).B * size * w[:, None]
        linear = size * np.linalg.lstsq(B, w * campaign.noise.ravel(), rcond=None)[0]
        away = campaign.true - x
        rest = -away[chosen.kept] - chosen.mixing @ away[chosen.dropped] - linear
        parts = np.column_stack([rest, seen["room"]]) / seen["std"][:, None]
        for k, both in zip(chosen.kept, parts, strict=True):
            found[model.names[k]].append(both)
    print("| estimate | campaigns | second order | room |\n" + "|---" * 4 + "|")
    rms = {name: np.sqrt(np.mean(np.square(both), axis=0)) for name, both in found.items()}
    often = [name for name in rms if 2 * len(found[name]) > number]
    for name in sorted(often, key=lambda name: -rms[name][0])[:MOST]:
        print(f"| {name} | {len(found[name])} | {rms[name][0]:.2f} | {rms[name][1]:.2f} |")
    for own, name in ((True, "parameters on their own"), (False, "combinations")):
        print(f"{name}: {100 * np.mean(held[own]):.1f} % of {len(held[own])} hold")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
