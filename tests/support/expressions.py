"""Random expression trees as CasADi expressions of two variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import casadi as ca

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


def built(
    tree,
    symbols: Mapping[str, ca.SX],
    operations: Mapping[str, ca.SX],
    changed: Callable[[str, list[ca.SX]], list[ca.SX]] = lambda operation, parts: parts,
) -> ca.SX:
    """A tree of symbols' names, numbers and (operation, operand, ...) as an expression.

    `operations` are expressions in X, or in X and Y; `changed` may replace operands.
    """
    if isinstance(tree, str):
        return symbols[tree]
    if isinstance(tree, float):
        return ca.SX(tree)
    operation, *operands = tree
    parts = [built(operand, symbols, operations, changed) for operand in operands]
    parts = changed(operation, parts)
    return ca.substitute(
        operations[operation], ca.vertcat(*[X, Y][: len(parts)]), ca.vertcat(*parts)
    )
