"""What every table that people hand us has in common: comments, empty cells, headers, and CSV."""

import csv
import io
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from elastocal.messages import InputError, cell_text
from elastocal.tables import NO_UNIT, Family, csv_text, match_columns, read_table

FAMILIES = {family.name: family for family in (
    Family("name", "names", {"name": NO_UNIT}, is_label=True, optional=("name",)),
    Family("place", "places", {"x": ("mm", "m"), "y": ("mm", "m")}),
    Family("end", "ends", dict.fromkeys(("low", "high"), ("N",)), optional=("low", "high")),
)}  # fmt: skip


def read(text, **options):
    def choose(header):
        return match_columns("t.csv", header, FAMILIES, [("place",)], "this table needs")

    return read_table("t.csv", choose, what="list", text=text, **options)


def test_cells_may_be_empty_where_the_column_may_be_absent_and_only_there():
    table = read("name;x_m;y_m;high_N\n;1,5;2;\nb;3;4;5\n")
    assert table.text(0, "name") == ""
    assert math.isnan(table.numbers["high_N"][0]) and table.numbers["high_N"][1] == 5
    assert table.numbers["x_m"].tolist() == [1.5, 3]
    assert table.column("end", "low") is None
    with pytest.raises(InputError, match=r"^t.csv, line 2, column y_m: empty cell"):
        read("x_m,y_m,high_N\n1,,3\n")


def test_a_minus_of_text_programs_is_one_of_numbers_and_stays_as_written_in_labels():
    table = read("sep=;\nname;x_m;y_m\n−1;−1,5;–2\n")
    assert table.text(0, "name") == "−1"
    assert (table.numbers["x_m"][0], table.numbers["y_m"][0]) == (-1.5, -2)


CELL = st.text(st.characters(exclude_categories=("Cc", "Cs")), max_size=5)


@given(st.lists(st.lists(CELL, min_size=2, max_size=2), max_size=5))
def test_what_is_written_is_csv_whatever_the_cells(rows):
    text = csv_text(["a", "b"], rows, comments=["made by hand"])
    assert text.startswith("# made by hand\na,b\n")
    found = list(csv.reader(io.StringIO(text, newline=""), strict=True))[2:]
    assert found == [[cell_text(cell) for cell in row] for row in rows]
