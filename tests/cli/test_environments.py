"""Wherever it runs: streams without some letters, no home, no terminal, no reader."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.campaign import write

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders and pipes of POSIX")

SOURCE = Path(__file__).parents[2] / "src"
UNSET = ("HOME", "TERM", "LANG", "LC_CTYPE", "XDG_CACHE_HOME", "PYTHONUTF8",
         "MPLCONFIGDIR", "NO_COLOR", "FORCE_COLOR")  # fmt: skip


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("campaign")
    write(folder)
    return folder


def elastocal(
    folder: Path, *words: str, python: tuple[str, ...] = (), unset: tuple[str, ...] = UNSET,
    shell: str = '"$@"', **environment: str,
) -> subprocess.CompletedProcess[bytes]:  # fmt: skip
    """The command as a shell starts it; `shell` says where its streams lead."""
    clean = {k: v for k, v in os.environ.items() if k not in unset}
    clean["PYTHONPATH"] = str(SOURCE)
    command = [sys.executable, *python, "-m", "elastocal", *words]
    return subprocess.run(
        ["/bin/bash", "-o", "pipefail", "-c", shell, "bash", *command],
        capture_output=True, cwd=folder, env=clean | environment, timeout=300,
    )  # fmt: skip


def identified(folder: Path, *words: str, **how) -> subprocess.CompletedProcess[bytes]:
    return elastocal(folder, "identify", "placed.toml", "placed.csv", *words, **how)


def test_everything_missing_at_once(campaign, tmp_path):
    """No terminal, locale, program or home, 20 columns; and any warning would be an error."""
    page, result = tmp_path / "page.html", tmp_path / "result.json"
    (tmp_path / "file").write_text("")
    done = identified(
        campaign, "-q", "-o", str(result), "--report", str(page), python=("-W", "error"),
        # Below a file there can be no folder, for root neither.
        PATH="/nowhere", HOME=str(tmp_path / "file" / "home"), LC_ALL="C", COLUMNS="20",
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert sorted(os.listdir(tmp_path)) == ["file", "page.html", "result.json"]
    assert page.stat().st_size > 100_000 and result.stat().st_size > 1000
    told = " ".join(done.stdout.decode().split())  # lines are longer, sooner than cut a number
    assert len(re.findall(r" [jbm]\S+ -?\d+\.\d{3} ± 0\.\d{3} ", told)) == 12


@pytest.mark.parametrize(
    ("shell", "code"), [('"$@" | true', 0), ('"$@" >&-', 0), ('"$@" > /dev/full', 2)]
)
def test_streams_that_are_closed_or_full(campaign, tmp_path, shell, code):
    if "full" in shell and not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    result = tmp_path / "result.json"
    done = identified(campaign, "-q", "-o", str(result), shell=shell)
    assert done.returncode == code, done.stderr.decode()
    assert b"Traceback" not in done.stderr and b"Exception" not in done.stderr
    assert result.stat().st_size > 1000  # written before anything is told
    if code:
        assert done.stderr == b"elastocal: standard output: No space left on device\n"


@pytest.mark.parametrize(
    ("words", "shell", "code"),
    [
        (("identify", "--help"), '"$@" > /dev/full', 2),
        (("identify", "absent.toml", "absent.csv"), '"$@" 2> /dev/full', 2),
    ],
)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_help_and_messages_where_a_stream_is_full(campaign, words, shell, code):
    done = elastocal(campaign, *words, shell=shell)
    full = b"elastocal: standard output: No space left on device\n"
    assert (done.returncode, done.stderr) == (code, b"" if "2>" in shell else full)


def test_a_wheel_runs_outside_the_checkout(tmp_path):
    """Built, unpacked where nothing else of the project is, and its command run as a user does."""
    setuptools = pytest.importorskip("setuptools", minversion="77", reason="pip install .[test]")
    del setuptools
    root, source, place = SOURCE.parent, tmp_path / "source", tmp_path / "place"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(root / name, source / name)
    shutil.copytree(root / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info"))
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index",
               "--no-build-isolation", "--target", str(place), str(source)]  # fmt: skip
    subprocess.run(install, check=True, capture_output=True, cwd=tmp_path)
    shutil.rmtree(source)
    environment = os.environ | {"PYTHONPATH": str(place)}

    def run(*words: str) -> str:
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    found = run(sys.executable, "-c", "import elastocal; print(elastocal.__file__)")
    assert Path(found.strip()).is_relative_to(place)
    assert "Report to open" in run(str(place / "bin" / "elastocal"), "demo", "-q")
    assert (tmp_path / "demo_out" / "report.html").stat().st_size > 100_000
