"""Wrong mappings and data are told by file, key, line and remedy; likely mistakes of units too."""

from dataclasses import replace

import numpy as np
import pytest
from support.tracker_exports import (
    MARKERS,
    delimited,
    imported,
    kr270_readings,
    krl,
    spatialanalyzer,
)

from elastocal.messages import InputError

DATA = "name,x,y,z,a\n" + "".join(f"{i}_M1,{100 * i},{i},{i},{7 * i}\n" for i in range(1, 7))
GOOD = """
[[source]]
[source.columns]
name = "name"
x_mm = "x"
y_mm = "y"
z_mm = "z"
q1_deg = "a"
"""


def refused(tmp_path, match, mapping=GOOD, **files):
    with pytest.raises(InputError, match=match):
        imported(tmp_path, files or {"data.csv": DATA}, mapping)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[[source]]", '[[source]]\nrole = "tracker"', r"role.*\"points\", \"joints\".*'tracker'"),
        ('x_mm = "x"', 'x = "x"', r"'x': has no unit; write x_mm, x_m"),
        ('x_mm = "x"', 'x_mn = "x"', r"'x_mn'"),
        ('x_mm = "x"', 'x_mm = "xx"',
         r"data.csv: no line.*line 1 has 'name', 'x'.*not x_mm = 'xx'"),
        ('x_mm = "x"', 'x_mm = true', r"x_mm.*takes places in the file.*found true"),
        ('z_mm = "z"\n', "", r"x_mm, y_mm without z"),
        ('q1_deg = "a"', 'q2_deg = "a"', "fills q2, but not q1"),
        ('q1_deg = "a"', "", "no joint values; map q1_deg"),
        ('q1_deg = "a"', '"q#_deg" = 5', r"q#_deg takes a name with #.*q1_deg = 5"),
        ("[[source]]", '[[source]]\nfiles = ["x*"]', r"no file fits files = 'x\*'.*data.csv"),
        ("[[source]]", "[[source]]\nnames = { pattern = '(' }", "no regular expression"),
        ("[[source]]", "[[source]]\nnames = { pattern = '^(?P<configuration>[1-3])_' }",
         r"data.csv, line 5: the name '4_M1' matches no pattern.*, nor do 2 others"),
        ("[[source]]", '[loads]\nfull = [0, 0, -1]\n[[source]]', "no file says which load"),
        ("[[source]]", '[[source]]\nload = "full"', r"line 2: load 'full' is not in \[loads\]"),
        ("[[source]]", "[joints]\nsign = [1, 1]\n[[source]]", "sign has 2 numbers.*1 joints"),
        ("[[source]]", "[joints]\noffset_mm = [2]\n[[source]]", "is 2 for joint 1, which is in"),
        ("[[source]]", "[joints]\ncoupling = [{ joint = 3, of = 1, factor = 1.0 }]\n[[source]]",
         "joint = 3 of .joints. coupling no. 1: the file has 1"),
        ("[[source]]", '[[source]]\ntext = { decimal = "," }', r"line 2|decimal"),
    ],
)  # fmt: skip
def test_mistakes_in_the_mapping(tmp_path, old, new, match):
    data = DATA.replace("100,", "100.5,") if "decimal" in new else DATA
    assert old in GOOD
    refused(tmp_path, match, GOOD.replace(old, new), **{"data.csv": data})


REPEATED = GOOD.replace('x_mm = "x"', 'x_mm = 3\nrepeat = "x"')
T = '[source.optional]\ntemperature_C = "T"\n'


@pytest.mark.parametrize(
    ("old", "new", "match", "mapping"),
    [
        ("name,x,", "name,x [m],", r"'x \[m\]' says m, but the mapping has x_mm; write x_m", GOOD),
        ("200,", "abc,", r"data.csv, line 3, column x: 'abc' is not a number", GOOD),
        ("200,2,", '"200,5",2.5,', r"x: '200,5' has ',' in it.*decimal points; set decimal", GOOD),
        ("name,x,y,z,a", "Report\nn,u,v,w,b", r"line 2 has 'n', 'u'.*not name = 'name'", GOOD),
        ("3_M1,300,3,3,21", "3_M1,300", r"line 4: 2 columns, but q1_deg is column 5", GOOD),
        ("name,x,y", "name,x,x", r"x_mm = 'x' could be column 2 \(x\) or 3 \(x\)",
         GOOD.replace('y_mm = "y"', "y_mm = 3")),
        *(("1_M1,100", f"1_M1,{text}", r"line 2: repeat '.*' is no whole number", REPEATED)
          for text in ("²", "1.5", "9" * 40)),
    ],
)  # fmt: skip
def test_mistakes_in_the_file(tmp_path, old, new, match, mapping):
    assert old in DATA and len(imported(tmp_path, {"data.csv": DATA}, GOOD).table) == 6
    refused(tmp_path, match, mapping, **{"data.csv": DATA.replace(old, new)})


