"""pyDOE3's side of design_peers.py: its exchange on blocks that it is given, timed.

    OPENBLAS_NUM_THREADS=1 PEERS_PYTHON benchmarks/pydoe_exchange.py POOL.npz OUT.npz

Runs in the peers' environment and imports nothing of elastocal.  pyDOE3 knows polynomials of the
factors, and one row per candidate.  Its algorithms reach the model through two functions only,
the design matrix of a set of candidates and the moment matrix of the region; both are replaced,
so that a candidate is the number of a pose, its rows are the pose's whitened B, and criterion "I",
tr(moments · M⁻¹), is the test-pose criterion.  Everything else is pyDOE3's own code.

Its `alpha`, a small part of the mean information that keeps greedy starts regular, goes through
every row of the pool at every evaluation; here its rows are computed once.

POOL.npz: `blocks` (N, r, p), `C` (p, p), `n_poses`.  OUT.npz, for each method: `chosen` (n_poses,)
and its `wall` and `cpu` seconds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from fits_clock import Clock
from pyDOE3.doe_optimal import algorithms, utils

ALPHA = 1e-3
METHODS = {
    "simple_exchange": algorithms.simple_exchange_wynn_mitchell,
    "modified_fedorov": algorithms.modified_fedorov,
    "detmax": algorithms.detmax,
}


def main(pool: Path, out: Path) -> None:
    given = np.load(pool)
    blocks, C = given["blocks"], given["C"]
    rows = blocks.reshape(-1, blocks.shape[2])
    augmented = np.linalg.cholesky(ALPHA * rows.T @ rows / len(rows)).T

    def design_matrix(candidates: np.ndarray, degree: int) -> np.ndarray:
        chosen = blocks[candidates[:, 0].astype(int)]
        return np.vstack([augmented, chosen.reshape(-1, blocks.shape[2])])

    def moments(X0: np.ndarray) -> np.ndarray:
        return C

    for module in (algorithms, utils):
        module.build_design_matrix = design_matrix
        module.build_uniform_moment_matrix = moments
    numbers = np.arange(len(blocks), dtype=float)[:, None]
    results: dict[str, Any] = {}
    clock = Clock()
    for name, method in METHODS.items():
        with clock.step(name):
            design = method(numbers, int(given["n_poses"]), 1, "I")
        results[f"chosen_{name}"] = design[:, 0].astype(int)
    np.savez(out, **results, **clock.seconds)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
