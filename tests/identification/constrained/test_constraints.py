"""Constraints by name: what they become as numbers, and what they refuse."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.cells import kr270_cell

from elastocal.errors import InputError
from elastocal.identification.knowledge import (
    physical_constraints,
)
from elastocal.model.arm import Parameter
from elastocal.model.manipulator import Model


def _arm(*parameters):
    return SimpleNamespace(parameters=parameters)


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
