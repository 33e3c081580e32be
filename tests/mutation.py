"""Do the tests notice a wrong line?  `make mutants` draws lines, makes each wrong, and tries.

A mutant is one change of one expression of src: a comparison turned round, a sign changed, a
whole number one larger, a decimal number 1.1 times as large.  Packages have as many as their lines
of code ask for.  Which are drawn depends on the seed and on what the line says, not on where it
stands: the same set is drawn from another state of the tree, and with --again FILE the set of an
earlier run is kept; a mutant whose line is gone gives way to the next of its package.

All are written into one copy of the tree, each asleep until the environment names it.  One run of
the tests, of a parametrised one its first case, records which test comes to which mutant; then
each is woken, and the tests that come to it run, the files with the shortest first, until one
fails or the time is over.  What a fixture of several tests comes to counts for all of its file.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import importlib
import json
import math
import os
import shutil
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
KINDS = ("comparison", "sign", "whole number", "decimal number")
TURNED: dict[type, type] = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add,
}  # fmt: skip
# What only words a message, types a value or marks a class does not change a result.
SILENT = (ast.Raise, ast.JoinedStr, ast.AnnAssign, ast.arg, ast.Assert, ast.MatchValue)
# Of the whole tree: they fail on a copy, or say nothing of a line of src.
LEFT_OUT = ("tests/test_repository.py", "tests/documentation", "tests/fuzz")
# What takes long to load, once for all runs.
LOADED = ("scipy.stats", "scipy.optimize", "casadi", "pinocchio", "coal", "cvxpy", "pandas",
          "matplotlib.pyplot", "plotly.graph_objects", "pydantic", "typer", "rich.table", "mujoco",
          "joblib", "hypothesis.strategies", "typer.testing")  # fmt: skip
# Imported by the copy: wakes a mutant, and as a plug-in of pytest notes what comes to which.
SWITCH = """
import os, signal, sys
AWAKE, NOTES = os.environ.get("MUTANT"), os.environ.get("MUTANT_NOTES")
SECONDS = {"setup": 20.0, "call": 6.0}
seen = set()
def note(*words):
    with open(NOTES, "a") as file:
        file.write("\\t".join(map(str, words)) + "\\n")
def on(k):
    if NOTES:
        test = os.environ.get("PYTEST_CURRENT_TEST", "")
        if (k, test) not in seen:
            seen.add((k, test))
            note("hit", k, test)
        return False
    return AWAKE == str(k)
def late(*_):
    raise TimeoutError("longer than a test of mutants may take")
def timed(when):
    signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS[when] if NOTES else 0.0)
def pytest_collection_modifyitems(config, items):
    if NOTES:
        first = {item.nodeid.split("[")[0]: item for item in reversed(items)}
        items[:] = [item for item in items if first[item.nodeid.split("[")[0]] is item]
def pytest_runtest_setup(item):
    timed("setup")
def pytest_runtest_call(item):
    timed("call")
def pytest_runtest_teardown(item):
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
def pytest_runtest_logreport(report):
    if NOTES:
        note("test", report.nodeid, report.when, report.outcome, round(report.duration, 4))
    elif report.failed:
        caught(report.nodeid)
def pytest_collectreport(report):
    if report.failed and not NOTES:
        caught(report.nodeid + " (not even collected)")
def caught(test):
    with open(os.environ["MUTANT_CAUGHT"], "a") as file:
        file.write(test + "\\n")
