"""Every wrong input ends with one message that names it, the right exit code, and no traceback."""

import os
import re
from pathlib import Path

import pytest
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cli.app import app


@pytest.fixture
def campaign(tmp_path):
    return write_campaign(tmp_path)


def run(*arguments):
    """Exit code and stderr of a command; whatever is not a clean exit is an error of ours."""
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    return result.exit_code, result.stderr


def refused(code, *fragments, campaign, extra=()):
    """`identify` must end with `code` and a message holding the fragments, writing nothing."""
    cell, data = campaign
    before = sorted(os.listdir(cell.parent))
    found, message = run("identify", cell, data, "-o", cell.parent / "result.json", "-q", *extra)
    assert found == code, message
    assert "Traceback" not in message
    for fragment in fragments:
        assert re.search(fragment, message), f"{fragment!r} not in {message!r}"
    assert sorted(os.listdir(cell.parent)) == before


def edit(path: Path, pattern: str, replacement: str, count: int = 1) -> None:
    text = path.read_text(encoding="utf-8")
    changed = re.sub(pattern, replacement, text, count=count, flags=re.M)
    assert changed != text
    path.write_text(changed, encoding="utf-8")


def cells_of(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]


def write_cells(path: Path, rows: list[list[str]]) -> None:
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


def drop_column(path: Path, name: str) -> None:
    rows = cells_of(path)
    k = rows[0].index(name)
    write_cells(path, [row[:k] + row[k + 1 :] for row in rows])


def set_cell(path: Path, line: int, column: str, text: str) -> None:
    rows = cells_of(path)
    rows[line - 1][rows[0].index(column)] = text
    write_cells(path, rows)


def test_the_campaign_itself_is_accepted(campaign):
    cell, data = campaign
    code, message = run("identify", cell, data, "-o", cell.parent / "result.json", "-q")
    assert code == 0, message
    assert (cell.parent / "result.json").exists()


# --- the table -----------------------------------------------------------------------------


def test_missing_column(campaign):
    drop_column(campaign[1], "z_mm")
    refused(2, "data.csv", "z_mm", campaign=campaign)


def test_column_without_a_unit(campaign):
    edit(campaign[1], "x_mm", "x")
    refused(2, "data.csv", "'x' has no unit", "x_mm", campaign=campaign)


def test_mixed_units(campaign):
    edit(campaign[1], "y_mm", "y_m")
    refused(2, "data.csv", "x_mm and y_m mix units", campaign=campaign)


@pytest.mark.parametrize("text", ["nan", "inf", "", "abc", "12,5"])
def test_no_number_in_a_cell(campaign, text):
    set_cell(campaign[1], 5, "y_mm", text)
    refused(2, "data.csv", "line 5", campaign=campaign)


def test_empty_file(campaign):
    campaign[1].write_text("")
    refused(2, "data.csv", "empty", campaign=campaign)


def test_header_only(campaign):
    write_cells(campaign[1], cells_of(campaign[1])[:1])
    refused(2, "data.csv", "no rows|no measurements|only a header", campaign=campaign)


def test_one_row(campaign):
    write_cells(campaign[1], cells_of(campaign[1])[:2])
    refused(1, "data.csv", "measure", campaign=campaign)


def test_duplicate_rows(campaign):
    rows = cells_of(campaign[1])
    write_cells(campaign[1], [*rows, rows[3]])
    refused(2, "data.csv", "lines 4 and 14", "repeat", campaign=campaign)


def test_unknown_marker(campaign):
    rows = cells_of(campaign[1])
    names = ["marker", *["M1"] * 4, "M7", *["M1"] * (len(rows) - 6)]
    write_cells(campaign[1], [[n, *row] for n, row in zip(names, rows, strict=True)])
    refused(2, "line 6", "M7", "M1", campaign=campaign)


def test_joint_count_differs_from_the_robot(campaign):
    drop_column(campaign[1], "q6_deg")
    refused(2, "data.csv", "5 joint columns", "6 joints", campaign=campaign)


def test_joints_beyond_limits(campaign):
    set_cell(campaign[1], 4, "q2_deg", "77.0")
    refused(2, "line 4", "joint2", "77°", "limits", campaign=campaign)


