"""Encodings, delimiters, marks of numbers, preambles, robot programs, and units in headers."""

import numpy as np
import pytest
from support.tracker_exports import imported

from elastocal.messages import InputError
from elastocal.units import convert, split_unit

ROWS = [(10.0, 20.5, -30.25, 1234.5, 0.125, -7.0), (11.0, 21.5, -31.25, -2234.5, 1.125, -8.0)]
HEADER = ["Punkt", *(f"Gelenkstück{i}" for i in (1, 2, 3)), "X[mm]", "Y[mm]", "Z[mm]"]
MAPPING = """
[[source]]
[source.text]
{text}
[source.columns]
"q#_deg" = "Gelenkstück#"
x_mm = "X"
y_mm = "Y"
z_mm = "Z"
"""


def text_of(delimiter, decimal, thousands=""):
    lines = [delimiter.join(HEADER)]
    for row in ROWS:
        cells = [f"{v:,}".replace(",", thousands and "T").replace(".", decimal) for v in row]
        lines.append(delimiter.join(["links 1", *cells]).replace("T", thousands))
    return "\n".join(lines) + "\n"


def check(found):
    expected = np.array(ROWS)
    np.testing.assert_allclose(np.degrees(found.table.q), expected[:, :3], rtol=1e-12)
    np.testing.assert_allclose(found.table.position * 1e3, expected[:, 3:], rtol=1e-12)


@pytest.mark.parametrize(("delimiter", "decimal", "encoding", "thousands"), [
    (",", ".", "utf-8-sig", ""), ("\t", ",", "cp1252", "."), (";", ".", "utf-16", "'"),
    (";", ",", "utf-8", " "),
])  # fmt: skip
def test_styles_of_tables(tmp_path, delimiter, decimal, encoding, thousands):
    text = text_of(delimiter, decimal, thousands)
    if thousands == " ":  # as office programs write it
        text = text.replace(" ", "\u202f").replace("-", "−")
    text = text.encode(encoding)
    if thousands:
        with pytest.raises(InputError, match=r"a.csv, line 2, column X\[mm\].*1.{1,6}234.5"):
            imported(tmp_path, {"a.csv": text}, MAPPING.format(text=""))
    told = f'thousands = "{thousands}"' if thousands else ""
    check(imported(tmp_path, {"a.csv": text}, MAPPING.format(text=told)))


def test_preamble_repeated_headers_footers_and_rows_without_a_value(tmp_path):
    lines = text_of(";", ",").splitlines()
    lines = ["Report; of today", "", *lines[:2], lines[0], lines[2], "2 points exported"]
    files = {"a.csv": "\n".join([*lines, "P 3;12;n.v.;1;1;2;3"])}
    with pytest.raises(InputError, match=r"line 7: 1 columns.*ignore"):
        imported(tmp_path, files, MAPPING.format(text=""))
    text = "ignore = 'exported$'\nmissing = ['n.v.']"
    found = imported(tmp_path, files, MAPPING.format(text=text))
    check(found)
    ignored = found.understood[0]["ignored"]
    assert [line for line, _ in ignored] == [1, 5, 7, 8]
    assert ignored[-1][1] == "no value in column Gelenkstück2"


POINT = '[[source]]\nrole = "points"\ncolumns = {x_mm = "x", y_mm = "y", z_mm = "z"}\n'
KRL = "$AXIS_ACT={E6AXIS: A1 1.5, A2 -2E1,\n A3 3, A4 4, A5 5, A6 6}\nPOS Q={X 1,Y 2,Z 3}\n"
KRL += "DECL AXIS P[2]={A1 7,A2 8,A3 9,A4 1,A5 2,A6 3} ; {A1 9}\n; via point\nPTP {A1 1}"
RAPID = """\
PERS jointtarget j{2}:=[[[1.5,-20,3,4,5,6],[1.5,9E9,9E9,9E9,9E9,9E9]],
[[7,8,9,1,2,3],[2.5,9E9,9E9,9E9,9E9,9E9]]];
CONST robtarget r:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
CONST o_jointtarget o_j:=[[0,0,0,0,0,0],[0,9E9,9E9,9E9,9E9,9E9]];"""
PROGRAMS = [(KRL, "kuka", [3, 6]), (RAPID, "abb", [3, 4])]


