"""Do the tests notice a wrong line?  `make mutants` draws lines, makes each wrong, and tries.

A mutant is one change of one expression of src: a comparison turned round, a sign changed, a
whole number one larger, a decimal number 1.1 times as large.  Which are drawn depends on the seed
and on what the lines say, not on where they stand: the same set is drawn from another state of the
tree.  Each is written into a copy of the tree, where the tests of its package run, then those of
the whole contract, until one fails or the time is over.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TURNED: dict[type, type] = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add,
}  # fmt: skip
# What only words a message, types a value or marks a class does not change a result.
SILENT = (ast.Raise, ast.JoinedStr, ast.AnnAssign, ast.arg, ast.Assert, ast.MatchValue)
CONTRACT = ("tests/golden", "tests/cli", "tests/test_front_door.py")


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


def drawn(root: Path, seed: int, count: int) -> list[tuple[Path, int, ast.expr]]:
    """`count` mutants of all kinds alike: file, place in its tree and expression."""
    found: dict[str, list[tuple[str, Path, int, ast.expr]]] = {}
    for path in sorted((root / "src" / "elastocal").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        lines, many = text.splitlines(), Counter[str]()
        for place, node in enumerate(sites(ast.parse(text))):
            name = f"{path.name}|{lines[node.lineno - 1].strip()}|{ast.unparse(node)}"
            many[name] += 1
            rank = hashlib.sha256(f"{seed}|{name}|{many[name]}".encode()).hexdigest()
            found.setdefault(str(kind_of(node)), []).append((rank, path, place, node))
    share = -(-count // len(found))
    return [m[1:] for all_ in found.values() for m in sorted(all_, key=lambda m: m[0])[:share]]


def caught(root: Path, path: Path, place: int, seconds: float) -> str:
    """The first test that fails on the copy with this mutant, else "survived"."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    chosen = list(sites(tree))[place]

    class Wrong(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return mutated(node) if node is chosen else self.generic_visit(node)

    path.write_text(ast.unparse(ast.fix_missing_locations(Wrong().visit(tree))), encoding="utf-8")
    own = root / "tests" / path.relative_to(root / "src" / "elastocal").parts[0]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider"]
    tests = [*([str(own)] if own.is_dir() else []), *CONTRACT]
    clean = os.environ | {"PYTHONPATH": str(root / "src"), "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [*command, *tests], cwd=root, env=clean, text=True, capture_output=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return "survived (time over)"
    finally:
        path.write_text(text, encoding="utf-8")
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return (
        failed[0].split(" - ")[0] if failed else ["survived", "no test runs"][done.returncode > 0]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--copy", type=Path, default=Path("/tmp/elastocal-mutants"))
    parser.add_argument("--seed", type=int, default=47)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=300.0, help="for the tests of a mutant")
    told = parser.parse_args()
    shutil.rmtree(told.copy, ignore_errors=True)
    unwanted = shutil.ignore_patterns(".git", ".venv", "__pycache__", "site", ".hypothesis")
    shutil.copytree(ROOT, told.copy, ignore=unwanted, symlinks=True)
    ends = []
    print("| file | mutation | caught by |\n|---|---|---|")
    for path, place, node in drawn(told.copy, told.seed, told.count):
        ends.append(caught(told.copy, path, place, told.seconds))
        change = f"{ast.unparse(node)} → {ast.unparse(mutated(node))}".replace("|", "\\|")
        where = f"{path.relative_to(told.copy / 'src')}:{node.lineno}"
        print(f"| {where} | `{change[:90]}` | {ends[-1]} |", flush=True)
    print(f"\ncaught {sum(not end.startswith('survived') for end in ends)} of {len(ends)}")


if __name__ == "__main__":
    main()
