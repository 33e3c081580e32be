"""Several markers in one row, and loads that only the files' names state."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from support.tracker_exports import MARKERS, kr270_readings
from typer.testing import CliRunner, Result

from elastocal.__main__ import commands


def run(*words: object) -> Result:
    return CliRunner().invoke(commands(), ["import", *map(str, words)], env={"COLUMNS": "300"})


def wide(path: Path, degrees: np.ndarray, points: np.ndarray, head: str, unit: str = "_mm") -> Path:
    """One row per pose; `head` has {marker} and {axis} of a column's name."""
    joints = [f"q{j + 1}_deg" for j in range(degrees.shape[1])]
    names = [head.format(marker=m, axis=a) + unit for m in MARKERS for a in "xyz"]
    rows = [
        [*map(repr, q), *map(repr, p.ravel().tolist())]
        for q, p in zip(degrees.tolist(), points, strict=True)
    ]
    path.write_text("\n".join(",".join(row) for row in [[*joints, *names], *rows]) + "\n")
    return path


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cell")
    return folder, *kr270_readings(folder)[1:]


def table(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("head", ["{marker}_{axis}", "{marker} {axis}"])
def test_every_marker_of_a_row_becomes_a_reading(tmp_path, readings, head):
    folder, degrees, points = readings
    file, out = wide(tmp_path / "log.csv", degrees, points, head), tmp_path / "data.csv"
    done = run(file, "--preset", "wide", "--cell", folder / "cell.toml", "-o", out)
    assert done.exit_code == 0 and "Warning" not in done.output, done.output
    rows = table(out)
    assert [row["marker"] for row in rows[:4]] == ["M1", "M2", "M1", "M2"]
    assert len(rows) == points[..., 0].size
    found = np.array([[float(row[f"{a}_mm"]) for a in "xyz"] for row in rows])
    assert np.array_equal(found, points.reshape(-1, 3))
    assert len({row["configuration"] for row in rows}) == len(degrees)


def test_a_marker_that_was_hidden_is_left_out_alone_and_listed(tmp_path, readings):
    _, degrees, points = readings
    file = wide(tmp_path / "log.csv", degrees, points, "{marker}_{axis}")
    lines = file.read_text().splitlines()
    cells = lines[3].split(",")
    lines[3] = ",".join([*cells[:-2], "", cells[-1]])
    file.write_text("\n".join(lines) + "\n")
    done = run(file, "--preset", "wide", "-o", tmp_path / "data.csv")
    assert done.exit_code == 0 and "line 4 (no value in column M2_y_mm)" in done.output
    assert len(table(tmp_path / "data.csv")) == 2 * len(degrees) - 1


@pytest.mark.parametrize(
    ("name", "force"),
    [("log_2600N", 2600.0), ("payload_2p5kg", 2.5 * 9.80665), ("load2.6kN", 2600.0),
     ("arm7_unloaded", 0.0), ("P12N3", 0.0)],
)  # fmt: skip
def test_a_load_in_a_files_name_is_taken_and_told(tmp_path, readings, name, force):
    _, degrees, points = readings
    file = wide(tmp_path / f"{name}.csv", degrees, points, "{marker}_{axis}")
    done = run(file, "--preset", "wide", "-o", tmp_path / "data.csv")
    assert done.exit_code == 0, done.output
    forces = {float(row.get("force_z_N", 0.0)) for row in table(tmp_path / "data.csv")}
    assert len(forces) == 1 and forces.pop() == pytest.approx(-force)
    assert ("by its name, hanging straight down" in done.output) == (force > 0)


def test_files_beside_it_are_unloaded_and_what_states_no_size_is_told(tmp_path, readings):
    _, degrees, points = readings
    for name in ("unloaded", "full_2600N", "loaded"):
        wide(tmp_path / f"{name}.csv", degrees, points, "{marker}_{axis}")
    files = tmp_path / "unloaded.csv", tmp_path / "full_2600N.csv"
    done = run(*files, "--preset", "wide", "-o", tmp_path / "data.csv")
    assert done.exit_code == 0, done.output
    assert {float(row["force_z_N"]) for row in table(tmp_path / "data.csv")} == {0.0, -2600.0}
    done = run(tmp_path / "loaded.csv", "--preset", "wide", "-o", tmp_path / "data.csv")
    assert "named for a load that is not taken" in done.output
    done = run(tmp_path / "unloaded.csv", "--preset", "wide", "-o", tmp_path / "data.csv")
    assert "named for a load" not in done.output


def test_a_column_of_payloads_is_a_load_and_one_that_is_not_read_is_told(tmp_path):
    head = "q1_deg,q2_deg,payload_kg,time,M1_x_mm,M1_y_mm,M1_z_mm"
    (tmp_path / "log.csv").write_text(f"{head}\n1,2,0,0,3,4,5\n6,7,2.5,9,8,9,10\n")
    done = run(tmp_path / "log.csv", "--preset", "wide", "-o", tmp_path / "data.csv")
    assert done.exit_code == 0 and "column 'time' states no unit" in done.output, done.output
    forces = [float(row["force_z_N"]) for row in table(tmp_path / "data.csv")]
    assert forces == pytest.approx([0.0, -2.5 * 9.80665])
    mapping, out = tmp_path / "map.toml", tmp_path / "data.csv"
    columns = "[source.columns]\n'q#_deg' = 'q#'\nx_mm = '*_x'\ny_mm = '*_y'\nz_mm = '*_z'\n"
    for load, told in (("", True), ("load = 'Payload'\n", False)):
        mapping.write_text(f"[[source]]\n{columns}{load}")
        done = run(tmp_path / "log.csv", "--map", mapping, "-o", out)
        assert done.exit_code == 0 and ("column payload_kg of" in done.output) == told


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ('x_mm = "*_x"\ny_mm = "*_y"', "'M2' has no column for y_mm, as 'M2_y'"),
        (
            'x_mm = "*_x"\n[source.optional]\nsigma_x_um = "*_s"',
            "'M2' has no column for sigma_x_um, as 'M2_s'",
        ),
        ('name = "*_name"', "* stands for the markers of a row"),
    ],
)
def test_places_of_markers_that_are_not_there_are_told(tmp_path, columns, told):
    (tmp_path / "log.csv").write_text("q1_deg,M1_x_mm,M1_y_mm,M2_x_mm,M1_s_um\n1,2,3,4,5\n")
    (tmp_path / "map.toml").write_text(f"[[source]]\n[source.columns]\n{columns}\n")
    done = run(tmp_path / "log.csv", "--map", tmp_path / "map.toml", "-o", tmp_path / "data.csv")
    assert done.exit_code == 2 and told in done.output
    assert not (tmp_path / "data.csv").exists()


