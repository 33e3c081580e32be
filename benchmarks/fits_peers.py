"""Whole fits beside those of FIGAROH and pybotics: same readings, times and held-out errors.

    python benchmarks/fits_peers.py [--quick]

A UR10 with base and tool unknown, one marker, positions; 30, 100 and 300 random poses.  Every fit
runs in a process of its own, one after the other in turns, with one BLAS thread; of each number of
seconds the smallest of all rounds counts.  Errors are computed here, by one function for all, on
500 poses that no fit has seen.  The peers run in the environment of ELASTOCAL_PEERS_PYTHON
(README.md says how to make it).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from bench_tools import peer, required, table, where
from fits_arm import TRUTHS, Campaign, campaign, write

SEED = 1
SIZES = (30, 100, 300)
GOAL = 10  # times as fast as FIGAROH, at the largest size
EQUAL = 1.01  # held-out error over theirs that counts as equal
OURS, FIGAROH, PYBOTICS = "fits_elastocal", "fits_figaroh", "fits_pybotics"
CONTENDERS = {
    "elastocal: identify": (OURS, "auto"),
    "elastocal: identify --method ols": (OURS, "ols"),
    "elastocal: fit alone (API)": (OURS, "plain"),
    "FIGAROH: structural (default)": (FIGAROH, "structural"),
    "FIGAROH: excitation": (FIGAROH, "excitation"),
    "FIGAROH: map": (FIGAROH, "map"),
    "pybotics: x, y, z of the error": (PYBOTICS, "components"),
}  # name → its side, and how it is to fit
JUDGED = ("elastocal: identify", "elastocal: fit alone (API)")
CLOCKS = ("cpu_fit", "wall_fit", "cpu_read", "cpu_import")
Found = dict[str, Any]  # parameters; errors in µm, exact and as read; seconds of CLOCKS


def rms_um(error: np.ndarray) -> float:
    """Root mean square length of errors (n, 3) m, in µm."""
    return float(1e6 * np.sqrt((error**2).sum(axis=1).mean()))


def fitted(name: str, given: Campaign, folder: Path, before: Found | None) -> Found:
    """One more round of a fit, with the least seconds so far."""
    side, how = CONTENDERS[name]
    ran = peer("fits_side.py", side, how, folder, folder / "found.npz", own=side == OURS)
    return {
        "parameters": int(ran["parameters"]),
        "exact": rms_um(ran["predicted"] - given.fresh_exact),
        "read": rms_um(ran["predicted"] - given.fresh_read),
    } | {clock: min(float(r[clock]) for r in (ran, before or ran)) for clock in CLOCKS}


def judged(found: dict[str, Found]) -> None:
    """Whether ours are GOAL times as fast as each of FIGAROH's, at equal or better error."""
    for ours in JUDGED:
        mine = found[ours]
        for name, theirs in found.items():
            side, _ = CONTENDERS[name]
            if side == OURS:
                continue
            cpu, wall = (theirs[clock] / mine[clock] for clock in ("cpu_fit", "wall_fit"))
            goal, least = (f"{GOAL} times as fast", GOAL) if side == FIGAROH else ("faster", 1)
            required(
                f"{ours}, beside {name}: {goal}, at equal or better error",
                f"{cpu:.1f} times (wall {wall:.1f}), {mine['exact']:.2f} against "
                f"{theirs['exact']:.2f} µm",
                cpu >= least and mine["exact"] <= EQUAL * theirs["exact"],
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one truth, one round")
    quick = parser.parse_args().quick
    columns = ("fit", "parameters", "held-out, exact, µm", "held-out, as read, µm", "fit, CPU s",
               "fit, wall s", "reading, CPU s", "import, CPU s")  # fmt: skip
    print(where())
    for truth in TRUTHS[: 1 if quick else 2]:
        for poses in SIZES:
            given, found = campaign(truth, poses, SEED), dict[str, Found]()
            with tempfile.TemporaryDirectory() as folder:
                write(given, Path(folder))
                for _ in range(1 if quick else 3):
                    for n in CONTENDERS:
                        found[n] = fitted(n, given, Path(folder), found.get(n))
            table(f"Truth {truth}, {poses} poses", columns, [
                (n, f["parameters"], f"{f['exact']:.2f}", f"{f['read']:.2f}",
                 *(f"{f[clock]:.3f}" for clock in CLOCKS))
                for n, f in found.items()
            ])  # fmt: skip
        judged(found)


if __name__ == "__main__":
    main()