def program(tmp_path, text, preset):
    files = {"p.csv": "x,y,z\n1,2,3\n4,5,6\n", "f": text}
    mapping = f'{POINT}[[source]]\npreset = "{preset}"\n[join]\nby = "order"\n'
    return imported(tmp_path, files, mapping)


@pytest.mark.parametrize(("text", "preset", "lines"), PROGRAMS)
def test_robot_programs_over_several_lines_in_logs_and_arrays(tmp_path, text, preset, lines):
    found = program(tmp_path, text, preset)
    joints = [[1.5, -20, 3, 4, 5, 6], [7, 8, 9, 1, 2, 3]]
    np.testing.assert_allclose(np.degrees(found.table.q), joints)
    assert [line for line, _ in found.understood[1]["ignored"]] == lines


LOADED = "load of (0, 0, -98.1) N"
STOP = "; configuration {0}\nPTP {{A1 {0}}}\n{2}; measure configuration {0}, {1}\nWAIT SEC 3\n"
VISITS = [(2, "no load", ""), (1, "no load", ""), (1, LOADED, "; hang it\nHALT\n"), (2, LOADED, "")]


@pytest.mark.parametrize(("points", "force"), {"2112": [0, 0, 1, 1], "1122": [0, 1, 0, 1]}.items())
def test_a_program_of_design_says_under_which_load(tmp_path, points, force):
    text = "".join(STOP.format(*visit) for visit in VISITS) + "; home\nPTP {A1 0}\n"
    names = "[[source]]\npreset = 'leica'\n[[source]]\npreset = 'kuka'\n"
    table = "Point ID,X mm,Y mm,Z mm\n" + "".join(f"P{name}_M1,1,2,3\n" for name in points)
    found = imported(tmp_path, {"p.csv": table, "f": text}, names)
    assert found.table.force[:, 2].tolist() == [-98.1 * f for f in force]
    with pytest.raises(InputError, match=r"P2_M1 \(line .\): 1 reading,.*lines 2, 16.*a file of"):
        imported(tmp_path, {"p.csv": table.rpartition("P")[0], "f": text}, names)


@pytest.mark.parametrize(("text", "preset", "message"), [
    ("MODULE x\nENDMODULE", "kuka", "f: no "), ("MODULE x\nENDMODULE", "abb", "f: no "),
    ("XP1={A1 1,A2 B-1,A3 2}", "kuka", r"f, line 1: A2 is 'B-1', not a number"),
    (b"", "kuka", "empty file"), (b"PK\x03\x04abc", "kuka", "workbook"),
    (b"a\0\0\0\0b,c\0d", "kuka", "NUL characters"),
])  # fmt: skip
def test_files_without_joint_values(tmp_path, text, preset, message):
    with pytest.raises(InputError, match=message):
        program(tmp_path, text, preset)


@pytest.mark.parametrize(("header", "expected"), {
    "X [mm]": ("X", "mm"), "Z (Millimeters)": ("Z", "mm"), "x_m": ("x", "m"), "Y, in": ("Y", "in"),
    "T [°F]": ("T", "F"), "field.position0": ("field.position0", None), "[mm]": ("[mm]", None),
    "Point ID": ("Point ID", None),
}.items())  # fmt: skip
def test_units_in_headers(header, expected):
    assert split_unit(header) == expected


@pytest.mark.parametrize(("values", "units"), [
    ([1.0, 360.0, 400.0, 2 * np.pi, 2000 * np.pi], ["rev", "deg", "gon", "rad", "mrad"]),
    ([1.0, 2.54, 25.4, 0.0254, 25400.0], ["in", "cm", "mm", "m", "um"]),
    ([1.0, 60.0, 3.6e3, 3.6e6, 3.6e9, 3.6e12], ["h", "min", "s", "ms", "us", "ns"]),
    ([20.0, 293.15, 68.0], ["C", "K", "F"]),
    ([2.5, 2500.0], ["kN", "N"]),
    ([2.0, 2000.0, 2e6], ["kNm", "Nm", "Nmm"]),
])  # fmt: skip
def test_the_same_in_every_unit(values, units):
    found = [convert(np.array([v]), u, units[0])[0] for v, u in zip(values, units, strict=True)]
    np.testing.assert_allclose(found, values[0], rtol=1e-14)
