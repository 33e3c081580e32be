"""Is an arm that the verdict trusts at X µm as good as that where nobody measured?

elastocal study experiment_design/verdict [--set campaigns=200]
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from judged_campaigns import campaign

from elastocal.errors import ElastocalError
from elastocal.identification.identify import identify
from elastocal.identification.residuals import rms_3d
from elastocal.model.observations import observe

NUMBERS = (
    "at_um", "true_um", "heldout_um", "predicted_um", "from_um", "own_um", "open_um", "lacking_um",
)  # fmt: skip
ALLOWED = 1.25  # the true error over what the verdict says


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for number in range(options["campaigns"]):
        yield {"number": number}


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """What the verdict says of a campaign, and what is true; `rng` is not used."""
    made = campaign(task["number"])
    unknown = dict.fromkeys(NUMBERS, np.nan)
    row: dict[str, Any] = made.kind | {"refused": "", "tone": "", "missing": ""} | unknown
    try:
        fit = identify(made.model, made.table)
    except ElastocalError as error:
        return row | {"refused": str(error)[:200]}
    new = observe(made.exact, fit.model.observe)
    true = rms_3d(fit.model.predict(made.exact, fit.x, new) - new.value, new.size) * 1e6
    verdict, found = fit.verdict.to_json(), fit.predicted
    if found is not None:
        low = found.ci95[0]
        parts = (found.rms, low, found.parameters, found.open, found.lacking or 0.0)
        row |= dict(zip(NUMBERS[3:], (1e6 * v for v in parts), strict=True))
    return row | {
        "tone": verdict["tone"], "at_um": verdict["at_um"],
        "missing": ",".join(verdict["missing"]), "true_um": true,
        "heldout_um": fit.heldout_rms * 1e6,
    }  # fmt: skip


def summary(frame: pd.DataFrame) -> str:
    """The table of the README."""
    judged = frame[frame["refused"] == ""].copy()
    judged["worse"] = judged["true_um"] / judged["at_um"]
    lines = ["| verdict | campaigns | true error below 1.25 X | true error / X, median | 95 % |",
             "|---|---|---|---|---|"]  # fmt: skip
    for tone, name in (("good", "trusted at X"), ("care", "with care"), ("poor", "not to be used")):
        some = judged[judged["tone"] == tone]["worse"].dropna()
        if len(some):
            share = f"{100 * (some < ALLOWED).mean():.1f} % ({int((some < ALLOWED).sum())})"
            lines.append(
                f"| {name} | {len(some)} | {share} | {some.median():.2f} | "
                f"{some.quantile(0.95):.2f} |"
            )
    return "\n".join(lines)