"""


def mutated(node: ast.AST) -> tuple[str, ast.AST] | None:
    """The kind of mutant that an expression makes, and what it becomes; None without one."""
    new: Any = copy.deepcopy(node)
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in TURNED:
        new.ops = [TURNED[type(node.ops[0])]()]
        return "comparison", new
    if isinstance(node, ast.BinOp) and type(node.op) in TURNED:
        joined = ast.List | ast.Tuple | ast.JoinedStr
        if isinstance(node.left, joined) or isinstance(node.right, joined):
            return None
        new.op = TURNED[type(node.op)]()
        return "sign", new
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return "sign", new.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        new.value = node.value + 1 if type(node.value) is int else 1.1 * node.value
        return ("whole number" if type(node.value) is int else "decimal number"), new
    return None


def sites(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions that act when a function runs, or when a module is read."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.AnnAssign) and child.value is not None:
            inner: list[ast.AST] = [child.value]
        elif isinstance(child, SILENT):
            continue
        else:
            inner = [child]
        for node in inner:
            if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal":
                continue
            if isinstance(node, ast.expr) and mutated(node):
                yield node
            if not (isinstance(node, ast.UnaryOp) and isinstance(node.operand, ast.Constant)):
                yield from sites(node)


def candidates(root: Path, seed: int) -> dict[str, list[dict[str, Any]]]:
    """All mutants of each package, in the order in which they are drawn."""
    found = defaultdict(list)
    for path in sorted((root / "src" / "elastocal").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines, many = text.splitlines(), defaultdict(int)
        for place, node in enumerate(sites(ast.parse(text))):
            kind, new = mutated(node)  # type: ignore[misc]
            file = str(path.relative_to(root / "src"))
            line = lines[node.lineno - 1].strip()
            name = [file, line, kind, ast.unparse(node)]
            many[tuple(name)] += 1
            name.append(str(many[tuple(name)]))
            rank = hashlib.sha256("|".join([str(seed), *name]).encode()).hexdigest()
            package = "/".join(Path(file).parts[:2]) if len(Path(file).parts) > 2 else "elastocal"
            found[package].append(
                {"name": name, "rank": rank, "number": node.lineno, "place": place,
                 "becomes": ast.unparse(new)}
            )  # fmt: skip
    return {p: sorted(all_, key=lambda m: m["rank"]) for p, all_ in found.items()}


def drawn(root: Path, seed: int, count: int, again: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """`count` mutants, each package's share by its lines of code, each kind in turn; those of
    `again` whose line still stands first."""
    found = candidates(root, seed)
    lines = {p: 0 for p in found}
    for path in (root / "src" / "elastocal").rglob("*.py"):
        parts = path.relative_to(root / "src").parts
        code = [s for s in path.read_text().splitlines() if s.strip() and s.strip()[0] != "#"]
        lines["/".join(parts[:2]) if len(parts) > 2 else "elastocal"] += len(code)
    exact = {p: count * n / sum(lines.values()) for p, n in lines.items()}
    share = {p: int(x) for p, x in exact.items()}
    for package in sorted(exact, key=lambda p: share[p] - exact[p])[: count - sum(share.values())]:
        share[package] += 1
    if again:  # the shares of the first time
        share = {p: sum(m["package"] == p for m in again) for p in {m["package"] for m in again}}
    chosen, before = [], {tuple(m["name"]): m for m in again}
    for package, wanted in sorted(share.items()):
        left = found.get(package, [])
        kept = [m for m in left if tuple(m["name"]) in before]
        gone = [m for m in again if m["package"] == package]
        gone = [m for m in gone if m["name"] not in [k["name"] for k in kept]]
        left = [m for m in left if m not in kept]
        for turn in range(wanted - len(kept)):
            kind = KINDS[(len(chosen) + len(kept)) % 4]
            kind = gone[turn]["name"][2] if turn < len(gone) else kind
            pick = next((m for m in left if m["name"][2] == kind), left[0] if left else None)
            if pick is None:
                break
            left.remove(pick)
            kept.append(pick | {"instead": gone[turn]["name"][:2] if turn < len(gone) else None})
        chosen += [m | {"package": package} for m in kept]
    return sorted(chosen, key=lambda m: (m["name"][0], m["number"], m["place"]))


class Asleep(ast.NodeTransformer):
    """Each expression of `numbers` {id(node): k} becomes itself unless mutant k is awake."""

    def __init__(self, numbers: dict[int, int]) -> None:
        self.numbers = numbers

    def visit(self, node: ast.AST) -> Any:
        k, found = self.numbers.get(id(node)), None
        if k is not None:
            found = mutated(node)
        plain = self.generic_visit(node)
        if found is None:
            return plain
        switch = ast.parse(f"__import__('elastocal_mutants').on({k})", mode="eval").body
        return ast.IfExp(switch, found[1], plain)


def set_in(root: Path, mutants: list[dict[str, Any]]) -> None:
    """The mutants asleep in the copy at `root`; what acts at import is noted where it is used."""
    (root / "src" / "elastocal_mutants.py").write_text(SWITCH)
    used: dict[str, list[int]] = defaultdict(list)
    by_file: dict[str, dict[int, int]] = defaultdict(dict)
    for k, mutant in enumerate(mutants):
        by_file[mutant["name"][0]][mutant["place"]] = k
    trees = {p: ast.parse(p.read_text()) for p in (root / "src" / "elastocal").rglob("*.py")}
    changed = set()
    for file, places in by_file.items():
        path = root / "src" / file
        nodes = {places[i]: n for i, n in enumerate(sites(trees[path])) if i in places}
        for k, node in nodes.items():
            name = _read_at_import(trees[path], node)
            if name:
                used[name].append(k)
        trees[path] = Asleep({id(n): k for k, n in nodes.items()}).visit(trees[path])
        changed.add(path)
    for path, tree in trees.items():
        for function in [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]:
            names = {n.id for s in function.body for n in ast.walk(s) if isinstance(n, ast.Name)}
            names |= {n.attr for s in function.body for n in ast.walk(s)
                      if isinstance(n, ast.Attribute)} | {function.name}  # fmt: skip
            for k in {k for name in names & {*used} for k in used[name]}:
                body = function.body
                first = 1 if ast.get_docstring(function) is not None else 0
                body.insert(first, ast.parse(f"__import__('elastocal_mutants').on({k})").body[0])
                changed.add(path)
    for path in changed:
        path.write_text(ast.unparse(ast.fix_missing_locations(trees[path])))


def _read_at_import(tree: ast.Module, node: ast.AST) -> str | None:
    """The name under which functions use what a module, class or default holds; else None."""
    for outer in tree.body:
        if node not in ast.walk(outer):
            continue
        if isinstance(outer, ast.FunctionDef):
            return outer.name if node not in [n for s in outer.body for n in ast.walk(s)] else None
        if isinstance(outer, ast.ClassDef):
            inner = [f for f in ast.walk(outer) if isinstance(f, ast.FunctionDef)]
            within = any(node in ast.walk(s) for f in inner for s in f.body)
            return None if within else outer.name
        target = getattr(outer, "targets", [getattr(outer, "target", None)])[0]
        return target.id if isinstance(target, ast.Name) else None
    return None


def pytest(root: Path, *words: str, seconds: float | None = None, **environment: str) -> str:
    """What pytest prints on the copy, in a fork of this process, which has loaded all but the
    copy; it and all that it started end after `seconds`."""
    for name in LOADED:
        with suppress(ImportError):
            importlib.import_module(name)
    told = root / "told"
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _be_pytest(root, told, words, environment)
    end, late = time.monotonic() + (seconds or math.inf), False
    while not os.waitpid(child, os.WNOHANG)[0]:
        late = time.monotonic() > end
        if late:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.05)
    return told.read_text(errors="replace") + "\nTIME" * late


def _be_pytest(root: Path, told: Path, words: tuple[str, ...], environment: dict[str, str]) -> None:
    """In the fork: one run of pytest; never returns."""
    code = 1
    try:
        os.setsid()
        handle = os.open(told, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for number in (1, 2):
            os.dup2(handle, number)
        os.environ.update(
            PYTHONPATH=str(root / "src"), OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1",
            **environment,
        )  # fmt: skip
        os.chdir(root)
        sys.path[:0] = [str(root / "src")]
        plain = ("--tb=no", "--hypothesis-seed=0", "-p", "no:cacheprovider")
        code = int(importlib.import_module("pytest").main(
            ["-p", "elastocal_mutants", *plain, *words]))  # fmt: skip
        sys.stdout.flush()
    finally:
        os._exit(code)


def recorded(notes: Path) -> tuple[dict[int, dict[str, list[str]]], dict[str, float]]:
    """Tests that come to each mutant, by file, and how long each test that passes takes."""
    hits, times, bad = defaultdict(set), defaultdict(float), set()
    for what, *rest in (line.split("\t") for line in notes.read_text().splitlines()):
        if what == "test":
            test = rest[0].split("[")[0]
            times[test] += float(rest[3])
            if rest[2] != "passed":
                bad.add(test)
        elif rest[1]:
            test, stage = rest[1].rsplit(" ", 1)
            hits[int(rest[0])].add((test.split("[")[0], stage))
    good = {t: s for t, s in times.items() if t not in bad}
    chosen: dict[int, dict[str, list[str]]] = {}
    for k, tests in hits.items():
        files: dict[str, list[str]] = defaultdict(list)
        for test, stage in sorted(tests):
            file = test.split("::")[0]
            more = [t for t in good if t.split("::")[0] == file] if stage == "(setup)" else [test]
            files[file] += [t for t in more if t in good and t not in files[file]]
        chosen[k] = {f: t for f, t in files.items() if t}
    return chosen, good


def tried(
    root: Path, k: int, files: dict[str, list[str]], times: dict[str, float], first: str, cap: float
) -> str:
    """The test that catches mutant k, or "survived", or why nothing was tried."""
    stands = {f: [t for t in ts if _stands(root, t)] for f, ts in files.items()}
    took = {f: sum(times.get(t, 1.0) for t in ts) for f, ts in stands.items() if ts}
    if not took:
        return "no test comes to it"
    words = [first] if first and _stands(root, first) else []
    total = 0.0
    for file in sorted(took, key=lambda f: took[f]):
        for test in sorted(stands[file], key=lambda t: times.get(t, 1.0)):
            total += times.get(test, 1.0)
            if total < 1.5 * cap and test not in words:
                words.append(test)
    failed = root / "failed"
    failed.unlink(missing_ok=True)
    end = pytest(root, "-x", *words[:400], seconds=cap, MUTANT=str(k), MUTANT_CAUGHT=str(failed))
    if failed.exists():
        return failed.read_text().splitlines()[0]
    if not any(word in end for word in (" passed", "TIME")):
        return "caught: nothing runs"
    return "survived (time over)" if end.endswith("TIME") else "survived"


def _stands(root: Path, test: str) -> bool:
    """Whether the tree still has the test's function."""
    file, *names = test.split("[")[0].split("::")
    path = root / file
    return path.is_file() and f"def {names[-1]}(" in path.read_text()


