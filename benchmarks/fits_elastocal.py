"""elastocal's side of fits_peers.py: one fit, timed.

    python benchmarks/fits_elastocal.py auto|ols|plain FOLDER OUT.npz

`auto`: what `elastocal identify` does without options.  `ols`: the same with `--method ols`.
`plain`: only placing, choosing parameters, fitting and covariance, by the API; no held-out
residuals, faulty readings, noise models or diagnostics.
"""

from __future__ import annotations

import sys
from pathlib import Path

from fits_clock import Clock

clock = Clock()
with clock.step("import"):
    from dataclasses import replace

    import numpy as np

    from elastocal.identification.identify import identify
    from elastocal.identification.least_squares import Problem

    # What reading would import when first called.
    from elastocal.identification.options import Options
    from elastocal.identification.solve import settle, sizes_and_check
    from elastocal.identification.start import start_values
    from elastocal.identification.weighted_problem import Weights
    from elastocal.measurements import Measurements
    from elastocal.model.manipulator import Model
    from elastocal.model.observations import observe


def plain(model: Model, table: Measurements) -> tuple[np.ndarray, int]:
    """Values (parameters,) of least squares in a minimal complete set, and the size of that set."""
    observed = observe(table, model.observe)
    every = np.arange(len(model.parameters))
    weights = Weights("none", None, False, "")
    problem = Problem(model, observed, weights, start_values(model, table), every)
    _, found, reduction, *_ = settle(problem, sizes_and_check(problem))
    found.cofactor()
    return found.x, len(reduction.kept)


def main(how: str, folder: Path, out: Path) -> None:
    given = np.load(folder / "given.npz")
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
    n = len(given["fresh_q"])
    fresh = replace(table.take(np.zeros(n, dtype=np.int64)), q=given["fresh_q"])
    np.savez(out, predicted=model.predict(fresh, x).reshape(n, 3), parameters=p, **clock.seconds)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