def test_one_message_names_the_units_of_all_columns_that_state_none(tmp_path, readings):
    _, degrees, points = readings
    file = wide(tmp_path / "log.csv", degrees, points, "{marker}_{axis}", "")
    file.write_text(file.read_text().replace("_deg", ""))
    words = [file, "--preset", "wide", "-o", tmp_path / "data.csv"]
    refused = run(*words)
    assert refused.exit_code == 2
    assert "'q1', 'q2'" in refused.output and "'M1_z' state no unit" in refused.output
    assert "--angle-unit deg and --length-unit mm" in refused.output
    half = run(*words, "--length-unit", "mm")
    assert half.exit_code == 2 and "give --angle-unit deg;" in half.output
    assert run(*words, "--length-unit", "mm", "--angle-unit", "deg").exit_code == 0
    assert float(table(tmp_path / "data.csv")[0]["q1_deg"]) == degrees[0, 0]


def test_a_lone_force_column_is_the_load_and_no_marker(tmp_path, readings):
    _, degrees, points = readings
    file = wide(tmp_path / "log.csv", degrees, points, "{marker}_{axis}")
    head, *rows = file.read_text().splitlines()
    text = [f"{head},force_z_N", *(f"{row},-{100 + i}" for i, row in enumerate(rows))]
    file.write_text("\n".join(text) + "\n")
    done = run(file, "--preset", "wide", "-o", tmp_path / "data.csv")
    assert done.exit_code == 0, done.output
    assert "force_x, force_y in no column: taken as 0 N beside force_z" in done.output
    first = table(tmp_path / "data.csv")[0]
    assert {first[f"force_{a}_N"] for a in "xy"} == {"0.0"} and first["force_z_N"] == "-100.0"
