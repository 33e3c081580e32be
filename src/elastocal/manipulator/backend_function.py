"""A tape's CasADi function: as given, by content, and without repeated subexpressions."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property

import casadi as ca

# Finding common subexpressions takes 7 µs per instruction.  It saves 2 to 14 % of the instructions
# of B and 1 % of a Jacobian of 170 000, where it would take longer than all the rest.
LARGEST_REDUCED = 60_000


class TapeFunction:
    """Inputs → outputs as one CasADi function; what is derived from it is made on first use."""

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        self.function = ca.Function("tape", list(inputs), list(outputs))

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """(rows, columns) of every output."""
        f = self.function
        return [f.size_out(k) for k in range(f.n_out())]

    @property
    def sizes(self) -> list[int]:
        """Number of components of every input."""
        return [self.function.nnz_in(k) for k in range(self.function.n_in())]

    @property
    def n_instructions(self) -> int:
        return int(self.function.n_instructions())

    @cached_property
    def digest(self) -> str:
        """sha256 of the expressions themselves and of CasADi's version.

        Chain, cell, effects and whatever else an expression was built from are in it, so what is
        cached under it cannot be stale.
        """
        content = self.function.serialize()
        data = content.encode() if isinstance(content, str) else content
        return hashlib.sha256(casadi_version().encode() + b"\0" + data).hexdigest()

    @property
    def reduced(self) -> ca.Function:
        """The function with every subexpression evaluated once (the given one where it is huge)."""
        # The derivative code repeats the chain's products many times over.
        if self.n_instructions > LARGEST_REDUCED:
            return self.function
        symbols = self.function.sx_in()
        return ca.Function("tape", symbols, self.function.call(symbols), {"cse": True})


def casadi_version() -> str:
    """CasADi's version and the commit it was built from."""
    return f"{ca.CasadiMeta.version()} {ca.CasadiMeta.git_revision()}"


def row_by_row(sparsity: ca.Sparsity) -> list[int]:
    """Where each nonzero, in CasADi's order, stands in its matrix written row by row."""
    columns = sparsity.size2()
    return [r * columns + c for r, c in zip(sparsity.row(), sparsity.get_col(), strict=True)]
