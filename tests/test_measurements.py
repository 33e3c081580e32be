"""The measurement table: what it says arrives in SI units, and what is wrong with it is told."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import numpy as np
import pandas
import pytest

from elastocal import tables
from elastocal.measurements import read_measurements, visits, write_measurements
from elastocal.messages import InputError

HEADER = "q1_deg,q2_deg,x_mm,y_mm,z_mm"
ROW = "1,2,3,4,5"


@pytest.fixture
def read(tmp_path):
    def read(text, joint_kinds=("revolute", "revolute"), **options):
        data = text if isinstance(text, bytes) else text.encode()
        (tmp_path / "data.csv").write_bytes(data)
        return read_measurements(tmp_path / "data.csv", joint_kinds=joint_kinds, **options)

    return read


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(tables, "PIECE", 20)


@pytest.fixture
def refusal(read):
    """The message with which a table is refused; it must name the file."""

    def refusal(text, **options):
        with pytest.raises(InputError) as caught:
            read(text, **options)
        message = str(caught.value)
        assert "data.csv" in message
        assert "\n" not in message
        assert len(message) < 700
        return message

    return refusal


def table(*rows, header=HEADER):
    return "\n".join([header, *rows]) + "\n"


def extended(columns, values):
    return table(f"{ROW},{values}", header=f"{HEADER},{columns}")


def test_the_smallest_table_has_defaults_for_all_the_rest(read):
    got = read(table(ROW, "6,7,8,9,10"))
    assert len(got) == 2
    assert got.row.tolist() == [2, 3]
    assert np.allclose(got.q, np.radians([[1, 2], [6, 7]]), rtol=1e-15)
    assert got.position.tolist() == [[0.003, 0.004, 0.005], [0.008, 0.009, 0.01]]
    assert got.configuration.tolist() == [0, 1]
    assert got.repeat.tolist() == [0, 0]
    assert (got.marker.tolist(), got.marker_names) == ([0, 0], ("M1",))
    assert (got.force == 0).all()
    for absent in (got.rotation, got.distance, got.torque, got.sigma, got.time, got.approach):
        assert absent is None


def test_every_column_arrives_in_si_units(read):
    columns = {
        "configuration": "home", "repeat": "3", "marker": "ball",
        "q1_rad": "0.5", "q2_mm": "250",
        "x_um": "1e6", "y_um": "2", "z_um": "3",
        "force_x_N": "1", "force_y_N": "2", "force_z_N": "-3",
        "rx_deg": "0", "ry_deg": "0", "rz_deg": "90",
        "distance_mm": "750", "torque_1_Nm": "7", "torque_2_N": "8",
        "sigma_range_um": "10", "sigma_azimuth_um": "20", "sigma_elevation_um": "30",
        "time_min": "1.5", "approach_1": "1", "approach_2": "-1", "temperature_C": "21.5",
    }  # fmt: skip
    got = read(
        table(",".join(columns.values()), header=",".join(columns)), ("revolute", "prismatic")
    )
    assert got.q.tolist() == [[0.5, 0.25]]
    assert got.position.tolist() == [[1.0, 2e-6, 3e-6]]
    assert got.force.tolist() == [[1.0, 2.0, -3.0]]
    assert np.allclose(got.rotation, [[0, 0, np.pi / 2]])
    assert got.distance.tolist() == [0.75]
    assert got.torque.tolist() == [[7.0, 8.0]]
    assert (got.sigma.tolist(), got.sigma_frame) == ([[1e-5, 2e-5, 3e-5]], "polar")
    assert got.time.tolist() == [90.0]
    assert got.approach.tolist() == [[1.0, -1.0]]
    assert got.temperature.tolist() == [21.5]
    assert (got.configuration_labels, got.marker_names) == (("home",), ("ball",))
    assert got.repeat.tolist() == [3]


@pytest.mark.parametrize(
    ("quaternion", "vector"),
    [
        ("1,0,0,0", [0, 0, 0]),
        ("0,1,0,0", [np.pi, 0, 0]),
        ("0.7071067811865476,0,0.7071067811865476,0", [0, np.pi / 2, 0]),
        ("1,0,0,1e-200", [0, 0, 2e-200]),
        ("1.0005,0,0,0", [0, 0, 0]),
    ],
)
def test_quaternions_become_rotation_vectors(read, quaternion, vector):
    got = read(extended("qw,qx,qy,qz", quaternion), observe="pose")
    assert np.allclose(got.rotation, [vector], rtol=1e-12, atol=1e-300)


def test_a_table_between_tabs_may_use_decimal_commas(read):
    text = table("1,2,3.25,4,5").replace(",", "\t").replace(".", ",")
    assert read(text).position.tolist() == [[0.00325, 0.004, 0.005]]


@pytest.mark.parametrize("name", ["# remark", "_x", "note", "notes of the day"])
def test_remarks_are_ignored(read, name):
    assert len(read(extended(name, "any text")))


def test_loads_and_repeats_tell_rows_of_one_configuration_apart(read):
    header = "configuration,repeat,force_x_N,force_y_N,force_z_N," + HEADER
    rows = [f"1,{r},0,0,{f},{ROW}" for r in (0, 1) for f in ("0.000", "-100")]
    assert len(read(table(*rows, header=header))) == 4


@pytest.mark.parametrize(
    ("header", "told"),
    [
        # What other people's tables call a column.
        ("pose," + HEADER, ["'pose' (did you mean 'configuration'?)"]),
        (HEADER.replace("q2_deg", "Joint_2_rad"), ["'Joint_2_rad' (did you mean 'q2_rad'?)"]),
        (HEADER + ",Fz_kN", ["'Fz_kN' (did you mean 'force_z_N'?)"]),
        (HEADER + ",", ["column 6 of 6 has no name"]),
        (HEADER + ",x_mm", ["'x_mm' appears 2 times"]),
        (HEADER + ",torque_3_Nm", ["'torque_3_Nm'", "robot has 2 joints"]),
        (HEADER + ",qw,qx,qy", ["without qz"]),
        ("q1_deg,q2_deg", ["x_mm,y_mm,z_mm are missing", '"position"', "found q1_deg, q2_deg"]),
        (HEADER + ",rx_deg,ry_deg,rz_deg,qw,qx,qy,qz", ["rx_deg", "qw", "keep one"]),
        (
            HEADER + ",sigma_x_um,sigma_y_um,sigma_z_um,"
            "sigma_range_um,sigma_azimuth_um,sigma_elevation_um",
            ["sigma_x_um", "sigma_range_um", "keep one"],
        ),
    ],
)
def test_wrong_header_is_told_before_any_row_is_looked_at(refusal, header, told):
    message = refusal(header + "\nno,row\n")
    assert all(part in message for part in told), message


@pytest.mark.parametrize(
    ("observe", "needed"),
    [("deflection", "x_mm,y_mm,z_mm"), ("pose", "rx_deg,ry_deg,rz_deg or qw"),
     ("distance", "distance_mm")],
)  # fmt: skip
def test_what_is_observed_decides_the_columns_needed(refusal, observe, needed):
    header = HEADER if observe != "deflection" else "q1_deg,q2_deg"
    assert needed in refusal(header + "\n", observe=observe)


@pytest.mark.parametrize(
    ("cell", "told"),
    [("-inf", "not a finite number"), ("1e999", "too large"), ("１", "not a number")],
)
def test_bad_cell_is_told_with_line_column_and_text(refusal, cell, told):
    message = refusal(table(ROW, ROW.replace("3", "7"), f"1,2,3,{cell},5"))
    assert f"line 4, column y_mm: {cell!r}" in message and told in message


def test_decimal_marks_must_agree_throughout_the_file(refusal, small_chunks):
    header = HEADER.replace(",", ";")
    message = refusal(table("1;2;3;4;5,5", "1;2;3;4;6.5", header=header))
    assert "line 2, column z_mm: '5,5'" in message
    assert "line 3, column z_mm: '6.5'" in message


@pytest.mark.parametrize(
    ("columns", "values", "told"),
    [
        ("repeat", "1.5", ["column repeat", "whole number", "1.5"]),
        ("approach_1,approach_2", "1,2", ["column approach_2", "-1, 0 or 1", "found 2"]),
        ("sigma_x_um,sigma_y_um,sigma_z_um", "1,0,1", ["column sigma_y_um", "positive"]),
        ("qw,qx,qy,qz", "1,0,0,0.1", ["quaternion", "1.00499"]),
        ("time_min", "1e308", ["column time_min", "too large"]),
        ("marker", "a\x07", ["column marker", "control characters"]),
        ("configuration", '""', ["column configuration", "empty cell"]),
        ("marker", '"a', ["quotation marks"]),
    ],
)
def test_value_that_breaks_a_rule_is_told_with_line_and_column(refusal, columns, values, told):
    message = refusal(extended(columns, values))
    assert all(part in message for part in ["line 2", *told]), message


def test_without_configurations_only_identical_rows_are_duplicates(read, refusal):
    assert len(read(table(ROW, ROW.replace("5", "6"), ROW.replace("5", "7")))) == 3
    assert "lines 3 and 5" in refusal(table("0,0,0,0,0", ROW, "9,9,9,9,9", ROW))
    header = HEADER + ",repeat"
    assert len(read(table(ROW + ",0", ROW + ",1", header=header))) == 2


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"\xef\xbb\xbf", "blank"),
        (table(ROW).encode("utf-16"), "UTF-16"),
        (table(ROW).encode("utf-16-le"), "NUL"),
        (b"PK\x03\x04\0\0\0", "export the sheet"),
        (extended("note", "\xb5").encode("latin-1"), "line 2: not UTF-8 text (byte 0xb5)"),
        (table(ROW).replace("\n", "\r").encode(), "carriage return"),
        (HEADER.encode() + b"\n" + b"1" * 70_000, "line 2: longer than 64 KiB"),
        (HEADER.encode() + b"\n1,2,3,4,\0005\n", "line 2: NUL"),
        (HEADER.encode() + b"\n" * 20_000, "has a header but no rows"),
        (table("\ufeff" + ROW).encode(), "is not a number"),
    ],
)
def test_a_file_that_is_no_text_table_is_refused(refusal, data, told):
    assert told in refusal(data)


@pytest.mark.parametrize("name", ["absent.csv", "", "a\0b.csv", "x" * 5000, "absent.parquet"])
def test_absent_files_and_directories_are_refused(tmp_path, name):
    with pytest.raises(InputError):
        read_measurements(tmp_path / name, joint_kinds=())


def test_a_table_read_in_pieces_is_the_same_table(read, small_chunks):
    header = "configuration;marker;" + HEADER.replace(",", ";")
    rows = ["b;x;1;0;0;0;0", "a;x;2;0;0;0;0", "", "b;y;3;0;0,5;0;0", "c;x;4;0;0,5;0;0"]
    got = read(table(*rows, header=header))
    assert got.configuration_labels == ("b", "a", "c")
    assert got.configuration.tolist() == [0, 1, 0, 2]
    assert got.marker.tolist() == [0, 0, 1, 0]
    assert got.row.tolist() == [2, 3, 5, 6]
    assert got.position[:, 0].tolist() == [0, 0, 0.0005, 0.0005]


def test_more_rows_than_any_campaign_has_are_refused(refusal, small_chunks, monkeypatch):
    monkeypatch.setattr(tables, "MAX_ROWS", 3)
    assert "more than 3 rows" in refusal(table(*(f"{i},2,3,4,5" for i in range(9))))


@pytest.fixture
def parquet(tmp_path):
    pytest.importorskip("pyarrow")

    def parquet(columns, **options):
        path = tmp_path / "data.parquet"
        pandas.DataFrame(columns).set_index([*columns][-1:]).to_parquet(path)
        return read_measurements(path, joint_kinds=("revolute", "revolute"), **options)

    return parquet


def test_parquet_columns_follow_the_same_rules(parquet):
    numbers = {name: [1, 2] for name in HEADER.split(",")}
    got = parquet({**numbers, "marker": ["B", "A"], "configuration": [7, 3]})
    assert got.position[1].tolist() == [0.002, 0.002, 0.002]
    assert got.marker_names == ("B", "A")
    assert got.configuration_labels == ("7", "3")
    for bad, told in [
        ({"x_mm": ["a", "b"]}, "row 1, column x_mm: 'a' is not a number"),
        ({"x_mm": [True, False]}, "row 1, column x_mm: 'True' is not a number"),
        ({"x_mm": [1.0, None]}, "row 2, column x_mm"),
        ({"marker": ["A", None]}, "row 2, column marker"),
        ({"marker": ["A", " "]}, "row 2, column marker"),
        ({"typo": [1, 2]}, "unknown column 'typo'"),
    ]:
        with pytest.raises(InputError, match=told):
            parquet({**numbers, **bad})


def test_parquet_needs_an_engine_and_a_parquet_file(tmp_path, monkeypatch):
    path = tmp_path / "data.pq"
    path.write_bytes(b"not parquet")
    with pytest.raises(InputError, match="not a Parquet file"):
        read_measurements(path, joint_kinds=())
    path.write_bytes(b"PAR1")
    pytest.importorskip("pyarrow")
    with pytest.raises(InputError, match="damaged Parquet file"):
        read_measurements(path, joint_kinds=())
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match="pip install pyarrow"):
        read_measurements(path, joint_kinds=())


def test_a_marker_read_when_the_arm_has_come_back_is_another_visit(read):
    """One reflector, carried from marker to marker: table and times say so, not one of them."""
    rows = [f"{c},{m},{c},{ROW[2:]},{10 * c + 20 * (m == 'B')}" for m in "AB" for c in (1, 2)]
    by_marker, by_pose = (
        read(table(*each, header=f"configuration,marker,{HEADER},time_s"))
        for each in (rows, sorted(rows))
    )
    assert visits(by_marker).tolist() == [0, 2, 1, 3]
    assert visits(replace(by_marker, time=None)).max() == visits(by_pose).max() == 1


def test_what_cannot_be_read_back_is_not_written(read, tmp_path):
    got = read(table(ROW))
    for wrong in (
        replace(got, position=got.position * np.nan),
        replace(got, marker_names=("two\nlines",)),
    ):
        with pytest.raises(InputError):
            write_measurements(wrong, tmp_path / "out.csv")
    with pytest.raises(InputError, match="does not exist"):
        write_measurements(got, tmp_path / "absent" / "out.csv")
    assert os.listdir(tmp_path) == ["data.csv"]