def test_degrees_given_as_radians(campaign):
    edit(campaign[1], r"q\d_deg", lambda m: m[0].replace("deg", "rad"), count=6)
    refused(2, "degrees", "rename it to …_deg", campaign=campaign)


def test_metres_given_as_millimetres(campaign):
    edit(campaign[1], r"(\w)_mm", r"\1_m", count=3)
    refused(2, "millimetres in columns named …_m", campaign=campaign)


def test_millimetres_given_as_metres(campaign):
    rows = cells_of(campaign[1])
    scaled = [[*r[:6], *(f"{float(v) / 1e3:.9f}" for v in r[6:])] for r in rows[1:]]
    write_cells(campaign[1], [rows[0], *scaled])
    refused(2, "metres in columns named …_mm", campaign=campaign)


def test_all_poses_equal(campaign):
    rows = cells_of(campaign[1])
    same = [[*rows[1][:6], *row[6:]] for row in rows[1:]]
    write_cells(campaign[1], [rows[0], *same])
    refused(1, "same pose", campaign=campaign)


def test_fewer_equations_than_parameters(campaign):
    write_cells(campaign[1], cells_of(campaign[1])[:5])
    refused(1, "12 equations", "15 parameters", "measure more", campaign=campaign)


def test_a_file_that_vanishes(campaign):
    campaign[1].unlink()
    refused(2, "data.csv", "no such file", campaign=campaign)


def test_crlf_bom_and_semicolons_with_decimal_commas_are_understood(campaign):
    cell, data = campaign
    text = data.read_text(encoding="utf-8")
    plain = run("identify", cell, data, "--json", "-q")
    german = text.replace(",", ";").replace(".", ",").replace("\n", "\r\n")
    data.write_bytes("\ufeff".encode() + german.encode())
    assert plain[0] == 0
    result = CliRunner().invoke(app, ["identify", str(cell), str(data), "--json", "-q"])
    assert result.exit_code == 0, result.stderr
    again = CliRunner().invoke(app, ["identify", str(cell), str(data), "--json", "-q"])
    assert result.stdout == again.stdout


def test_thousands_separators_are_refused_and_not_misread(campaign):
    data = campaign[1]
    text = data.read_text(encoding="utf-8").replace(",", ";")
    data.write_text(text, encoding="utf-8")
    edit(data, r"(-?\d+\.\d+);(-?\d+\.\d+)$", r"\1;1.234,5")
    refused(2, "data.csv", r"1\.234,5", campaign=campaign)


def test_binary_garbage(campaign):
    campaign[1].write_bytes(bytes(range(256)) * 40)
    refused(2, "data.csv", campaign=campaign)


@pytest.mark.long
def test_a_gigabyte_of_garbage_costs_no_memory(campaign):
    resource = pytest.importorskip("resource")
    with open(campaign[1], "ab") as handle:
        block = b"garbage " * (1 << 17)
        for _ in range(1024):
            handle.write(block)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(2, "data.csv", campaign=campaign)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


# --- robot and cell ------------------------------------------------------------------------


def test_malformed_urdf(campaign):
    (campaign[0].parent / "arm.urdf").write_text("<robot><link name='a'></robot>")
    refused(2, "arm.urdf", "line 1", campaign=campaign)


def test_urdf_with_a_loop(campaign):
    loop = (
        '<joint name="again" type="fixed"><parent link="link_5"/><child link="link_2"/></joint>'
        "</robot>"
    )
    edit(campaign[0].parent / "arm.urdf", "</robot>", loop)
    refused(2, "arm.urdf", "link_2", "loop", campaign=campaign)


def test_unnamed_flange_among_several(campaign):
    more = '<link name="camera"/><joint name="c" type="fixed"><parent link="link_6"/>'
    more += '<child link="camera"/></joint></robot>'
    edit(campaign[0].parent / "arm.urdf", "</robot>", more)
    refused(2, "arm.urdf", "flange", "camera", campaign=campaign)


def test_flange_that_is_no_link(campaign):
    edit(campaign[0], 'arm.urdf"', 'arm.urdf"\nflange = "flnge"')
    refused(2, "flnge", "did you mean 'flange'", campaign=campaign)


