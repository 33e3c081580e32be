"""Do the intervals hold, and what does not knowing the noise cost?

    python study.py [--replicates 4000] [--jobs 2]

Every scenario of scenarios.py, estimated by elastocal's default, by an oracle that knows the
noise, by the paper's methods, by a robust fit and by OLS with a cluster-robust covariance.
Chunks of replicates are written to runs/ as they are done: stop and start as you like.  Prints the
tables and writes result.md.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from rich.progress import Progress
from scenarios import SCENARIOS, Scenario, Setting, setting
from tables import report

from elastocal.identification.covariance.cluster import cluster_robust
from elastocal.identification.published import eq14, ols
from elastocal.identification.robust.asymptotic import asymptotic_covariance
from elastocal.identification.robust.mm_estimate import mm_estimate
from elastocal.identification.variance.screen import screen
from elastocal.identification.variance.search import settle

HERE = Path(__file__).parent
CHUNK = 50
PUBLISHED_EVERY = 10  # thirty iterations of a weighted fit each: a tenth of the replicates do
METHODS = (
    "default", "oracle", "OLS, CR2", "OLS, eq. (8)", "eq. (14) by group",
    "eq. (14) per residual", "Tukey MM",
)  # fmt: skip


def estimates(s: Setting, replicate: int) -> np.ndarray:
    """(method, parameter, (error, std, dof)); NaN where a method was not run."""
    e, clean = s.draw(replicate)
    B, p = s.B, s.B.shape[1]
    found = np.full((len(METHODS), p, 3), np.nan)

    def put(method: str, x: np.ndarray, std: np.ndarray, dof: np.ndarray | float) -> None:
        found[METHODS.index(method)] = np.column_stack([x, std, np.broadcast_to(dof, p)])

    robust = mm_estimate(B, e, size=3)
    own = asymptotic_covariance(robust)
    put("Tukey MM", robust.x, own.std, own.dof)
    readings = s.readings(e)
    noise = settle(readings, good=screen(readings, robust.residual.reshape(-1, 3))).noise
    put("default", noise.x, noise.covariance.std, noise.covariance.dof)
    x, std = s.oracle(e, clean)
    put("oracle", x, std, np.inf)
    plain = ols(B, e)
    clustered = cluster_robust(B, plain.residual, np.repeat(s.configuration, 3))
    put("OLS, CR2", plain.x, clustered.std, clustered.dof)
    if replicate % PUBLISHED_EVERY == 0:
        group, last = eq14(B, e, s.group), eq14(B, e)[-1]
        put("OLS, eq. (8)", group[0].x, group[0].std, np.inf)
        put("eq. (14) by group", group[-1].x, group[-1].std, np.inf)
        put("eq. (14) per residual", last.x, last.std, np.inf)
    return found


def run_chunk(scenario: Scenario, first: int, folder: Path) -> None:
    path = folder / f"{scenario.key}_{first:06d}.npy"
    found = np.array([estimates(setting(scenario), first + k) for k in range(CHUNK)])
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as handle:
        np.save(handle, found)
    os.replace(temporary, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=4000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=HERE / "runs")
    chosen = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a process per core has no use for more
    chosen.folder.mkdir(exist_ok=True)
    firsts = range(0, chosen.replicates, CHUNK)
    wanted = [(s, first) for s in SCENARIOS for first in firsts]
    open_ = [(s, f) for s, f in wanted if not (chosen.folder / f"{s.key}_{f:06d}.npy").exists()]
    with Progress() as bar:
        task = bar.add_task("replicates", total=len(wanted), completed=len(wanted) - len(open_))
        runs = Parallel(chosen.jobs, return_as="generator_unordered")(
            delayed(run_chunk)(s, first, chosen.folder) for s, first in open_
        )
        for _ in runs:
            bar.advance(task)
    results = {
        s: np.concatenate([np.load(chosen.folder / f"{s.key}_{f:06d}.npy") for f in firsts])
        for s in SCENARIOS
    }
    text = report(results, METHODS)
    print(text)
    (HERE / "result.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
