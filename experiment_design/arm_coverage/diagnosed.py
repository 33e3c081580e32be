"""Does `diagnose` take a drift for an effect?

    python experiment_design/arm_coverage/diagnosed.py FIRST NUMBER

The drifting campaigns of campaigns.py, NUMBER of them from FIRST, by the cell as it is and by one
whose [noise] states the drift.  Prints the verdicts, and what they name.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import campaigns
import numpy as np

from elastocal.cell.arm_description import Unsteadiness
from elastocal.diagnosis.diagnose import diagnose
from elastocal.model.manipulator import Model


def main(first: int, number: int) -> None:
    model, verdicts = campaigns.arm(), {False: Counter(), True: Counter()}
    for k in range(first, first + number):
        campaign = campaigns.Campaign(campaigns.BY_KEY["drift"], k)
        lasting = campaigns.LASTING * float(np.ptp(campaign.exact.time))
        noise = Unsteadiness(drift=campaigns.DRIFT, lasting=lasting)
        stated = Model.assembled(model.chain, replace(model.cell, noise=noise))
        for known, told in verdicts.items():
            found = diagnose(stated if known else model, campaign.table)
            told[" ".join([found.verdict, *sorted({e.effect for e in found.effects})])] += 1
    print("| the cell's [noise] | verdicts |\n|---|---|")
    for known, told in verdicts.items():
        each = ", ".join(f"{name} {n}" for name, n in told.most_common())
        print(f"| {'states the drift' if known else 'says nothing'} | {each} |")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
