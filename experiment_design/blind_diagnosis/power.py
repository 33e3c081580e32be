"""How often the true effect could be told from nothing at all, had only it been asked for."""

from __future__ import annotations

from collections.abc import Sequence

from records import Record
from scipy.stats import chi2, ncx2

LEVEL, CANDIDATES = 0.05, 90  # of the whole family, and about how many a diagnosis judges


def power(d: float, parameters: int) -> float:
    """Power of the χ² test of the true effect at its true settings and known noise.

    d² is what it adds to the weighted sum of squares, projected off the fitted parameters; the
    level is what Bonferroni leaves each of the candidates.
    """
    least = chi2.isf(LEVEL / CANDIDATES, parameters)
    return float(ncx2.sf(least, parameters, d**2)) if d > 0 else LEVEL / CANDIDATES


def observed(found: Sequence[Record]) -> str:
    """The share of these worlds in which something was found, beside that power."""
    told = [r["answer"] is not None and _something(r) for r in found]
    able = [
        power(r["distances"][0]["nothing"], len(r["truth"]["effects"][0]["values"])) for r in found
    ]
    n = len(found)
    return (
        f"Something was seen in {sum(told) / n:.3f} of {n} worlds. Had every candidate been tested "
        f"by itself with the noise and the settings known, at {LEVEL:.0%} for all {CANDIDATES} "
        f"together, the true effect would have been seen in {sum(able) / n:.3f}."
    )


def _something(r: Record) -> bool:
    return bool(r["answer"]["verdict"] != "nothing_significant")
