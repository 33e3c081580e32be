"""elastocal's side of fits_peers.py.

`auto`: what `elastocal identify` does without options.  `ols`: the same with `--method ols`.
`plain`: only placing, choosing parameters, fitting and covariance, by the API; no held-out
residuals, faulty readings, noise models or diagnostics.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_tools import Clock

from elastocal.identification.identify import identify
from elastocal.identification.solve import posed, solve
from elastocal.identification.start import Options, start_values
from elastocal.identification.weighted_problem import Weights
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe


def plain(model: Model, table: Measurements) -> tuple[np.ndarray, int]:
    """Values (parameters,) of least squares in a minimal complete set, and the size of that set."""
    observed = observe(table, model.observe)
    every = np.arange(len(model.parameters))
    weights = Weights("none", None, False, "")
    problem = posed(model, observed, weights, start_values(model, table), every)
    found = solve(problem, try_wider=False)
    found.fit.r_factor.half  # noqa: B018, of which the covariance is made
    return found.fit.x, len(found.reduction.kept)


def fit(how: str, folder: Path, clock: Clock) -> tuple[np.ndarray, int]:
    with clock.step("read"):
        model = Model(folder / "cell.toml")
        table = model.read(folder / "data.csv")
        model = model.with_markers_of(table)
    with clock.step("fit"):
        if how == "plain":
            x, p = plain(model, table)
        else:
            result = identify(model, table, Options(method=how))
            x, p = result.x, len(result.determined)
    q = np.load(folder / "given.npz")["fresh_q"]
    fresh = replace(table.take(np.zeros(len(q), dtype=np.int64)), q=q)
    return model.predict(fresh, x).reshape(-1, 3), p
