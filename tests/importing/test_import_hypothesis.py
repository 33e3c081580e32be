"""Whatever stands in files and mappings: a table that reads back, or an InputError."""

import tempfile
from datetime import datetime
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.tracker_exports import imported, krl, rapid

from elastocal.errors import InputError
from elastocal.importing.foreign_text import ForeignText, program_rows, seconds_of
from elastocal.importing.mapping_file import read_mapping

QUIET = settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
MAPPING = """
[[source]]
[source.text]
{text}
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
        text = "\n".join(lines).encode(encoding)
        found = imported(Path(folder), {"a.csv": text}, MAPPING.format(text=""))
    table = found.table
    expected = np.array([row[2:] for row in rows])
    np.testing.assert_allclose(np.degrees(table.q[:, 0]), expected[:, 0], atol=1e-9)
    np.testing.assert_allclose(table.position * 1e3, expected[:, 1:], atol=1e-9)
    labels = [table.configuration_labels[c] for c in table.configuration]
    assert labels == [row[0] for row in rows]


@QUIET
@given(
    st.binary(max_size=200) | st.text(";,\t\n\"'. 0123456789ab_µ-", max_size=120).map(str.encode)
)
def test_any_bytes_are_a_table_or_refused(data):
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = imported(Path(folder), {"a.csv": data}, MAPPING.format(text=""))
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
    import tomli_w

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mapping.toml"
        path.write_text(tomli_w.dumps(data), encoding="utf-8")
        try:
            read_mapping(path)
        except InputError as error:
            assert "mapping.toml" in str(error)


@QUIET
@given(st.text('{}[](),;:=!."A1E6XYZ \n-+0189ax', max_size=80))
def test_any_program_text_is_read_or_refused(text):
    for kind in ("krl", "rapid"):
        try:
            found = program_rows(ForeignText("f", "ASCII", text.split("\n")), kind)
        except InputError as error:
            assert str(error).startswith("f")
        else:
            assert found.rows and all(len(c) == len(found.header) for _, c in found.rows)


@QUIET
@given(st.lists(st.tuples(*[st.floats(-360, 360).map(lambda v: round(v, 3))] * 6),
                min_size=1, max_size=5))  # fmt: skip
def test_programs_hold_what_was_written(poses):
    q = np.array(poses)
    for text, kind in ((krl(q), "krl"), (rapid(q), "rapid")):
        found = program_rows(ForeignText("f", "ASCII", text.split("\n")), kind)
        values = [[float(cell) for cell in cells[1:7]] for _, cells in found.rows]
        np.testing.assert_array_equal(values, q)


@QUIET
@given(st.datetimes(min_value=datetime(1990, 1, 1)))
def test_times_are_seconds(moment):
    whole = moment.replace(microsecond=0)
    form = "%d.%m.%Y %H:%M:%S"
    later = whole.replace(second=(whole.second + 30) % 60)
    texts = [whole.strftime(form), later.strftime(form)]
    before, after = seconds_of("f", [1, 2], texts, [form])
    assert after - before == later.second - whole.second
    without, utc = seconds_of("f", [1, 2], [whole.isoformat(), whole.isoformat() + "Z"], [])
    assert without == utc
