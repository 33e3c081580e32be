"""Properties of the measurement table that hold for any content."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from elastocal.measurements import Measurements, read_measurements, with_moves, write_measurements
from elastocal.messages import InputError, is_label

SETTINGS = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
KINDS = ("revolute", "revolute")
HEADER = "q1_rad,q2_rad,x_m,y_m,z_m\n"
FINITE = st.floats(allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=1e-300, max_value=1e300)
LABEL = st.text(max_size=8).filter(is_label)
# Of a load: none, or what an arm may carry; less than a micronewton is read as none.
FORCE = st.just(0.0) | st.floats(1e-3, 1e7) | st.floats(-1e7, -1e-3)


def read_or_refuse(path: Path, data: bytes) -> Measurements | None:
    path.write_bytes(data)
    try:
        return read_measurements(path, joint_kinds=KINDS)
    except InputError as error:
        assert path.name in str(error)
        return None


DIGITS = st.text("0123456789", min_size=1, max_size=30)
NUMBER = st.builds(
    lambda sign, whole, rest, exponent: f"{sign}{whole}{rest}{exponent}",
    st.sampled_from(["", "+", "-"]),
    DIGITS,
    st.just("") | DIGITS.map(".{}".format) | st.just("."),
    st.just("") | st.integers(-320, 270).map("e{}".format) | st.integers(0, 9).map("E+0{}".format),
)


@SETTINGS
@given(st.lists(NUMBER, min_size=5, max_size=5), st.sampled_from([".", ","]))
def test_every_decimal_number_is_read_to_the_nearest_float(tmp_path, numbers, mark):
    expected = [float(text) for text in numbers]
    assert all(map(math.isfinite, expected))
    text = HEADER.replace(",", ";") + ";".join(numbers).replace(".", mark)
    table = read_or_refuse(tmp_path / "data.csv", text.encode())
    assert table is not None
    assert [*table.q[0], *table.position[0]] == expected


@st.composite
def tables(draw):
    """Any table that can exist, with labels in order of first appearance."""
    n, joints = draw(st.integers(1, 5)), draw(st.integers(0, 3))

    def block(columns, elements=FINITE):
        shape = n if columns is None else (n, columns)
        return draw(arrays(np.float64, shape, elements=elements))

    def maybe(columns, elements=FINITE):
        return block(columns, elements) if draw(st.booleans()) else None

    configurations = tuple(draw(st.lists(LABEL, min_size=n, max_size=n, unique=True)))
    markers = tuple(draw(st.lists(LABEL, min_size=1, max_size=3, unique=True)))
    return Measurements(
        source="",
        row=np.arange(2, n + 2),
        q=block(joints),
        configuration=np.arange(n),
        configuration_labels=configurations,
        repeat=draw(arrays(np.int64, n, elements=st.integers(-(2**53), 2**53))),
        marker=draw(arrays(np.int64, n, elements=st.integers(0, len(markers) - 1))),
        marker_names=markers,
        force=block(3, FORCE),
        position=block(3),
        rotation=maybe(3),
        distance=maybe(None, POSITIVE),
        torque=maybe(joints) if joints else None,
        sigma=(sigma := maybe(3, POSITIVE)),
        sigma_frame=draw(st.sampled_from(["cartesian", "polar"])) if sigma is not None
        else "cartesian",
        time=maybe(None),
        approach=maybe(joints, st.sampled_from([-1.0, 0.0, 1.0])) if joints else None,
        temperature=maybe(None),
    )  # fmt: skip


@SETTINGS
@given(tables(), st.data())
def test_what_is_written_reads_back_bit_for_bit(tmp_path, table, data):
    joints = table.q.shape[1]
    kinds = tuple(
        data.draw(
            st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=joints, max_size=joints)
        )
    )
    path = tmp_path / "data.csv"
    table = replace(table, joint_kinds=kinds)
    write_measurements(table, path)
    again = read_measurements(path, joint_kinds=kinds, marker_names=table.marker_names)
    table = with_moves(table)  # what follows from the order of the rows is no column
    for name in vars(table):
        before, after = getattr(table, name), getattr(again, name)
        if isinstance(before, np.ndarray):
            assert before.tobytes() == after.tobytes(), name
        elif name != "source":
            assert before == after, name
