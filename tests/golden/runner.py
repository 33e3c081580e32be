"""Runs the goldens: what commands and calls of the front door print, write and return.

    make golden [GOLDEN="name …"]          shows what differs from tests/golden/expected
    make golden-accept GOLDEN="name …"     takes what is found as what is expected

A golden is a folder of inputs and the steps that are run in it, one after the other: a command
line, or a function of door.py.  Of each step is kept: exit code, both outputs, every file that it
wrote, and what a function returned.  tolerance.py says how far any of it may move.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import html
import json
import math
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from golden.tolerance import Difference, differences, is_number, label
from typer.testing import CliRunner

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
EXPECTED = HERE / "expected"

Step = str | Callable[[Path], Any]


@dataclass(frozen=True)
class Golden:
    """`steps` in a copy of `inputs`, folders below the root; `engine`: as tolerance.py says.

    `needs`: an environment variable that names measurements which are not part of the repository.
    `tied`: the order of its poses is one of several alike, between which rounding decides.
    """

    inputs: tuple[str, ...]
    steps: tuple[Step, ...]
    engine: bool = False
    needs: str = ""
    tied: bool = False


def run(golden: Golden) -> list[dict[str, Any]]:
    """What each step does, as it is kept; few steps in search of an order, which tests of that
    search let run to its end."""
    from elastocal.planning import execution

    few = mock.patch.multiple(execution, STEPS=1000, FEW=1000)
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name), few:
        folder = Path(name)
        for source in golden.inputs:
            whole = ROOT / source
            copy = shutil.copytree if whole.is_dir() else shutil.copy
            copy(whole, folder, **({"dirs_exist_ok": True} if whole.is_dir() else {}))
        return [_step(step, folder) for step in golden.steps]


def _step(step: Step, folder: Path) -> dict[str, Any]:
    before = states(folder)
    if callable(step):
        returned = step(folder)
        if returned is None:  # it prepares what the next step reads
            return {"door": step.__name__}
        found: dict[str, Any] = {"door": step.__name__, "returned": kept(plain(returned))}
    else:
        found = run_command(step)
    after = states(folder)
    written = [name for name in after if before.get(name) != after[name]]
    found["files"] = {name: _file(folder / name) for name in sorted(written)}
    return {key: value for key, value in _without(found, folder).items() if value != {}}


def states(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): hashlib.sha1(path.read_bytes()).digest()
        for path in files
        if "__pycache__" not in path.parts and not path.name.startswith(".")
    }


def run_command(line: str) -> dict[str, Any]:
    from elastocal.__main__ import commands

    words = shlex.split(line)
    environment = {"COLUMNS": "100", "NO_COLOR": "1"}
    with mock.patch.object(sys, "argv", ["elastocal", *words]):  # which some results state
        done = CliRunner().invoke(commands(), words, env=environment, catch_exceptions=False)
    found: dict[str, Any] = {"command": line, "exit": done.exit_code}
    if "--json" in words and done.exit_code == 0:
        found["json"] = kept(json.loads(done.stdout))
    else:
        found["text stdout"] = _lines(done.stdout)
    found["text stderr"] = _lines(done.stderr)
    return {key: value for key, value in found.items() if value != []}


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def _without(found: Any, folder: Path) -> Any:
    """`found` without what is of this machine: where the folder is, how long it took, versions."""
    if isinstance(found, dict):
        return {key: _without(value, folder) for key, value in found.items()}
    if isinstance(found, list):
        return [_without(value, folder) for value in found]
    if isinstance(found, str):
        for here in (str(folder.resolve()), str(folder)):
            found = found.replace(here + os.sep, "").replace(here, "FOLDER")
        found = re.sub(r"(Python|numpy|scipy|casadi|pin) \d+(\.\d+)+", r"\1 VERSION", found)
        found = re.sub(r"\b\d{4}-\d\d-\d\d(?:[ T]\d\d:\d\d(?::\d\d)?(?: ?UTC|Z)?)?", "DATE", found)
        found = re.sub(r"(?<=elastocal )\d+\.\d+\.\d+\S*|^0\.\d+\.\d+$", "VERSION", found)
        found = re.sub(r"\b[0-9a-f]{40,}\b", "DIGEST", found)
        return re.sub(r"\(\d+ threads?\)", "(N threads)", found)
    return found


# What is kept


MOST_ENTRIES = 8
MOST_KEYS = 40
SOME = 4
# What pages draw rather than what a reader goes by: one entry of each list.
BRIEF = {"residual_summary", "measured_visits", "covariance", "mixing", "influence"}
# Lists that say what came out: kept whole, however long.
WHOLE = {"parameters", "combinations", "effects", "findings", "budget", "poses", "components"}


def kept(value: Any, key: str = "", some: int = SOME) -> Any:
    """A JSON value as a golden keeps it: long lists and tables as their length and `some` entries.

    The entries are spread evenly; those with a name in the order of their names, since ranks of
    what is nearly alike may change.
    """
    some = 1 if key in BRIEF else some
    if isinstance(value, dict):
        entries = {name: kept(each, name, some) for name, each in value.items()}
        if len(entries) <= MOST_KEYS or not all(is_number(e) for e in entries.values()):
            return entries
        return {"keys": len(entries), "some": {k: entries[k] for k in _some(sorted(entries), some)}}
    if isinstance(value, float):
        return float(f"{value:.8g}") if math.isfinite(value) else str(value)
    if not isinstance(value, list) or key.startswith("text "):
        return value
    most = math.inf if key in WHOLE else MOST_ENTRIES if some > 1 else 1
    if len(value) <= most and not (_nested(value) and len(value) > some):
        return [kept(each, key, some) for each in value]
    found: dict[str, Any] = {"entries": len(value)}
    if all(map(is_number, value)):
        found["rms"] = float(f"{np.sqrt(np.mean(np.square(value))):.8g}")
    if all(isinstance(each, dict) for each in value):
        value = sorted(value, key=lambda each: label(each, 0))
    return found | {"some": [kept(each, key, some) for each in _some(value, some)]}


def _nested(value: list[Any]) -> bool:
    return bool(value) and isinstance(value[0], list)


def _some(value: Sequence[Any], some: int) -> list[Any]:
    return [value[round(i)] for i in np.linspace(0, len(value) - 1, min(some, len(value)))]


def plain(value: Any) -> Any:
    """What a call returned as JSON: arrays as lists, mappings and named tuples as they are."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value if isinstance(value, str | int | float | bool | None) else repr(value)


