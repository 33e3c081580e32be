"""Do the tests notice a wrong line?  `make mutants` draws lines, makes each wrong, and tries.

A mutant is one change of one expression of src: a comparison turned round, a sign changed, a
whole number one larger, a decimal number 1.1 times as large.  Packages have as many as their lines
of code ask for.  Which are drawn depends on the seed and on what the line says, not on where it
stands: the same set is drawn from another state of the tree, and with --again FILE the set of an
earlier run is kept; a mutant whose line is gone gives way to the next of its package.

All are written into one copy of the tree, each asleep until it is woken.  One run of the tests, of
a parametrised one its first case, notes which test comes to which mutant.  A second run collects
those tests and forks for each mutant: it is woken in the fork, and the tests that come to it run,
the files with the shortest first, until one fails or the processor time is over.  What acts when
a module is read has a run of its own.  What a fixture comes to counts for all tests of its file.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
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
# Imported by the copy: wakes a mutant; as a plug-in of pytest notes what comes to which, or forks.
SWITCH = """
import json, os, signal, time
AWAKE, NOTES, PLAN = map(os.environ.get, ("MUTANT", "MUTANT_NOTES", "MUTANT_PLAN"))
SECONDS, CAP = {"setup": 20.0, "call": 6.0}, float(os.environ.get("MUTANT_CAP", 0))
seen = set()
def note(*words):
    with open(os.environ["MUTANT_FILE"], "a") as file:
        file.write("\\t".join(map(str, words)) + "\\n")
def on(k):
    test = NOTES and os.environ.get("PYTEST_CURRENT_TEST")
    if test and (k, test) not in seen:
        seen.add((k, test))
        note("hit", k, test)
    return AWAKE == str(k)
def late(*_):
    raise TimeoutError("longer than a test of mutants may take")
def timed(when):
    signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS.get(when, 0.0) if NOTES else 0.0)
def pytest_collection_modifyitems(config, items):
    if NOTES:
        first = {item.nodeid.split("[")[0]: item for item in reversed(items)}
        items[:] = [item for item in items if first[item.nodeid.split("[")[0]] is item]
def pytest_runtest_setup(item):
    timed("setup")
def pytest_runtest_call(item):
    timed("call")
def pytest_runtest_teardown(item):
    timed("teardown")
def pytest_runtest_logreport(report):
    if NOTES:
        note("test", report.nodeid, report.when, report.outcome, round(report.duration, 4))
    elif report.failed:
        ended(AWAKE, report.nodeid)
def pytest_collectreport(report):
    if report.failed and AWAKE:
        ended(AWAKE, report.nodeid + " (not even collected)")
def ended(k, how):
    note("end", k, how)
    os._exit(0)
def pytest_runtestloop(session):
    if not PLAN:
        return None
    items = {}
    for item in session.items:
        items.setdefault(item.nodeid.split("[")[0], []).append(item)
    for k, tests in json.loads(PLAN and open(PLAN).read()):
        child = os.fork()
        if child == 0:
            attempt(k, [item for test in tests for item in items.get(test, [])])
        end = time.monotonic() + 30 * CAP
        while not (done := os.waitpid(child, os.WNOHANG))[0]:
            if time.monotonic() > end:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.02)
        if done[1]:
            note("end", k, "survived (time over)")
    return True
