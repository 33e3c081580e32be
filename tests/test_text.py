"""What is written as JSON is JSON, whatever numbers it is made of."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastocal.messages import cell_meaning, cell_text, is_label, json_text, printable
from elastocal.tables import NUMBER

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


def without_numbers_that_are_none(value):
    if isinstance(value, dict):
        return {k: without_numbers_that_are_none(v) for k, v in value.items()}
    if isinstance(value, list):
        return [without_numbers_that_are_none(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@given(ANYTHING)
def test_strict_json_that_reads_back_with_null_where_there_is_no_number(value):
    read = json.loads(json_text(value), parse_constant=pytest.fail)
    assert read == without_numbers_that_are_none(value)


@given(st.text(st.sampled_from("=+-@'1.5e,ab \u202e\x1bµ")))
def test_no_cell_of_text_is_a_formula_and_each_is_read_back(text):
    written = cell_text(text)
    assert NUMBER.fullmatch(written) or not written.startswith(("=", "+", "-", "@"))
    assert cell_meaning(written) == printable(text)
    assert not is_label(text) or printable(text) == text
