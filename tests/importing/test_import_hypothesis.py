"""Whatever stands in files and mappings: a table that reads back, or an InputError."""

import tempfile
from pathlib import Path

import numpy as np
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.tracker_exports import imported

from elastocal.errors import InputError
from elastocal.importing.joining import dwells

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
NUMBER = st.floats(-1e5, 1e5).map(lambda v: round(v, 4))
LABEL = st.text("abcXYZ0123-. µé", min_size=1, max_size=6).map(str.strip).filter(bool)
ROWS = st.lists(st.tuples(LABEL, LABEL, *[NUMBER] * 4), min_size=1, max_size=6)


@QUIET
@given(ROWS, st.sampled_from(";\t"), st.sampled_from(".,"), st.sampled_from(["utf-8", "utf-16"]))
def test_what_was_written_is_read(rows, delimiter, decimal, encoding):
    lines = [
        delimiter.join([f'"{c}_{m}"', *(f"{v:.4f}".replace(".", decimal) for v in numbers)])
        for c, m, *numbers in rows
    ]
    with tempfile.TemporaryDirectory() as folder:
        found = imported(Path(folder), {"a.csv": "\n".join(lines).encode(encoding)}, MAPPING)
    table = found.table
    expected = np.array([row[2:] for row in rows])
    np.testing.assert_allclose(np.degrees(table.q[:, 0]), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(table.position * 1e3, expected[:, 1:], atol=1e-9)
    labels = [table.configuration_labels[c] for c in table.configuration]
    assert labels == [row[0] for row in rows]


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


VALUE = st.recursive(
    st.booleans() | st.integers(-3, 9) | st.text("ab#_|x", max_size=4) | st.floats(-2, 2),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text("ab", max_size=2), inner, max_size=2)
    ),
    max_leaves=4,
)  # fmt: skip
KEYS = st.sampled_from(
    ["source", "columns", "preset", "text", "names", "join", "joints", "loads", "x_mm", "sign",
     "coupling", "by", "pattern", "files", "units", "full", "decimal"]
)  # fmt: skip
TABLES = (
    VALUE
    | st.dictionaries(KEYS, VALUE, max_size=3)
    | st.lists(st.dictionaries(KEYS, VALUE, max_size=3), max_size=2)
)


@QUIET
@given(st.dictionaries(KEYS, TABLES, max_size=4))
def test_any_mapping_is_read_or_refused_by_name(data):
    with tempfile.TemporaryDirectory() as folder:
        try:
            imported(Path(folder), {}, tomli_w.dumps(data))
        except InputError as error:
            assert "mapping.toml" in str(error) or "no files" in str(error)


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