@pytest.mark.parametrize("pattern, new, told", [
    (r'(<joint name="joint_a2".*?xyz=")[^"]*', r"\g<1>0 0 700", "700 m before joint 2 is too long"),
    (r'<mass value="[^"]*', '<mass value="1e19', "1e.19 kg is too heavy for link"),
    (r'(<inertial>\s*<origin[^>]*xyz=")[^"]*', r"\g<1>0 0 1e19", "1e.19 m to the centre of mass is too"),
])  # fmt: skip
def test_a_robot_beyond_all_measure(campaign, pattern, new, told):
    path = campaign[0].parent / "arm.urdf"
    changed, count = re.subn(pattern, new, path.read_text(), flags=re.S)
    path.write_text(changed)
    assert count
    refused(2, "arm.urdf: " + told, campaign=campaign)


def test_a_place_beyond_all_measure(campaign):
    edit(campaign[0], r"(M1 = )\[[^,]*", "M1 = [1e19")
    refused(2, r"cell.toml: key tool.markers_m.M1: 1e\+19 m reaches beyond", campaign=campaign)


def test_malformed_toml(campaign):
    edit(campaign[0], r"\[model\]", "[model")
    refused(2, "cell.toml", "line", campaign=campaign)


def test_unknown_key(campaign):
    edit(campaign[0], "effects", "efects")
    refused(2, "cell.toml", "efects", "effects", campaign=campaign)


def test_unknown_effect(campaign):
    edit(campaign[0], "joint_offset", "joint_ofset")
    refused(2, "joint_ofset", "joint_offset", campaign=campaign)


def test_missing_robot_file(campaign):
    (campaign[0].parent / "arm.urdf").unlink()
    refused(2, "arm.urdf", campaign=campaign)


# --- outputs and options -------------------------------------------------------------------


def test_output_folder_that_does_not_exist(campaign):
    cell, data = campaign
    code, message = run("identify", cell, data, "-o", cell.parent / "no" / "result.json", "-q")
    assert code == 2 and "does not exist" in message


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_output_folder_that_cannot_be_written(campaign):
    cell, data = campaign
    folder = cell.parent / "locked"
    folder.mkdir(mode=0o500)
    code, message = run("identify", cell, data, "-o", folder / "result.json", "-q")
    assert code == 2 and "permission" in message


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="needs Linux's /sys")
def test_output_folder_where_not_even_root_may_write(campaign):
    cell, data = campaign
    code, message = run("identify", cell, data, "-o", "/sys/kernel/result.json", "-q")
    assert code == 2 and "/sys/kernel" in message and "write" in message


def test_output_that_is_a_directory(campaign):
    cell, data = campaign
    code, message = run("identify", cell, data, "-o", cell.parent, "-q")
    assert code == 2 and "directory" in message


def test_unknown_weights(campaign):
    refused(2, "--weights", "sideways", campaign=campaign, extra=("--weights", "sideways"))


def test_weights_that_nothing_states(campaign):
    refused(2, "sigma_um", campaign=campaign, extra=("--weights", "axis"))


def test_fixing_what_is_not_there(campaign):
    refused(2, "joint2.ofset", "joint2.offset", campaign=campaign, extra=("--fix", "joint2.ofset"))


@pytest.mark.parametrize("name", ["noise.csv", "noise.npy"])
def test_covariance_that_is_no_file_of_numbers(campaign, name):
    path = campaign[0].parent / name
    extra = ("--covariance", path)
    refused(2, name, "no such file; check the path of the noise", campaign=campaign, extra=extra)
    path.mkdir()
    refused(2, name, "is a directory; give the noise covariance", campaign=campaign, extra=extra)
    path.rmdir()
    path.write_bytes("1,2\n3,ä\n".encode("latin-1"))
    told = "line 2: not UTF-8 text" if name.endswith("csv") else "not a matrix of numbers"
    refused(2, name, told, campaign=campaign, extra=extra)


def test_covariance_of_the_wrong_size(campaign):
    path = campaign[0].parent / "covariance.csv"
    path.write_text("1,0\n0,1\n")
    refused(2, "covariance", "36", campaign=campaign, extra=("--covariance", path))


