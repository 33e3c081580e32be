"""The knowledge file: what is known of the parameters besides the readings (TOML)."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from elastocal.errors import InputError, require
from elastocal.files import read_text
from elastocal.identification.constrained.constraints import (
    Bounds,
    Constraints,
    LinearEquality,
    SemidefiniteMatrix,
)
from elastocal.identification.constrained.physical import physical_constraints
from elastocal.identification.constrained.prior import GaussianPrior
from elastocal.identification.knowledge_schema import KnowledgeTable, complaint
from elastocal.manipulator.model import Model
from elastocal.nearest import quoted

MAX_BYTES = 5_000_000


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
    text = read_text(path, "knowledge file", MAX_BYTES)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deeply for a knowledge file") from None
    try:
        table = KnowledgeTable.model_validate(data)
    except ValidationError as error:
        raise complaint(path, data, error) from None
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
