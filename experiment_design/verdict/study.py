"""Is an arm that the verdict trusts at X µm as good as that where nobody measured?

elastocal study experiment_design/verdict [--set campaigns=200]
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from campaigns import campaign

from elastocal.errors import ElastocalError
from elastocal.identification import rms_3d
from elastocal.identification.identify import identify
from elastocal.model import observe

ALLOWED = 1.25  # the true error over what the verdict says


def tasks(options: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for number in range(options["campaigns"]):
        yield {"number": number}


def run(task: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """What the verdict says of a campaign, and what is true; `rng` is not used."""
    made = campaign(task["number"])
    row: dict[str, Any] = dict(made.kind)
    try:
        fit = identify(made.model, made.table)
    except ElastocalError as error:
        return row | {"refused": str(error)[:200]}
    new = observe(made.exact, fit.model.observe)
    true = rms_3d(fit.model.predict(made.exact, fit.x, new) - new.value, new.size) * 1e6
    verdict, found = fit.verdict.to_json(), fit.predicted
    return row | {
        "refused": "", "tone": verdict["tone"], "at_um": verdict["at_um"],
        "missing": ",".join(verdict["missing"]), "true_um": true,
        "heldout_um": fit.heldout_rms * 1e6,
        "predicted_um": np.nan if found is None else found.rms * 1e6,
        "from_um": np.nan if found is None else found.ci95[0] * 1e6,
        "open_um": np.nan if found is None else found.open * 1e6,
        "lacking_um": np.nan if found is None else 1e6 * (found.lacking or 0.0),
        "own_um": np.nan if found is None else found.parameters * 1e6,
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