def copied(tree: Path, root: Path) -> None:
    shutil.rmtree(root, ignore_errors=True)
    unwanted = shutil.ignore_patterns(".git", ".venv", "__pycache__", "site", ".hypothesis")
    shutil.copytree(tree, root, ignore=unwanted, symlinks=True)


def table(mutants: list[dict[str, Any]]) -> str:
    rows = ["| file | line | mutation | caught by |", "|---|---|---|---|"]
    for m in mutants:
        file, line, _, old, _ = m["name"]
        shown = f"{old} → {m['becomes']}".replace("|", "\\|")
        line = line.replace("|", "\\|")
        rows.append(f"| {file}:{m['number']} | `{line[:70]}` | {shown[:70]} | {m['end']} |")
    count = sum(not m["end"].startswith(("survived", "no test")) for m in mutants)
    replaced = [f"- instead of {' '.join(m['instead'])}: {m['name'][0]}:{m['number']}"
                for m in mutants if m.get("instead")]  # fmt: skip
    return "\n".join([*rows, "", f"caught {count} of {len(mutants)}", *replaced])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--tree", type=Path, default=ROOT, help="the tree to try")
    parser.add_argument("--copy", type=Path, default=Path("/tmp/elastocal-mutants"))
    parser.add_argument("--seed", type=int, default=47)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--cap", type=float, default=60.0, help="seconds for each mutant")
    parser.add_argument("--again", type=Path, help="the .json of an earlier run: its set and map")
    parser.add_argument("--fresh", action="store_true", help="with --again: a map of its own")
    parser.add_argument("--tests", nargs="*", default=["tests"])
    parser.add_argument("-o", "--output", type=Path, default=Path("/tmp/mutants"))
    told = parser.parse_args()
    earlier = json.loads(told.again.read_text()) if told.again else {"mutants": [], "times": {}}
    mutants = drawn(told.tree, told.seed, told.count, earlier["mutants"])
    copied(told.tree, told.copy)
    set_in(told.copy, mutants)
    notes = told.copy / "notes"
    known = {tuple(m["name"]): m for m in earlier["mutants"]}
    start = time.monotonic()
    if not told.again or told.fresh:
        out = [f"--ignore={p}" for p in LEFT_OUT]
        print(pytest(told.copy, *told.tests, *out, MUTANT_NOTES=str(notes))[-300:], flush=True)
        maps, times = recorded(notes)
    else:
        times = earlier["times"]
        beside = {m["name"][0]: m["tests"] for m in earlier["mutants"] if m["tests"]}
        maps = {k: known.get(tuple(m["name"]), {}).get("tests") or beside.get(m["name"][0], {})
                for k, m in enumerate(mutants)}  # fmt: skip
    print(f"which tests come to which: {time.monotonic() - start:.0f} s", flush=True)
    for k, mutant in enumerate(mutants):
        mutant["tests"] = maps.get(k, {})
        first = known.get(tuple(mutant["name"]), {}).get("end", "")
        first = first if "::" in first else ""
        mutant["end"] = tried(told.copy, k, mutant["tests"], times, first, told.cap)
        print(k, mutant["name"][:2], mutant["becomes"], mutant["end"], flush=True)
        done = {"mutants": mutants[: k + 1], "times": times}
        told.output.with_suffix(".json").write_text(json.dumps(done))
    told.output.with_suffix(".md").write_text(table(mutants) + "\n")
    print(table(mutants))


if __name__ == "__main__":
    main()
