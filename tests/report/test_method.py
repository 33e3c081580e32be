"""What the report says of constraints and priors: in the tables' units, and of intervals truly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from elastocal.identification.constrained import ActiveConstraint
from elastocal.report.method_and_noise import constraints_line, method_and_weights

AT_BOUND = (ActiveConstraint("joint2.compliance >= 0", "lower", ("joint2.compliance",), 0.0, 1.0),)


def held(case: Any, noise: dict[str, Any] | None = None, **fields: Any) -> Any:
    """The case's result as that of a constrained fit with one compliance at its bound."""
    noise = replace(case.result.noise, **(noise or {}))
    given = {"method": "constrained", "active": AT_BOUND} | fields
    return replace(case.result, noise=noise, **given)


def test_only_intervals_that_do_take_active_constraints_for_exact(case: Any) -> None:
    def line(kind: str) -> str:
        return constraints_line(held(case, noise={"interval_kind": kind})) or ""

    assert "take these for exact" in line("t under constraints")
    assert "stop at bounds" in line("constrained profile")
    assert "take these for exact" not in line("constrained profile")


@pytest.mark.parametrize(
    ("constraint", "words"),
    [
        (("joint2.offset <= 0.001", "upper", ("joint2.offset",), 1e-3), "joint2.offset ≤ 1 mrad"),
        (("joint2.offset = 0.001", "equality", ("joint2.offset",), 1e-3), "joint2.offset = 1 mrad"),
        (("as the maker says", "equality", ("joint2.offset",), 2.0), "as the maker says"),
        (("2·base.x = 0.1", "equality", ("base.x",), 0.1), "2·base.x = 0.1"),
        (("base.x - base.y = 0", "equality", ("base.x", "base.y"), 0.0), "base.x - base.y = 0"),
        (("inertia", "semidefinite", ("base.x",), 0.0), "inertia (semidefinite)"),
    ],
)
def test_constraints_in_the_units_of_the_tables(case: Any, constraint: Any, words: str) -> None:
    line = constraints_line(held(case, active=(ActiveConstraint(*constraint, 0.0),))) or ""
    assert line.startswith(f"Active: {words}. ")


def test_fit_with_knowledge_names_what_was_known_and_the_weights(case: Any) -> None:
    def line(**fields: Any) -> str:
        return method_and_weights(held(case, **{"active": ()} | fields))

    assert line(noise={"kind": "none"}) == "fit under constraints, all readings weighted alike"
    assert line().startswith("fit under constraints, weights estimated by restricted likelihood")
    assert line().endswith(case.result.noise.description)
    stated = {"sizes": None, "kind": "axis", "description": "tracker sigma 10 µm"}
    assert line(noise=stated) == "fit under constraints, tracker sigma 10 µm"
    assert line(prior_share={"a": 0.5}).startswith("fit with a prior, ")
    both = line(prior_share={"a": 0.5}, active=AT_BOUND)
    assert both.startswith("fit with a prior and under constraints, ")