def test_files_of_one_kind_need_the_same_columns(tmp_path):
    files = {"one.csv": DATA, "two.csv": "name,x,y,z,a,T\n1_M1,1,2,3,4,20"}
    refused(tmp_path, r"one.csv: has no temperature, but .*two.csv has", GOOD + T, **files)


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    return kr270_readings(tmp_path_factory.mktemp("cell"))


def with_cell(tmp_path, readings, points, marker="M2", joints=6):
    text = spatialanalyzer(points).replace("M2", marker)
    files = {"p.txt": text, "j.dat": krl(readings[1][:, :joints])}
    return imported(tmp_path, files, "", ("spatialanalyzer", "kuka"), readings[0])


def test_a_fit_within_millimetres_is_no_warning(tmp_path, readings):
    moved = readings[2] + np.random.default_rng(0).normal(0, 3.0, readings[2].shape)
    assert with_cell(tmp_path, readings, moved).warnings == ()


def test_markers_and_joints_must_be_the_cells(tmp_path, readings):
    with pytest.raises(InputError, match=r"line 3.*'M5' is no marker of the cell.*from .*p.txt"):
        with_cell(tmp_path, readings, readings[2], marker="M5")
    with pytest.raises(InputError, match=r"without q6_deg.*positions of the 6 joints"):
        with_cell(tmp_path, readings, readings[2], joints=5)


UNITS = """
[[source]]
preset = "faro"
files = ["p*"]
columns = { x_LEN = "X", y_LEN = "Y", z_LEN = "Z" }
[[source]]
preset = "kuka"
columns = { "q#_ANG" = "A#" }
"""


@pytest.mark.parametrize(
    ("length", "angle", "scale", "turn", "words"),
    [
        ("m", "deg", 1.0, 1.0, "mm read as m"),
        ("mm", "deg", 1e-3, 1.0, "m read as mm"),
        ("mm", "rad", 1.0, 1.0, "degrees read as radians"),
        ("mm", "deg", 1.0, np.pi / 180, "radians read as degrees"),
    ],
)
def test_units_mistaken_for_others(tmp_path, readings, length, angle, scale, turn, words):
    _, degrees, points = readings
    files = {"p.csv": delimited(points * scale, "Feature,X,Y,Z"), "j.dat": krl(degrees * turn)}
    found = imported(tmp_path, files, UNITS.replace("LEN", length).replace("ANG", angle))
    assert any(words in w for w in found.warnings), found.warnings


@pytest.mark.parametrize(
    ("force", "sigma", "words"),
    [
        (-2e6, 10, ["forces reach 2000000 N"]),
        (2600, 10, ["some forces point up"]),
        (-2600, 6000, ["standard deviations reach 6 mm"]),
        (-2600, 10, []),
    ],
)
def test_loads_and_noise_that_no_arm_has(tmp_path, force, sigma, words):
    heads, *lines = DATA.splitlines()
    data = "\n".join([f"{heads},F,S,N", *(f"{line},{force},{sigma},0" for line in lines)])
    columns = [f"sigma_{axis}_um = 'S'" for axis in "xyz"]
    columns += [f"force_{axis}_N = '{'F' if axis == 'z' else 'N'}'" for axis in "xyz"]
    found = imported(tmp_path, {"data.csv": data}, GOOD + "\n".join(columns)).warnings
    told = [w for w in found if w.startswith(("forces", "some forces", "standard"))]
    assert [any(w.startswith(t) for t in words) for w in told] == [True] * len(words)


def test_a_row_that_identify_would_refuse_is_told_with_its_place_in_the_export(tmp_path):
    data = DATA.replace("\n", ",5\n").replace("a,5", "a,S", 1).replace("28,5", "28,-5")
    noise = "\n".join(f"sigma_{axis}_um = 'S'" for axis in "xyz")
    refused(tmp_path, r"line 5.*\(from .*data.csv, line 5", GOOD + noise, **{"data.csv": data})


def test_deflections_need_both_states(tmp_path, readings):
    cell, degrees, points = readings
    cell = replace(cell, model=replace(cell.model, observe="deflection"))
    name = 'load = "full"\nfiles = ["b*"]\n'
    mapping = (
        '[[source]]\npreset = "spatialanalyzer"\nfiles = ["a*"]\nload = "none"\n'
        f'[[source]]\npreset = "spatialanalyzer"\n{name}'
        '[[source]]\npreset = "kuka"\n[loads]\nfull = [0, 0, -2600]\n'
    )
    files = {
        "a.txt": spatialanalyzer(points),
        "b.txt": spatialanalyzer(points[:-2]),
        "j.dat": krl(degrees),
    }
    found = imported(tmp_path, files, mapping, cell=cell)
    assert len(found.table) == len(MARKERS) * (2 * len(degrees) - 2)
    (warning,) = found.warnings
    assert "2 of 10 configurations" in warning and "P09, P10" in warning


def test_numbers_of_any_size_are_told_as_implausible(tmp_path, readings):
    points = readings[2].copy()
    points[3] = 1e250
    found = with_cell(tmp_path, readings, points)
    assert found.fit is None
    assert any("from the tracker" in w for w in found.warnings)
