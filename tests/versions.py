"""The wheel on every supported Python of this machine: python tests/versions.py.

With --slices: a slice of the tests in an environment with the oldest versions that pyproject.toml
allows, all together, and in one with the newest that there are.

Each of VERSIONS that is found by name, or among pyenv's, gets an empty environment outside the
checkout, the wheel with the tested versions of what it needs, and then runs as a user would: demo,
identify, a report.  The one that runs this is left to `make test`.  What is missing is left out;
exit code 1 where something breaks.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERSIONS = ("3.11", "3.12", "3.13")
# Model, identification, planning, one of each verb, and what is written and read.
SLICE = (
    "tests/cli/test_verbs.py", "tests/cli/test_compensate.py",
    "tests/identification/test_linear.py",
    "tests/model/test_agreement_with_pinocchio.py", "tests/planning/test_design_flow.py",
    "tests/studies/test_study_results.py", "tests/model/test_mjcf.py",
    "tests/export/test_mjcf_in_place.py",
)  # fmt: skip
TOOLS = ("pytest", "hypothesis", "statsmodels", "rtb-data", "example-robot-data", "setuptools")
AGAIN = ("demo_out/cell.toml", "demo_out/data.csv", "-o", "result.json", "-q")


def interpreter(version: str) -> str | None:
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    named = [shutil.which(f"python{version}"), *sorted(pyenv.glob(f"{version}.*/bin/python"))]
    for found in filter(None, named):
        asked = [str(found), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        if subprocess.run(asked, capture_output=True, text=True).stdout.strip() == version:
            return str(found)
    return None


def run(folder: Path, *words: object) -> str:
    """What a program prints on stdout; raises CalledProcessError where it fails."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [str(word) for word in words], cwd=folder, env=clean, capture_output=True, text=True
    )
    if done.returncode:
        sys.stderr.write(done.stdout + done.stderr)
        done.check_returncode()
    return done.stdout


def tried(python: str, folder: Path) -> str:
    source = folder / "source"  # pip builds where the sources are
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    run(folder, python, "-m", "venv", "venv")
    own = folder / "venv" / "bin"
    # Not --compile: of what is installed a tenth is imported, and what is gets compiled then.
    run(folder, own / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check",
        "--no-compile", "-c", ROOT / "constraints.txt", source)  # fmt: skip
    where = run(folder, own / "python", "-c", "import elastocal; print(elastocal.__file__)")
    assert Path(where.strip()).is_relative_to(folder), where
    assert "Report to open" in run(folder, own / "elastocal", "demo", "-q")
    told = run(folder, own / "elastocal", "identify", *AGAIN, "--report", "report.html")
    assert "wrote report.html" in told
    size = (folder / "report.html").stat().st_size
    assert size > 100_000, f"a report of {size} bytes"
    return "demo, identify, report"


def floors() -> list[str]:
    """The oldest version of each requirement, extras included, as pip takes it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    stated = [*project["dependencies"], *(r for x in ("mujoco", "parquet", "cluster")
                                          for r in extras[x])]  # fmt: skip
    return [requirement.replace(">=", "==") for requirement in stated]


def sliced(which: str, folder: Path) -> str:
    """The slice of the tests with `which` versions: "floors" or "newest"."""
    run(folder, sys.executable, "-m", "venv", "venv")
    own = folder / "venv" / "bin" / "python"
    stated = floors()
    wanted = stated if which == "floors" else [each.partition("==")[0] for each in stated]
    run(folder, own, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--no-compile",
        "--only-binary", ":all:", *wanted, *TOOLS)  # fmt: skip
    told = run(folder, "env", f"PYTHONPATH={ROOT / 'src'}", own, "-m", "pytest", "--rootdir",
               ROOT, "-c", ROOT / "pyproject.toml", "-q", "-p", "no:cacheprovider", "--tb=short",
               "--disable-warnings", *(ROOT / each for each in SLICE))  # fmt: skip
    return told.strip().splitlines()[-1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--one", action="store_true", help="only the newest Python that is found")
    parser.add_argument("--slices", action="store_true", help="tests with oldest and newest needs")
    asked, own, failed = parser.parse_args(), "{}.{}".format(*sys.version_info), 0
    found = {v: python for v in VERSIONS if v != own and (python := interpreter(v))}
    work = {f"Python {v}": partial(tried, python) for v, python in found.items()}
    if asked.slices:
        work = {which: partial(sliced, which) for which in ("floors", "newest")}
    for name in list(work)[-1:] if asked.one else work:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="elastocal-versions-") as place:
            try:
                told = work[name](Path(place))
            except (subprocess.CalledProcessError, AssertionError) as error:
                failed, told = failed + 1, str(error)
        print(f"{name}: {told}; {time.monotonic() - begun:.0f} s", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