def test_a_covariance_that_is_none(campaign):
    path = campaign[0].parent / "noise.csv"
    path.write_text(
        "\n".join(",".join("1" if j <= i else "0" for j in range(36)) for i in range(36))
    )
    refused(2, "--covariance is not.* symmetric", campaign=campaign, extra=("--covariance", path))


def test_an_empty_argument_is_not_the_folder(campaign):
    refused(2, "an empty argument after --report", campaign=campaign, extra=("--report", ""))


def test_missing_arguments_are_a_usage_error():
    code, message = run("identify")
    assert code == 2 and "Traceback" not in message


# --- nonsense, and numbers beyond all measure ---------------------------------------------------


def change_columns(path: Path, changed) -> None:
    """Apply `changed` to the table of cells below the header, a list of rows."""
    rows = cells_of(path)
    write_cells(path, [rows[0], *changed(rows[1:])])


def test_swapped_columns_are_no_calibration_and_named(campaign):
    change_columns(campaign[1], lambda rows: [[*r[:7], r[8], r[7], *r[9:]] for r in rows])
    told = r"data.csv: after the fit .* m \(median\) .*no arm of .* m could be.*columns .*swapped"
    refused(1, told, campaign=campaign)


def test_readings_of_other_poses_are_no_calibration(campaign):
    order = [5, 9, 2, 11, 0, 7, 3, 10, 1, 8, 6, 4]
    change_columns(
        campaign[1],
        lambda rows: [[*rows[k][:6], *r[6:]] for k, r in zip(order, rows, strict=True)],
    )
    refused(1, "data.csv: after the fit", "which joint values belong", campaign=campaign)


@pytest.mark.parametrize("force", ["1e300", "-1e9"])
def test_a_force_beyond_all_measure_is_refused(campaign, force):
    rows = cells_of(campaign[1])
    names = ["force_x_N", "force_y_N", "force_z_N"]
    write_cells(campaign[1], [[*rows[0], *names], *([*r, "0", "0", force] for r in rows[1:])])
    refused(2, "line 2, column force_z_N: no arm carries", campaign=campaign)


def test_a_force_that_rounding_left_is_none(campaign):
    rows = cells_of(campaign[1])
    names = ["force_x_N", "force_y_N", "force_z_N"]
    write_cells(campaign[1], [[*rows[0], *names], *([*r, "0", "0", "1e-300"] for r in rows[1:])])
    from elastocal.measurements import read_measurements

    assert not read_measurements(campaign[1], joint_kinds=("revolute",) * 6).force.any()


def test_a_covariance_of_text(campaign):
    path = campaign[0].parent / "noise.csv"
    path.write_text("a,b\n1,2\n")
    told = r"noise.csv, line 1, column no. 1: 'a' is not a number"
    refused(2, told, campaign=campaign, extra=("--covariance", path))


def test_everything_held_names_the_cell_and_the_option(campaign):
    effects = ("base_frame", "joint_offset", "marker_position")
    held = [part for name in effects for part in ("--fix", name)]
    told = "cell.toml: nothing is left to identify.*--fix"
    refused(2, told, campaign=campaign, extra=held)


@pytest.mark.parametrize("box", ["500,0,500,500,100,600", "1,2,3,1,2,3"])
def test_a_box_without_extent_is_refused_at_once(campaign, box):
    cell, data = campaign
    result = cell.parent / "result.json"
    assert run("identify", cell, data, "-o", result, "-q")[0] == 0
    table = ("--table", cell.parent / "t.csv", "--box", box, "-q")
    code, message = run("compensate", cell, result, *table)
    assert code == 2 and "--box: both corners have the same x" in message


def test_numbers_beyond_all_measure_in_options(campaign):
    cell = campaign[0]
    huge = "9" * 30
    for arguments in (
        ("design", cell, "-o", cell.parent / "p.csv", "--poses", huge),
        ("design", cell, "-o", cell.parent / "p.csv", "--candidates", huge),
        ("diagnose", cell, campaign[1], "--plan", cell.parent / "p.csv", "--poses", huge),
    ):
        code, message = run(*arguments, "-q")
        assert code == 2 and arguments[-2] in message and message.count("\n") == 1, message
