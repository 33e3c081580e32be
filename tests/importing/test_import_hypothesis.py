"""Whatever stands in files and mappings: a table that reads back, or an InputError."""

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.tracker_exports import imported

from elastocal.importing.assemble import dwells
from elastocal.messages import InputError

QUIET = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
MAPPING = """
[[source]]
[source.columns]
name = 1
q1_deg = 2
x_mm = 3
y_mm = 4
z_mm = 5
[source.names]
pattern = '^(?P<configuration>[^_]+)_(?P<marker>.+)$'
"""


PROGRAM = '[[source]]\nrole = "both"\npreset = "{}"\ncolumns = {{ x_mm = 2, y_mm = 3, z_mm = 4 }}\n'


@QUIET
@given(
    st.binary(max_size=200)
    | st.text(";,\t\n\"'. 0123456789ab_µ-", max_size=120).map(str.encode)
    | st.text('{}[](),;:=!."A1E6XYZ \n-+0189ax', max_size=80).map(str.encode),
    st.sampled_from([MAPPING, PROGRAM.format("kuka"), PROGRAM.format("abb")]),
)
def test_any_bytes_are_a_table_or_refused(data, mapping):
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = imported(Path(folder), {"a.csv": data}, mapping)
        except InputError as error:
            assert "a.csv" in str(error) or "the table" in str(error) or "data.csv" in str(error)
        else:
            assert len(found.table) >= 1


STEPS = st.lists(st.tuples(st.sampled_from([0.1, 0.5, 2.0]), st.integers(-2, 2),
                           st.integers(-1, 1)), min_size=1, max_size=40)  # fmt: skip


def plainly(time, q, still, shortest):
    """The longest runs from the start on, row by row, as the definition says."""
    found, start = [], 0
    while start < len(q):
        end = start
        while end + 1 < len(q) and (np.ptp(q[start : end + 2], axis=0) <= still).all():
            end += 1
        if end > start and time[end] >= time[start] + shortest:
            found.append((start, end))
            start = end
        start += 1
    return found


@settings(max_examples=300, deadline=None)
@given(STEPS, st.sampled_from([0.0, 1.0, 2.5]))
def test_dwells_are_as_the_definition_says_whatever_the_sampling(steps, shortest):
    time = np.cumsum([dt for dt, _, _ in steps])
    q = np.cumsum([(a, b) for _, a, b in steps], axis=0).astype(float)
    still = np.array([1.0, 0.0])
    first, last, standing = dwells(time, q, still, shortest)
    ends = list(zip(first, last, strict=True))
    assert ends == plainly(time, q, still, shortest)
    for (a, b), there in zip(ends, standing, strict=True):
        np.testing.assert_array_equal(there, np.median(q[a : b + 1], axis=0))