def _file(path: Path) -> Any:
    """A written file: JSON and tables by value, pages and other text by word."""
    if path.suffix == ".json":
        return kept(json.loads(path.read_text(encoding="utf-8")))
    if path.suffix == ".jsonl":
        return [kept(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
    if path.suffix == ".csv":
        return _table(path)
    if path.suffix in (".png", ".svg", ".parquet"):
        return "written"
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".html":
        text = page_text(text)
    return {"text page" if path.suffix == ".html" else "text": _lines(text)}


def page_text(page: str) -> str:
    """What a reader sees of an HTML page, without its figures."""
    page = re.sub(r"<(script|style|svg|head)\b.*?</\1>", "", page, flags=re.S)
    page = re.sub(r"</?(p|div|tr|h\d|li|section|figure|table|details|summary)\b[^>]*>", "\n", page)
    return re.sub(r"[ \t]+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page)))


def _table(path: Path) -> dict[str, Any]:
    """A CSV by columns, so that each has its own measure."""
    with open(path, newline="", encoding="utf-8") as handle:
        header, *rows = csv.reader(handle)
    columns = {name: [_cell(row[k]) for row in rows] for k, name in enumerate(header)}
    return {"rows": len(rows), "columns": {k: kept(v, "column") for k, v in columns.items()}}


def _cell(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


# Expected, and the difference


def expected_file(name: str) -> Path:
    return EXPECTED / f"{name}.json"


def compare(name: str, golden: Golden, found: list[dict[str, Any]]) -> list[Difference]:
    """Where `found` differs from what the golden's file expects."""
    if not expected_file(name).is_file():
        return [Difference(name, "nothing yet", f"accept it: make golden-accept GOLDEN={name}")]
    steps = json.loads(expected_file(name).read_text(encoding="utf-8"))
    if len(steps) != len(found):
        return [Difference(name, f"{len(steps)} steps", f"{len(found)} steps")]
    told: list[Difference] = []
    for i, (old, new) in enumerate(zip(steps, found, strict=True), 1):
        told += differences(f"step {i}", old, new, golden.engine)
    return told


def report(name: str, golden: Golden, told: Sequence[Difference], most: int = 40) -> str:
    steps = [s if isinstance(s, str) else s.__name__ for s in golden.steps]
    lines = [f"{name} differs in {len(told)} places"]
    for difference in told[:most]:
        number = re.match(r"step (\d+)", difference.path)
        step = steps[int(number[1]) - 1] if number else ""
        if step:
            lines.append(f"$ {step}")
            steps[int(number[1]) - 1] = ""  # told once
        lines.append(str(difference))
    if len(told) > most:
        lines.append(f"  … and {len(told) - most} more")
    return "\n".join([*lines, f"Meant so?  make golden-accept GOLDEN={name}"])


def dumped(value: Any, indent: int = 0, width: int = 340) -> str:
    line = json.dumps(value, ensure_ascii=False)
    if len(line) + indent <= width or not isinstance(value, dict | list):
        return line
    pad = " " * (indent + 1)
    if isinstance(value, dict):
        parts = [f"{json.dumps(k, ensure_ascii=False)}: {dumped(v, indent + 1, width)}"
                 for k, v in value.items()]  # fmt: skip
        return "{\n" + ",\n".join(pad + part for part in parts) + "\n" + " " * indent + "}"
    parts = [dumped(each, indent + 1, width) for each in value]
    return "[\n" + ",\n".join(pad + part for part in parts) + "\n" + " " * indent + "]"


def accept(name: str, found: list[dict[str, Any]]) -> None:
    EXPECTED.mkdir(exist_ok=True)
    expected_file(name).write_text(dumped(found) + "\n", encoding="utf-8")


def chosen(names: Sequence[str]) -> Iterator[tuple[str, Golden]]:
    from golden.goldens import GOLDENS

    unknown = [name for name in names if name not in GOLDENS]
    if unknown:
        sys.exit(f"no golden {', '.join(unknown)}; there are {', '.join(GOLDENS)}")
    for name in names or GOLDENS:
        if GOLDENS[name].needs and not os.environ.get(GOLDENS[name].needs):
            print(f"{name}: left out, {GOLDENS[name].needs} is unset")
        else:
            yield name, GOLDENS[name]


def main(words: Sequence[str]) -> int:
    """`show [names]` or `accept names`."""
    verb, *names = words or ["show"]
    if verb == "accept" and not names:
        sys.exit('name what to accept: make golden-accept GOLDEN="name …", or GOLDEN=all')
    differing = 0
    for name, golden in chosen([] if names == ["all"] else names):
        began = time.process_time()
        found = run(golden)
        told = compare(name, golden, found)
        if told:
            print(report(name, golden, told))
        if told and verb == "accept":
            accept(name, found)
        differing += bool(told)
        verdict = "accepted" if verb == "accept" else "differs"
        spent = time.process_time() - began
        print(f"{name}: {verdict if told else 'as expected'}, {spent:.1f} s", flush=True)
    return int(bool(differing) and verb != "accept")
