"""Whole fits beside those of FIGAROH and pybotics: same readings, times and held-out errors.

    python benchmarks/fits_peers.py [--peers-python PATH] [--quick] [--rounds N]

A UR10 with base and tool unknown, one marker, positions; 30, 100 and 300 random poses.  Every fit
runs in a process of its own, one after the other in turns, with one BLAS thread; of each number of
seconds the smallest of all rounds counts.  Errors are computed here, by one function for all, on
500 poses that no fit has seen.  The peers run in an environment of their own (README.md says how
to make it), named by --peers-python or ELASTOCAL_PEERS_PYTHON.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from bench_tools import peer, required, table, where
from fits_arm import TRUTHS, Campaign, campaign, write

SEED = 1
SIZES = (30, 100, 300)
GOAL = 10  # times as fast as FIGAROH, at the largest size
EQUAL = 1.01  # held-out error over theirs that counts as equal
STEPS = ("import", "read", "fit")


@dataclass(frozen=True)
class Contender:
    """A script and how it is to fit."""

    name: str
    script: str
    how: str

    @property
    def own(self) -> bool:
        return self.script == "fits_elastocal.py"


CONTENDERS = (
    Contender("elastocal: identify", "fits_elastocal.py", "auto"),
    Contender("elastocal: identify --method ols", "fits_elastocal.py", "ols"),
    Contender("elastocal: fit alone (API)", "fits_elastocal.py", "plain"),
    Contender("FIGAROH: structural (default)", "fits_figaroh.py", "structural"),
    Contender("FIGAROH: excitation", "fits_figaroh.py", "excitation"),
    Contender("FIGAROH: map", "fits_figaroh.py", "map"),
    Contender("pybotics: x, y, z of the error", "fits_pybotics.py", "components"),
)
JUDGED = [c for c in CONTENDERS if c.script == "fits_elastocal.py" and c.how != "ols"]


@dataclass
class Found:
    """What one contender found in all rounds: errors in µm, seconds by wall_STEP and cpu_STEP."""

    parameters: int = 0
    exact: float = 0.0
    read: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, ran: Any, given: Campaign) -> None:
        self.parameters = int(ran["parameters"])
        self.exact = _rms_um(ran["predicted"] - given.fresh_exact)
        self.read = _rms_um(ran["predicted"] - given.fresh_read)
        for key in (f"{clock}_{step}" for clock in ("wall", "cpu") for step in STEPS):
            self.seconds[key] = min(float(ran[key]), self.seconds.get(key, np.inf))


def _rms_um(error: np.ndarray) -> float:
    """Root mean square length of errors (n, 3) m, in µm."""
    return float(1e6 * np.sqrt((error**2).sum(axis=1).mean()))


def compared(
    given: Campaign, folder: Path, contenders: list[Contender], python: Path | None, rounds: int
) -> dict[Contender, Found]:
    found = {contender: Found() for contender in contenders}
    for _ in range(rounds):
        for contender in contenders:
            own = Path(sys.executable) if contender.own else python
            assert own is not None
            ran = peer(own, contender.script, contender.how, folder, folder / "found.npz")
            found[contender].add(ran, given)
    return found


def show(truth: str, poses: int, found: dict[Contender, Found]) -> None:
    columns = ("fit", "parameters", "held-out, exact, µm", "held-out, as read, µm", "fit, CPU s",
               "fit, wall s", "reading, CPU s", "import, CPU s")  # fmt: skip
    clocks = ("cpu_fit", "wall_fit", "cpu_read", "cpu_import")
    table(f"Truth {truth}, {poses} poses", columns, [
        (contender.name, row.parameters, f"{row.exact:.2f}", f"{row.read:.2f}",
         *(f"{row.seconds[clock]:.3f}" for clock in clocks))
        for contender, row in found.items()
    ])  # fmt: skip


def judged(found: dict[Contender, Found]) -> None:
    """Whether ours are GOAL times as fast as each of FIGAROH's, at equal or better error."""
    for ours in JUDGED:
        mine = found[ours]
        for theirs, row in found.items():
            if theirs.own:
                continue
            ratio = {c: row.seconds[f"{c}_fit"] / mine.seconds[f"{c}_fit"] for c in ("cpu", "wall")}
            goal = f"{GOAL} times as fast" if theirs.script == "fits_figaroh.py" else "faster"
            least = GOAL if theirs.script == "fits_figaroh.py" else 1
            required(
                f"{ours.name}, beside {theirs.name}: {goal}, at equal or better error",
                f"{ratio['cpu']:.1f} times (wall {ratio['wall']:.1f}), {mine.exact:.2f} against "
                f"{row.exact:.2f} µm",
                ratio["cpu"] >= least and mine.exact <= EQUAL * row.exact,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--peers-python",
        default=os.environ.get("ELASTOCAL_PEERS_PYTHON"),
        help="Python with FIGAROH and pybotics (default: ELASTOCAL_PEERS_PYTHON)",
    )
    parser.add_argument("--quick", action="store_true", help="one truth, 1 round")
    parser.add_argument("--rounds", type=int, help="how often each fit runs (default: 3)")
    parser.add_argument("--truth", choices=TRUTHS, help="one truth instead of both")
    parser.add_argument("--poses", type=int, nargs="+", help=f"default: {SIZES}")
    chosen = parser.parse_args()
    python = Path(chosen.peers_python) if chosen.peers_python else None
    if python is None:
        print(
            "FIGAROH and pybotics: skipped, no environment; give --peers-python PATH or set "
            "ELASTOCAL_PEERS_PYTHON (benchmarks/README.md says how to make it)"
        )
    elif not python.exists():
        parser.error(f"--peers-python: there is no {python}")
    rounds = chosen.rounds or (1 if chosen.quick else 3)
    if rounds < 1:
        parser.error(f"--rounds takes 1 or more; found {rounds}")
    truths = (chosen.truth,) if chosen.truth else TRUTHS[: 1 if chosen.quick else 2]
    sizes = tuple(chosen.poses or SIZES)
    contenders = [c for c in CONTENDERS if c.own or python is not None]
    print(where())
    with tempfile.TemporaryDirectory() as name:
        for truth in truths:
            for poses in sizes:
                folder = Path(name) / f"{truth}{poses}"
                given = campaign(truth, poses, SEED)
                write(given, folder)
                found = compared(given, folder, contenders, python, rounds)
                show(truth, poses, found)
                if poses == max(sizes):
                    judged(found)


if __name__ == "__main__":
    main()
