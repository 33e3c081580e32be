"""Which rule to relax when next to nothing is feasible."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from elastocal.design.feasibility.frames import Kinematics
from elastocal.design.feasibility.rules import Rule
from elastocal.design.feasibility.verdict import Verdict

SAMPLE = 2000  # candidates whose causes are looked at


def advice(verdict: Verdict, rules: Sequence[Rule], kinematics: Kinematics) -> str:
    """The rule, or the smallest set of rules, that stops most candidates by itself.

    Among the sets of rules that candidates break, the smallest, and of these the one broken most
    often: dropping it frees as many candidates, and no smaller set frees any.
    """
    sets, which, counts = np.unique(verdict.broken, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    size = sets.sum(axis=1)
    stopped = np.flatnonzero(size > 0)
    tried, feasible = len(verdict.broken), int(verdict.ok.sum())
    head = f"{feasible} of {tried} candidates are feasible"
    if not len(stopped):
        return f"{head}; no rule removes any"
    best = stopped[np.lexsort((-counts[stopped], size[stopped]))[0]]
    chosen = [rule for rule, used in zip(rules, sets[best], strict=True) if used]
    rows = np.flatnonzero(which == best)[:SAMPLE]
    poses = kinematics.poses(verdict.q[rows], verdict.force[rows])
    names = " and ".join(f"'{rule.name}'" for rule in chosen)
    text = f"{head}; relax {names}, which {'alone stops' if len(chosen) == 1 else 'stop'} "
    text += f"{counts[best]} of them: "
    return text + "; ".join(rule.remedy(poses) for rule in chosen)
