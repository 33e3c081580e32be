"""Encodings, delimiters, decimal marks, preambles, and robot programs as text."""

import numpy as np
import pytest
from support.tracker_exports import imported

from elastocal.errors import InputError
from elastocal.importing.foreign_text import ForeignText, program_rows, read_lines
from elastocal.units import convert, split_unit

ROWS = [(10.0, 20.5, -30.25, 1234.5, 0.125, -7.0), (11.0, 21.5, -31.25, -2234.5, 1.125, -8.0)]
NAMED = """
[[source]]
[source.columns]
q1_deg = "Achse 1"
q2_deg = "Achse 2"
q3_deg = "Achse 3"
x_mm = "X"
y_mm = "Y"
z_mm = "Z"
"""
HEADER = ["Achse 1", "Achse 2", "Achse 3", "X [mm]", "Y [mm]", "Z [mm]"]


def text_of(delimiter, decimal, header=HEADER, thousands=""):
    lines = [delimiter.join(header)]
    for row in ROWS:
        cells = [f"{v:,}".replace(",", thousands and "T").replace(".", decimal) for v in row]
        lines.append(delimiter.join(cells).replace("T", thousands))
    return "\n".join(lines) + "\n"


def check(found):
    expected = np.array(ROWS)
    np.testing.assert_allclose(np.degrees(found.table.q), expected[:, :3], rtol=1e-12)
    np.testing.assert_allclose(found.table.position * 1e3, expected[:, 3:], rtol=1e-12)


@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")],
)
def test_delimiters_and_decimal_marks(tmp_path, delimiter, decimal):
    check(imported(tmp_path, {"a.csv": text_of(delimiter, decimal)}, NAMED))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings(tmp_path, encoding):
    header = [f"{h.replace('Achse', 'Gelenkstück')}" for h in HEADER]
    mapping = NAMED.replace("Achse", "Gelenkstück")
    check(imported(tmp_path, {"a.csv": text_of(";", ",", header).encode(encoding)}, mapping))


@pytest.mark.parametrize(("thousands", "decimal"), [(".", ","), ("'", "."), (" ", ",")])
def test_thousands_separators(tmp_path, thousands, decimal):
    mapping = NAMED.replace("[source.columns]", f'[source.text]\nthousands = "{thousands}"\n'
                            "[source.columns]")  # fmt: skip
    check(imported(tmp_path, {"a.csv": text_of(";", decimal, thousands=thousands)}, mapping))


def test_preamble_repeated_headers_and_footers(tmp_path):
    lines = text_of(";", ".").splitlines()
    text = "\n".join(["Report; of today", "", *lines[:2], lines[0], lines[2], "2 points exported"])
    with pytest.raises(InputError, match=r"line 7: 1 columns.*ignore"):
        imported(tmp_path, {"a.csv": text}, NAMED)
    mapping = NAMED.replace("[source.columns]", "[source.text]\nignore = 'exported$'\n"
                            "[source.columns]")  # fmt: skip
    found = imported(tmp_path, {"a.csv": text}, mapping)
    check(found)
    assert [line for line, _ in found.understood[0].ignored] == [1, 5, 7]


def test_rows_without_a_value_are_left_out_by_name(tmp_path):
    text = text_of(";", ".") + "12;;13;1;2;3\n"
    found = imported(tmp_path, {"a.csv": text}, NAMED)
    check(found)
    assert found.understood[0].ignored == ((4, "no value in column Achse 2"),)


def program(text, kind):
    return program_rows(ForeignText("f", "ASCII", text.split("\n")), kind)


