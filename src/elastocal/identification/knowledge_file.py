"""The knowledge file (TOML): its keys, and what they say of the parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import Field

from elastocal.config import Positive, Table, Text, checked, read_toml, required
from elastocal.errors import InputError, require
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    GaussianPrior,
    LinearEquality,
    SemidefiniteMatrix,
    physical_constraints,
)
from elastocal.model.manipulator import Model
from elastocal.text import quoted

Terms = Annotated[dict[Text, float], Field(min_length=1)]
FACTORS = (
    "factors by parameter, with names in quotes, as in "
    '{ "joint2.compliance" = 1.0, "joint3.compliance" = -1.0 }'
)


class PriorTable(Table):
    mean: float = required("a finite number in SI units")
    std: Positive = required("a positive number in SI units")


class BoundsTable(Table):
    parameter: Text = required('the name of a parameter, as in "joint2.compliance"')
    lower: float | None = Field(None, description="a finite number in SI units; without one, none")
    upper: float | None = Field(None, description="a finite number in SI units; without one, none")


class EqualityTable(Table):
    terms: Terms = required(FACTORS)
    value: float = Field(0.0, description="a finite number in SI units")
    label: str = Field("", description="a text")


class SemidefiniteTable(Table):
    entries: Annotated[list[list[str | float | dict[str, float]]], Field(min_length=1)] = Field(
        description="rows of parameter names, numbers or factors by parameter, as in "
        '[["a", "b"], ["b", "c"]]'
    )
    label: str = Field("", description="a text")


class KnowledgeTable(Table):
    physical: bool = Field(False, description="true or false")
    prior: dict[Text, PriorTable] = Field(
        default_factory=dict,
        description='tables by parameter, as in [prior."joint2.compliance"]',
    )
    bounds: list[BoundsTable] = Field(default_factory=list, description="[[bounds]] tables")
    equality: list[EqualityTable] = Field(default_factory=list, description="[[equality]] tables")
    semidefinite: list[SemidefiniteTable] = Field(
        default_factory=list, description="[[semidefinite]] tables"
    )


@dataclass(frozen=True)
class Knowledge:
    """What is known of the parameters besides the readings, in SI units.

    Attributes:
        physical: Adds the constraints that physics puts on the model: no negative compliance.
        constraints: Bounds, equalities and matrices.
        prior: A Gaussian prior.
        source: Where it was stated, for messages.

    Examples:
        >>> fit = ec.identify("cell.toml", "data.csv", knowledge=ec.Knowledge(physical=True))
        >>> fit["joint3.compliance"].ci95[0] > 0
        True
    """

    physical: bool = False
    constraints: Constraints = field(default_factory=Constraints)
    prior: GaussianPrior | None = None
    source: str = "knowledge"

    def of(self, model: Model) -> tuple[Constraints, GaussianPrior | None]:
        """Constraints and prior on the model's parameters.

        Raises InputError where a name is no parameter of the model, or bounds exclude each other.
        """
        constraints = self.constraints
        if self.physical:
            constraints = physical_constraints(model) + constraints
        try:
            constraints.resolve(model.names)
            if self.prior is not None:
                self.prior.rows(model.names)
        except InputError as error:
            raise InputError(f"{self.source}: {error}") from None
        return constraints, self.prior


def read_knowledge(path: str | Path) -> Knowledge:
    """What a knowledge file states (docs: file formats); names are checked by `Knowledge.of`.

    Raises InputError that names file, key, what the key takes and the nearest valid key.
    """
    path = Path(path)
    table = checked(KnowledgeTable, read_toml(path, "knowledge file"), path)
    try:
        return Knowledge(table.physical, _constraints(table), _prior(table), str(path))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _constraints(table: KnowledgeTable) -> Constraints:
    bounds = []
    for b in table.bounds:
        require(
            b.lower is not None or b.upper is not None,
            f"the bounds of {quoted(b.parameter)} state neither lower nor upper; state one",
        )
        lower = -math.inf if b.lower is None else b.lower
        bounds.append(Bounds(b.parameter, lower, math.inf if b.upper is None else b.upper))
    equalities = [LinearEquality(e.terms, e.value, e.label) for e in table.equality]
    matrices = [
        SemidefiniteMatrix(m.label or f"matrix {k}", tuple(tuple(row) for row in m.entries))
        for k, m in enumerate(table.semidefinite, start=1)
    ]
    return Constraints(tuple(bounds), tuple(equalities), tuple(matrices))


def _prior(table: KnowledgeTable) -> GaussianPrior | None:
    if not table.prior:
        return None
    stated = table.prior.values()
    return GaussianPrior.independent(
        tuple(table.prior), [p.mean for p in stated], [p.std for p in stated]
    )
