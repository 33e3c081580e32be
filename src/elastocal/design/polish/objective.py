"""What a local search minimises over one pose, with its slope through the symbolic B."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from elastocal.design.information import PoseInformation
from elastocal.manipulator.symbolic import SymbolicArm
from elastocal.manipulator.symbolic_rows import configuration_rows
from elastocal.planning.criterion import Criterion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SymbolicBlocks:
    """Whitened, scaled B (S, r, p) of one pose as a smooth function of its joints q (n,).

    `B` and `adjoint` are CasADi functions as in `ConfigurationRows`; `scenarios` (S, parameters),
    `sizes` (p,), `whitener` (S, r, r), held while q moves.  It pickles.
    """

    B: ca.Function
    adjoint: ca.Function
    scenarios: Array
    sizes: Array
    whitener: Array

    def at(self, q: Array) -> Array:
        """Blocks (S, r, p) at q."""
        raw = np.stack([self.B(q, x).full() for x in self.scenarios])
        return np.asarray(self.whitener @ raw * self.sizes)

    def slope(self, q: Array, W: Array) -> Array:
        """∂/∂q (n,) of Σ_s ⟨W_s, blocks_s(q)⟩ for W (S, r, p)."""
        raw = self.whitener.transpose(0, 2, 1) @ W * self.sizes
        return np.asarray(
            sum(
                self.adjoint(q, x, w).full()[:, 0] for x, w in zip(self.scenarios, raw, strict=True)
            )
        )


def symbolic_blocks(information: PoseInformation, q: Array, load: int) -> SymbolicBlocks:
    """`information.blocks` of a pose near q (n,) in load state `load`, as an expression.

    The load state, and the level of a split joint, are those of q; so is the whitener.
    """
    model = information.model
    template = information.rows(q[None], np.array([load]), information.scenarios[0])
    symbolic = SymbolicArm(model.chain, model.cell)
    rows = configuration_rows(symbolic, template, information.columns)
    return SymbolicBlocks(
        rows.function,
        rows.adjoint,
        information.scenarios,
        information.sizes,
        information.whitener(q, load),
    )


def whitened_at(
    blocks: SymbolicBlocks, information: PoseInformation, q: Array, load: int
) -> SymbolicBlocks:
    """The same expression with the noise of a reading at q (n,)."""
    return replace(blocks, whitener=information.whitener(q, load))


class Goal(Protocol):
    """A figure of merit f of one pose's blocks B (S, r, p), to be minimised."""

    def value(self, B: Array) -> float:
        """f(B)."""

    def slope(self, B: Array) -> Array:
        """∂f/∂B (S, r, p)."""


@dataclass(frozen=True)
class PlanValue:
    """f = Φ(M + Σ BᵀB)/`unit`: the plan's value, M (S, p, p) the information of all else."""

    criterion: Criterion
    M: Array
    unit: float

    def value(self, B: Array) -> float:
        return float(self.criterion.value(self.M + B.transpose(0, 2, 1) @ B)) / self.unit

    def slope(self, B: Array) -> Array:
        G = self.criterion.gradient(self.M + B.transpose(0, 2, 1) @ B).G
        return np.asarray(-2 / self.unit * B @ G)


@dataclass(frozen=True)
class Sensitivity:
    """f = −d/`unit` with d = Σ_s tr(B_s G_s B_sᵀ), G (S, p, p): what a pose adds at the margin."""

    G: Array
    unit: float

    def value(self, B: Array) -> float:
        return -float(np.sum(B @ self.G * B)) / self.unit

    def slope(self, B: Array) -> Array:
        return np.asarray(-2 / self.unit * B @ self.G)
