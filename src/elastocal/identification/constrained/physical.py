"""What physics demands of the parameters of a model."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from elastocal.errors import require
from elastocal.identification.constrained.constraints import (
    Bounds,
    Constraints,
    Entry,
    SemidefiniteMatrix,
)
from elastocal.manipulator.model import Model
from elastocal.manipulator.parameter import Parameter

AXES = ("x", "y", "z", "rx", "ry", "rz")
_ENDING = re.compile(r"(?P<stem>.+)_(?P<first>r?[xyz])(?P<second>r?[xyz])?")


def physical_constraints(model: Model) -> Constraints:
    """Passivity of the arm: bounds that effects state, and compliance matrices ⪰ 0.

    A spring cannot give energy away, so a compliance matrix K, θ = K M, has xᵀKx ≥ 0.  Where an
    effect has no coupling terms its matrix is diagonal, which is semidefinite exactly where its
    entries are non-negative: bounds say that (`ParameterSpec.lower`), and are solved exactly.
    """
    return passivity(model.parameters)


def passivity(parameters: Sequence[Parameter]) -> Constraints:
    """Bounds, and a matrix for every family of parameters with coupling terms.

    A family is `PLACE.STEM_x`, `PLACE.STEM_xy`, … of one effect: doubled axes (of x, y, z, rx,
    ry, rz) are off the diagonal.  At a joint, z is its own axis: where the family has no `_z`,
    the diagonal there is the drive's `PLACE.compliance`.  An entry that no parameter names is 0.
    """
    names = {p.name for p in parameters}
    families: dict[tuple[str, str], dict[frozenset[str], str]] = defaultdict(dict)
    for p in parameters:
        ending = _ENDING.fullmatch(p.name.partition(".")[2])
        if ending and "compliance" in ending["stem"]:
            axes = frozenset({ending["first"], ending["second"] or ending["first"]})
            families[p.where, ending["stem"]][axes] = p.name
    matrices = []
    for (where, stem), entries in families.items():
        coupled = [axes for axes in entries if len(axes) == 2]
        if not coupled:
            continue
        drive = f"{where}.compliance"
        if drive in names and any("z" in axes for axes in coupled):
            entries.setdefault(frozenset({"z"}), drive)
        used = [a for a in AXES if any(a in axes for axes in entries)]
        for axes in coupled:
            missing = [a for a in sorted(axes) if frozenset({a}) not in entries]
            require(
                not missing,
                f"{entries[axes]} couples an axis that has no compliance of its own: "
                f"{where}.{stem}_{''.join(missing[:1])} is not a parameter; add it to the effect",
            )
        matrices.append(_matrix(f"{where}.{stem}", used, entries))
    # A semidefinite matrix has a non-negative diagonal; saying it twice only blurs multipliers.
    implied = {str(m.entries[i][i]) for m in matrices for i in range(len(m.entries))}
    bounds = tuple(
        Bounds(p.name, p.lower, p.upper)
        for p in parameters
        if (np.isfinite(p.lower) and not (p.lower == 0 and p.name in implied))
        or np.isfinite(p.upper)
    )
    return Constraints(bounds=bounds, matrices=tuple(matrices))


def _matrix(label: str, axes: list[str], entries: dict[frozenset[str], str]) -> SemidefiniteMatrix:
    n = len(axes)
    cells: list[list[Entry]] = [[0.0] * n for _ in range(n)]
    for i, a in enumerate(axes):
        cells[i][i] = entries.get(frozenset({a}), 0.0)
    for (i, a), (j, b) in combinations(enumerate(axes), 2):
        cells[i][j] = cells[j][i] = entries.get(frozenset({a, b}), 0.0)
    return SemidefiniteMatrix(label, tuple(tuple(row) for row in cells))
