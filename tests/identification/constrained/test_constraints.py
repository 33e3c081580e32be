"""Constraints by name: what they become as numbers, and what they refuse."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cells import kr270_cell

from elastocal.errors import InputError
from elastocal.identification.knowledge import (
    Bounds,
    Constraints,
    LinearEquality,
    SemidefiniteMatrix,
    equal,
    non_negative,
    physical_constraints,
)
from elastocal.model.arm import Parameter
from elastocal.model.manipulator import Model

NAMES = ("joint1.compliance", "joint2.compliance", "joint3.offset")


def _arm(*parameters):
    return SimpleNamespace(parameters=parameters)


def test_resolved_numbers_are_what_was_stated():
    system = Constraints(
        (Bounds("joint2.compliance", 0.0, 2.0), Bounds("joint2.compliance", upper=1.0)),
        (LinearEquality({"joint1.compliance": 1.0, "joint3.offset": 2.0}, 3.0),),
        (
            SemidefiniteMatrix(
                "K", (("joint1.compliance", {"joint2.compliance": 0.5, "": 4.0}),
                      ({"": 4.0, "joint2.compliance": 0.5}, 7.0)),
            ),
        ),
    ).resolve(NAMES)  # fmt: skip
    np.testing.assert_array_equal(system.lower, [-np.inf, 0.0, -np.inf])
    np.testing.assert_array_equal(system.upper, [np.inf, 1.0, np.inf])
    np.testing.assert_array_equal(system.A, [[1.0, 0.0, 2.0]])
    np.testing.assert_array_equal(system.b, [3.0])
    np.testing.assert_array_equal(
        system.matrices[0].at(np.array([2.0, 6.0, 9.0])), [[2, 7], [7, 7]]
    )
    assert system.equality_labels == ("joint1.compliance + 2·joint3.offset = 3",)


def test_equal_bounds_become_an_equality():
    system = Constraints((Bounds("joint3.offset", 0.25, 0.25),)).resolve(NAMES)
    assert np.isinf(system.lower).all() and np.isinf(system.upper).all()
    np.testing.assert_array_equal(system.A, [[0.0, 0.0, 1.0]])
    assert system.equality_labels == ("joint3.offset = 0.25",)


@given(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3),
    st.floats(0.1, 9.0), st.floats(-2, 2),
)  # fmt: skip
def test_moving_the_origin_and_unit_keeps_every_verdict(a, b, c, unit, centre):
    system = (
        non_negative(*NAMES[:2])
        + equal(NAMES[0], NAMES[1])
        + Constraints(matrices=(SemidefiniteMatrix("K", ((NAMES[0], NAMES[2]), (NAMES[2], 1.0))),))
    ).resolve(NAMES)
    x = np.array([a, b, c])
    moved = system.moved(np.full(3, centre), np.full(3, unit))
    z = (x - centre) / unit
    np.testing.assert_allclose(moved.lower * unit + centre, system.lower, atol=1e-12)
    np.testing.assert_allclose(moved.A @ z - moved.b, system.A @ x - system.b, atol=1e-12)
    D = np.diag(1 / moved.matrices[0].balance)
    np.testing.assert_allclose(
        D @ moved.matrices[0].at(z) @ D, system.matrices[0].at(x), atol=1e-12
    )


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Bounds("a", 1.0, 0.0), "leave no value"),
        (lambda: Bounds("a", np.nan), "leave no value"),
        (lambda: Bounds("a", np.inf), "leave no value"),
        (lambda: LinearEquality({"a": 0.0}), "non-zero"),
        (lambda: LinearEquality({"a": 1.0}, np.inf), "finite"),
        (lambda: SemidefiniteMatrix("K", (("a", "b"),)), "not square"),
        (lambda: SemidefiniteMatrix("K", (("a", "b"), ("c", "a"))), r"not symmetric.*\(2, 1\)"),
        (lambda: SemidefiniteMatrix("K", ((1.0,),)), "at least one parameter"),
        (lambda: non_negative("joint2.complaince").resolve(NAMES), "did you mean 'joint2.comp"),
        (lambda: equal("joint2.compliance", "joint9.compliance").resolve(NAMES), "equality"),
        (
            lambda: Constraints(matrices=(SemidefiniteMatrix("K", (("x",),)),)).resolve(NAMES),
            r"matrix 'K', entry \(1, 1\): 'x' is not a parameter",
        ),
        (
            lambda: Constraints(
                (Bounds(NAMES[0], lower=2.0), Bounds(NAMES[0], upper=1.0))
            ).resolve(NAMES),
            "contradict each other: at least 2 and at most 1",
        ),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(make, says):
    with pytest.raises(InputError, match=says):
        make()


def test_held_parameters_move_into_the_constants():
    system = Constraints(
        (Bounds("a", 0.0),),
        (LinearEquality({"a": 1.0, "b": 2.0}, 5.0), LinearEquality({"b": 1.0}, 1.5)),
        (SemidefiniteMatrix("K", (("a", "b"), ("b", "c"))),),
    ).resolve(("a", "b", "c"))
    free = system.restricted(np.array([0, 2]), np.array([9.0, 1.5, 9.0]))
    assert free.names == ("a", "c") and len(free.b) == 1
    np.testing.assert_array_equal(free.A, [[1.0, 0.0]])
    np.testing.assert_array_equal(free.b, [2.0])
    np.testing.assert_array_equal(free.matrices[0].at(np.array([1.0, 2.0])), [[1, 1.5], [1.5, 2]])
    with pytest.raises(InputError, match=r"'b = 1.5' does not hold .*held"):
        system.restricted(np.array([0, 2]), np.array([9.0, 1.4, 9.0]))
    with pytest.raises(InputError, match="a is held at -1, outside its bounds"):
        system.restricted(np.array([1, 2]), np.array([-1.0, 1.5, 9.0]))
    with pytest.raises(InputError, match="'K' is not positive semidefinite"):
        Constraints(matrices=system_matrix()).resolve(("a", "b", "c")).restricted(
            np.array([2]), np.array([1.0, 2.0, 0.0])
        )


def system_matrix():
    return (SemidefiniteMatrix("K", (("a", "b"), ("b", "a"))),)


def test_physics_of_an_arm_is_non_negative_compliances():
    model = Model(
        kr270_cell(("joint_offset", "joint_compliance", "off_axis_compliance", "base_compliance"))
    )
    demanded = physical_constraints(model)
    assert {b.name for b in demanded.bounds} == {n for n in model.names if "compliance" in n}
    assert all(b.lower == 0 and b.upper == np.inf for b in demanded.bounds)
    assert not demanded.matrices


def _compliance(name: str) -> Parameter:
    return Parameter(name, "effect", name.partition(".")[0], "rad/(N*m)", 0.0, None, lower=0.0)


def test_coupling_terms_make_a_matrix_with_the_drive_on_its_diagonal():
    keys = ("compliance", "off_axis_compliance_x", "off_axis_compliance_y",
            "off_axis_compliance_xy", "off_axis_compliance_xz")  # fmt: skip
    parameters = [
        Parameter(f"joint2.{k}", "e", "joint2", "rad/(N*m)", 0.0, None,
                  lower=-np.inf if k.endswith(("xy", "xz")) else 0.0)
        for k in keys
    ]  # fmt: skip
    demanded = physical_constraints(_arm(*parameters, _compliance("joint3.compliance")))
    (matrix,) = demanded.matrices
    x, y, xy, xz = (f"joint2.off_axis_compliance_{a}" for a in ("x", "y", "xy", "xz"))
    assert matrix.entries == ((x, xy, xz), (xy, y, 0.0), (xz, 0.0, "joint2.compliance"))
    assert [b.name for b in demanded.bounds] == ["joint3.compliance"]


def test_a_coupling_term_without_its_diagonal_is_refused():
    stated = ("base.tilt_compliance_x", "base.tilt_compliance_xy")
    with pytest.raises(InputError, match=r"base\.tilt_compliance_y is not a parameter"):
        physical_constraints(_arm(*map(_compliance, stated)))