def test_krl_over_several_lines_in_logs_and_arrays():
    found = program("$AXIS_ACT={E6AXIS: A1 1.5, A2 -2E1,\n A3 3, A4 4, A5 5, A6 6}\n"
              "DECL AXIS P[2]={A1 7,A2 8,A3 9,A4 1,A5 2,A6 3} ; {A1 9}\nPOS Q={X 1,Y 2,Z 3}",
              "krl")  # fmt: skip
    assert found.header == ("name", "A1", "A2", "A3", "A4", "A5", "A6")
    assert [cells[:4] for _, cells in found.rows] == [
        ["$AXIS_ACT", "1.5", "-2E1", "3"], ["P[2]", "7", "8", "9"]
    ]  # fmt: skip
    assert found.rows[1][0] == 3
    assert found.ignored == [(4, "Q is a Cartesian position, not joint values")]


def test_rapid_arrays_robtargets_and_original_positions():
    found = program("PERS jointtarget j{2}:=[[[1,2,3,4,5,6],[1.5,9E9,9E9,9E9,9E9,9E9]],\n"
              "[[7,8,9,1,2,3],[2.5,9E9,9E9,9E9,9E9,9E9]]];\n"
              "CONST robtarget r:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
              "CONST o_jointtarget o_j:=[[0,0,0,0,0,0],[0,9E9,9E9,9E9,9E9,9E9]];",
              "rapid")  # fmt: skip
    assert [cells[0] for _, cells in found.rows] == ["j{1}", "j{2}"]
    assert found.header == ("name", *(f"rax_{i}" for i in range(1, 7)), "eax_a")
    assert [line for line, _ in found.ignored] == [3, 4]


@pytest.mark.parametrize("kind", ["krl", "rapid"])
def test_programs_without_joint_values(kind):
    with pytest.raises(InputError, match=r"^f: no "):
        program("MODULE x\nENDMODULE", kind)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty file"),
        (b"PK\x03\x04abc", "workbook"),
        (b"#ROSBAG V2.0\n", "bag"),
        (b"a\0\0\0\0b,c\0d", "NUL characters"),
    ],
)
def test_files_that_are_no_text(tmp_path, data, message):
    (tmp_path / "f").write_bytes(data)
    with pytest.raises(InputError, match=message):
        read_lines(tmp_path / "f")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("X [mm]", ("X", "mm")),
        ("Z (Millimeters)", ("Z", "mm")),
        ("A1 deg", ("A1", "deg")),
        ("x_m", ("x", "m")),
        ("Y, in", ("Y", "in")),
        ("Force N", ("Force", "N")),
        ("field.position0", ("field.position0", None)),
        ("[mm]", ("[mm]", None)),
        ("Point ID", ("Point ID", None)),
    ],
)
def test_units_in_headers(header, expected):
    assert split_unit(header) == expected


@pytest.mark.parametrize(
    ("values", "units"),
    [
        ([1.0, 360.0, 400.0, 2 * np.pi, 2000 * np.pi], ["rev", "deg", "gon", "rad", "mrad"]),
        ([1.0, 2.54, 25.4, 0.0254, 25400.0], ["in", "cm", "mm", "m", "um"]),
        ([1.0, 60.0, 3.6e3, 3.6e6, 3.6e9, 3.6e12], ["h", "min", "s", "ms", "us", "ns"]),
        ([20.0, 293.15, 68.0], ["C", "K", "F"]),
        ([2.5, 2500.0], ["kN", "N"]),
        ([2.0, 2000.0, 2e6], ["kNm", "Nm", "Nmm"]),
    ],
)
def test_the_same_in_every_unit(values, units):
    for value, unit in zip(values, units, strict=True):
        found = convert(np.array([value]), unit, units[0])
        np.testing.assert_allclose(found, values[0], rtol=1e-14)


def test_thousands_separators_that_nobody_told_of_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"a.csv, line 2, column X \[mm\].*'1.234,5'"):
        imported(tmp_path, {"a.csv": text_of(";", ",", thousands=".")}, NAMED)


def test_krl_expressions_are_no_values():
    with pytest.raises(InputError, match=r"f, line 1: A2 is 'B-1', not a number"):
        program("XP1={A1 1,A2 B-1,A3 2}", "krl")
