"""Every wrong input ends with one message that names it, the right exit code, and no traceback."""

import os
import re
from pathlib import Path

import pytest
from support.files import write_campaign
from typer.testing import CliRunner

from elastocal.cli.main import app


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


def cells_of(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]


def write_cells(path: Path, rows: list[list[str]]) -> None:
    path.write_text("\n".join(",".join(row) for row in rows) + "\n", encoding="utf-8")


# --- the table -----------------------------------------------------------------------------


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


@pytest.mark.parametrize("pattern, new, told", [
    (r'(<joint name="joint_a2".*?xyz=")[^"]*', r"\g<1>0 0 700", "700 m before joint 2 is too long"),
    (r'<mass value="[^"]*', '<mass value="1e19', "1e.19 kg is too heavy for link"),
    (r'(<inertial>\s*<origin[^>]*xyz=")[^"]*', r"\g<1>0 0 1e19", "1e.19 m to the centre of mass"),
])  # fmt: skip
def test_a_robot_beyond_all_measure(campaign, pattern, new, told):
    path = campaign[0].parent / "arm.urdf"
    changed, count = re.subn(pattern, new, path.read_text(), flags=re.S)
    path.write_text(changed)
    assert count
    refused(2, "arm.urdf: " + told, campaign=campaign)


# --- outputs and options -------------------------------------------------------------------


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


# --- nonsense, and numbers beyond all measure ---------------------------------------------------


def test_a_force_that_rounding_left_is_none(campaign):
    rows = cells_of(campaign[1])
    names = ["force_x_N", "force_y_N", "force_z_N"]
    write_cells(campaign[1], [[*rows[0], *names], *([*r, "0", "0", "1e-300"] for r in rows[1:])])
    from elastocal.measurements import read_measurements

    assert not read_measurements(campaign[1], joint_kinds=("revolute",) * 6).force.any()
