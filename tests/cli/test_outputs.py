"""Where outputs go: over an input, into a folder that cannot be written, from two runs at once."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz import campaign
from fuzz.campaign import ALL, COMMANDS
from support.design_commands import elastocal

WRITING = {c.verb: c for c in reversed(COMMANDS) if c.outputs}
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    campaign.write(folder)
    return folder


@pytest.mark.parametrize("how", ["itself", "another way", "symbolic link", "named by the cell"])
@pytest.mark.parametrize("verb", WRITING)
def test_no_output_goes_over_an_input(inputs, monkeypatch, tmp_path, verb, how):
    words, read = WRITING[verb].words, WRITING[verb].inputs(inputs)
    given = [path for path in read if path.name in words]
    target = read[-1] if how == "named by the cell" else given[-1]
    if how == "named by the cell" and target in given:
        pytest.skip("reads no other file")
    content = target.read_bytes()
    place = {"itself": target.name, "another way": f"study/../{target.name}"}.get(how)
    if how == "symbolic link":
        (tmp_path / "link").symlink_to(target)
        place = str(tmp_path / "link")
    option = words.index("-o") + 1
    words[option] = place or target.name
    monkeypatch.chdir(inputs)
    before = sorted(os.listdir(inputs))
    done = elastocal(verb, *words)
    assert done.exit_code == 2 and target.read_bytes() == content
    assert sorted(os.listdir(inputs)) == before


# Of every verb each option that names a file to write, once: verb, words, where the name stands.
EVERY = {
    (command.verb, option): (command.words, command.words.index(option) + 1)
    for command in ALL
    for option, _ in command.outputs
}


@pytest.mark.parametrize("spoil", [lambda path: path.with_suffix(".bak"), lambda path: "no" / path])
@pytest.mark.parametrize("verb, option", EVERY, ids=" ".join)
def test_an_output_is_refused_before_anything_is_read(tmp_path, monkeypatch, verb, option, spoil):
    """By an ending that tells of something else, or a folder that is not there; the cell, of which
    a run complains first, is not there either."""
    words, at = EVERY[verb, option]
    spoilt = str(spoil(Path(words[at])))
    monkeypatch.chdir(tmp_path)
    done = elastocal(verb, *words[:at], spoilt, *words[at + 1 :])
    assert (done.exit_code, os.listdir(tmp_path)) == (2, [])
    assert spoilt in done.stderr and words[0] not in done.stderr.replace(spoilt, "")


def test_limits_of_the_cell_have_an_exit_code_of_their_own(inputs, monkeypatch, tmp_path):
    monkeypatch.chdir(inputs)
    strict = Path("placed.toml").read_text() + "\n[require]\nheldout_um = 0.001\n"
    strict = strict.replace('"arm.urdf"', f'"{inputs / "arm.urdf"}"')
    (tmp_path / "strict.toml").write_text(strict)
    words = ["identify", str(tmp_path / "strict.toml"), "placed.csv", "-q"]
    assert elastocal(*words).exit_code == 3
    assert elastocal(*words, "--require", "heldout=1e6").exit_code == 0


def without_override() -> None:
    """In a child: root obeys the permissions of folders like anybody else."""
    if os.geteuid() == 0 and ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0):
        os._exit(99)


@pytest.mark.skipif(sys.platform != "linux", reason="capabilities of Linux")
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(inputs, tmp_path):
    (tmp_path / "closed").mkdir()
    (tmp_path / "closed" / "result.json").write_text("old")
    (tmp_path / "closed").chmod(0o555)
    words = ("identify", "deflecting.toml", "data.csv", "-o", str(tmp_path / "closed/result.json"))
    process = subprocess.run([sys.executable, "-m", "elastocal", *words], cwd=inputs, text=True,
                             capture_output=True, preexec_fn=without_override)  # fmt: skip
    (tmp_path / "closed").chmod(0o755)
    if process.returncode == 99:
        pytest.skip("root here keeps the right to write everywhere")
    assert process.returncode == 2
    assert process.stderr.startswith("elastocal: ")
    assert "no permission to write" in process.stderr
    assert os.listdir(tmp_path / "closed") == ["result.json"]
    assert (tmp_path / "closed" / "result.json").read_text() == "old"