def attempt(k, items):
    global AWAKE
    AWAKE = os.environ["MUTANT"] = str(k)
    signal.setitimer(signal.ITIMER_PROF, CAP)
    for item, after in zip(items, [*items[1:], None]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
    ended(k, "survived")
"""


def kind_of(node: ast.AST) -> str | None:
    """The kind of mutant that an expression makes; None without one."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in TURNED:
        return "comparison"
    if isinstance(node, ast.BinOp) and type(node.op) in TURNED:
        joined = ast.List | ast.Tuple | ast.JoinedStr
        return None if isinstance(node.left, joined) or isinstance(node.right, joined) else "sign"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return "sign"
    if isinstance(node, ast.Constant) and type(node.value) is int:
        return "whole number"
    if isinstance(node, ast.Constant) and type(node.value) is float and node.value:
        return "decimal number"
    return None


def mutated(node: ast.AST) -> ast.AST:
    """What an expression becomes."""
    new: Any = copy.deepcopy(node)
    if isinstance(node, ast.Compare):
        new.ops = [TURNED[type(node.ops[0])]()]
    elif isinstance(node, ast.BinOp):
        new.op = TURNED[type(node.op)]()
    elif isinstance(node, ast.UnaryOp):
        new = new.operand
    elif isinstance(node, ast.Constant):
        new.value = new.value + 1 if type(new.value) is int else 1.1 * new.value
    return new


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
            if isinstance(node, ast.expr) and kind_of(node):
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
            kind = str(kind_of(node))
            file = str(path.relative_to(root / "src"))
            line = lines[node.lineno - 1].strip()
            name = [file, line, kind, ast.unparse(node)]
            many[tuple(name)] += 1
            name.append(str(many[tuple(name)]))
            rank = hashlib.sha256("|".join([str(seed), *name]).encode()).hexdigest()
            package = "/".join(Path(file).parts[:2]) if len(Path(file).parts) > 2 else "elastocal"
            found[package].append(
                {"name": name, "rank": rank, "number": node.lineno, "place": place,
                 "node": node}
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
        for m in kept:
            m["becomes"] = ast.unparse(mutated(m.pop("node")))
        chosen += [m | {"package": package} for m in kept]
    return sorted(chosen, key=lambda m: (m["name"][0], m["number"], m["place"]))


class Asleep(ast.NodeTransformer):
    """Each expression of `numbers` {id(node): k} becomes itself unless mutant k is awake."""

    def __init__(self, numbers: dict[int, int]) -> None:
        self.numbers = numbers

    def visit(self, node: ast.AST) -> Any:
        k = self.numbers.get(id(node))
        wrong = None if k is None else mutated(node)
        plain = self.generic_visit(node)
        if wrong is None:
            return plain
        switch = ast.parse(f"__import__('elastocal_mutants').on({k})", mode="eval").body
        return ast.IfExp(switch, wrong, plain)


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
            names = _read_at_import(trees[path], node)
            mutants[k]["at_import"] = bool(names)
            for name in names:
                used[name].append(k)
        trees[path] = Asleep({id(n): k for k, n in nodes.items()}).visit(trees[path])
        changed.add(path)
    for path, tree in trees.items():
        if not any(name in path.read_text() for name in used):
            continue
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


def _read_at_import(tree: ast.Module, node: ast.AST) -> set[str]:
    """The names under which functions use what a module, class or default holds."""
    outer = next(o for o in tree.body if node in ast.walk(o))
    inner = [f for f in ast.walk(outer) if isinstance(f, ast.FunctionDef)]
    if any(node in ast.walk(s) for f in inner for s in f.body):
        return set()
    if isinstance(outer, ast.FunctionDef | ast.ClassDef):
        return {outer.name}
    return {
        n.id for n in ast.walk(outer) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }


def pytest(root: Path, *words: str, **environment: str) -> str:
    """What pytest prints on the copy."""
    clean = os.environ | {
        "PYTHONPATH": str(root / "src"), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1",
    } | environment  # fmt: skip
    plain = ("-p", "elastocal_mutants", "--tb=no", "--hypothesis-seed=0", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", *plain, *words]
    done = subprocess.run(command, cwd=root, env=clean, text=True, capture_output=True)
    return done.stdout + done.stderr


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


def ordered(root: Path, mutant: dict[str, Any], times: dict[str, float], cap: float) -> list[str]:
    """The tests that stand and come to a mutant: that of an earlier run first, then the files with
    the shortest, as many as the time is for."""
    stands = {f: [t for t in ts if _stands(root, t)] for f, ts in mutant["tests"].items()}
    took = {f: sum(times.get(t, 1.0) for t in ts) for f, ts in stands.items()}
    words = [t for t in [mutant.get("first", "").split("[")[0]] if t and _stands(root, t)]
    total = 0.0
    for file in sorted(took, key=lambda f: took[f]):
        for test in sorted(stands[file], key=lambda t: times.get(t, 1.0)):
            total += times.get(test, 1.0)
            if total < 3 * cap and test not in words:
                words.append(test)
    return words


def tried(
    root: Path, mutants: list[dict[str, Any]], times: dict[str, float], cap: float
) -> dict[int, str]:
    """How each mutant ended: the test that catches it, "survived", or that none comes to it."""
    plans = {k: ordered(root, mutant, times, cap) for k, mutant in enumerate(mutants)}
    alone = [[k] for k, m in enumerate(mutants) if m.get("at_import") and plans[k]]
    together = [k for k, m in enumerate(mutants) if not m.get("at_import") and plans[k]]
    ends, file = dict.fromkeys(plans, "no test comes to it"), root / "ends"
    file.write_text("")
    for ks in [together, *alone]:
        plan = root / "plan"
        plan.write_text(json.dumps([(k, plans[k]) for k in ks]))
        given = {"MUTANT": str(ks[0])} if ks in alone else {}
        files = sorted({t.split("::")[0] for k in ks for t in plans[k]})
        if files:
            pytest(root, *files, MUTANT_PLAN=str(plan), MUTANT_FILE=str(file), MUTANT_CAP=str(cap),
                   **given)  # fmt: skip
    for line in file.read_text().splitlines():
        _, k, how = line.split("\t")
        ends[int(k)] = how
    return ends


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
    parser.add_argument("--cap", type=float, default=20.0, help="processor time for each mutant, s")
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
        print(pytest(told.copy, *told.tests, *out, MUTANT_NOTES="1", MUTANT_FILE=str(notes))[-300:])
        maps, times = recorded(notes)
    else:
        times = earlier["times"]
        beside = {m["name"][0]: m["tests"] for m in earlier["mutants"] if m["tests"]}
        maps = {k: known.get(tuple(m["name"]), {}).get("tests") or beside.get(m["name"][0], {})
                for k, m in enumerate(mutants)}  # fmt: skip
    print(f"which tests come to which: {time.monotonic() - start:.0f} s", flush=True)
    for k, mutant in enumerate(mutants):
        mutant["tests"] = maps.get(k, {})
        mutant["first"] = known.get(tuple(mutant["name"]), {}).get("end", "")
    for k, end in tried(told.copy, mutants, times, told.cap).items():
        mutants[k]["end"] = end
    done = {"mutants": mutants, "times": times}
    told.output.with_suffix(".json").write_text(json.dumps(done))
    told.output.with_suffix(".md").write_text(table(mutants) + "\n")
    print(table(mutants))


if __name__ == "__main__":
    main()
