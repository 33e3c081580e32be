"""plan.csv and plan.json: read back exactly, and taken by simulate and identify."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.cells import kr270_chain

from elastocal.measurements import DEFAULT_MARKER, Measurements, read_measurements
from elastocal.planning.plan import write_plan
from elastocal.text import is_label

KINDS = kr270_chain().kinds
joint_values = st.floats(-6.3, 6.3) | st.sampled_from([0.0, -0.0, np.pi, 1e-12, -1e-300])
labels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=12).filter(is_label)
# What is less than a micronewton is read as no load.
forces = st.just(0.0) | st.floats(1e-3, 1e5) | st.floats(-1e5, -1e-3)


def plan_of(names, q, kinds, force=None, approach=None):
    """A plan's table, a row per configuration."""
    n = len(names)
    return Measurements(
        source="plan", row=np.arange(n) + 2, q=q, configuration=np.arange(n),
        configuration_labels=tuple(names), repeat=np.zeros(n, dtype=int),
        marker=np.zeros(n, dtype=int), marker_names=(DEFAULT_MARKER,),
        force=np.zeros((n, 3)) if force is None else np.reshape(force, (n, 3)),
        approach=None if approach is None else np.reshape(approach, q.shape).astype(float),
        joint_kinds=tuple(kinds),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_what_is_written_is_read_back(tmp_path_factory, data):
    kinds = data.draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=4, max_size=9))
    names = data.draw(st.lists(labels, min_size=1, max_size=8, unique=True))
    n, joints = len(names), len(kinds)
    numbers = st.lists(joint_values, min_size=n * joints, max_size=n * joints)
    q = np.array(data.draw(numbers)).reshape(n, joints)
    drawn = st.lists(forces, min_size=3 * n, max_size=3 * n)
    force = data.draw(st.none() | drawn)
    signs = st.lists(st.sampled_from([-1, 1]), min_size=n * joints, max_size=n * joints)
    approach = data.draw(st.none() | signs)
    rows = plan_of(names, q, kinds, force, approach)
    path = tmp_path_factory.mktemp("plan") / "plan.csv"
    write_plan(path, rows, {"note_order_2": ["x"] * n}, forces=force is not None)
    plan = read_measurements(path, joint_kinds=tuple(kinds), observe="plan")
    assert np.allclose(plan.q, q, rtol=0, atol=1e-9)
    assert [plan.configuration_labels[k] for k in plan.configuration] == names
    assert np.array_equal(plan.force, rows.force)
    assert (
        plan.approach is None if approach is None else np.array_equal(plan.approach, rows.approach)
    )
