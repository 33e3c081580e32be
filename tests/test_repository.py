"""The repository itself: what its files may mention, how long they are, what imports what."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "elastocal"

# Lowest first.  A layer imports from those below it, and within itself one way only.  A module
# or package that no layer names (cell, measurements, messages, files, ...) is at the bottom
# of all, so it imports from its like alone; what needs more is named here.
LAYERS = (
    {"model"},
    {"simulation", "identification"},
    {"planning", "diagnosis", "compensation", "correction_table", "export", "importing"},
    {"saving", "verbs"},
    {"report", "plugins"},
    {"cli", "__main__"},
)

# A file holds one idea whole: above the ceiling it holds several, and more files hold parts of one.
MOST_LINES, MOST_FILES = 800, 110

ELSEWHERE = ("--host", "--install", "--version")  # flags of other programs

# In two halves, so that this file does not mention them either.
NEVER_MENTIONED = ("/wo" + "rk/", "py" + "pi", "files.python" + "hosted", "index" + "-url",
                   "find" + "-links")  # fmt: skip
DATASETS_FOLDER = "../" + "shared"  # .ci/run alone may know it

# Measurements that others made and published; tests read them where they lie.
DATASET_TABLES = {
    "ur5_grid.csv", "ur5_random.csv", "wam_grid.csv", "wam_random.csv", "nominal_dh_ur5.csv",
    "nominal_dh_wam.csv", "load_0kg.csv", "load_1p25kg.csv", "load_2p5kg.csv",
    "link_masses_from_repo_iiwa7_m.csv", "series_A_6000.csv",
}  # fmt: skip
DATASET_FOLDERS = {
    "ur5_wam_tsinghua", "iiwa7_payload_torque", "robotcali_irb120_cable", "ur10_ipa_leica",
}  # fmt: skip


def repository_files() -> list[Path]:
    """What is, or would be, committed; nothing where git cannot tell."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True).stdout
    names = os.fsdecode(listed).split("\0")
    return [path for name in names if name and (path := ROOT / name).is_file()]


FILES = repository_files()
NAMES = {path: path.relative_to(ROOT).as_posix() for path in FILES}


def test_no_file_mentions_the_workplace_or_a_registry() -> None:
    found = []
    for path in FILES:
        text = path.read_bytes().decode("utf-8", errors="replace")
        unwanted = [word for word in NEVER_MENTIONED if word in text]
        if DATASETS_FOLDER in text and NAMES[path] != ".ci/run":
            unwanted.append(DATASETS_FOLDER)
        found += [f"{NAMES[path]}: {word}" for word in unwanted]
    assert not found


def test_no_dataset_of_others_is_part_of_the_repository() -> None:
    tables = [path for path in FILES if path.suffix.lower() in {".csv", ".parquet"}]
    copied = [NAMES[path] for path in tables if path.name in DATASET_TABLES]
    copied += [NAMES[path] for path in tables if DATASET_FOLDERS & set(path.parts)]
    assert not copied


def test_constraints_are_exact_versions_of_every_requirement_and_nothing_else() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = sum(project["optional-dependencies"].values(), project["dependencies"])
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    exact = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*==[0-9][A-Za-z0-9.!]*")
    assert not [line for line in lines if not exact.fullmatch(line)]
    names = [_canonical(line) for line in lines]
    assert len(set(names)) == len(names)
    assert {_canonical(line) for line in required} - set(names) <= {"elastocal"}


def _canonical(requirement: str) -> str:
    name = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert name, requirement
    return re.sub(r"[-_.]+", "-", name.group()).lower()


LENGTHS = {path: len(path.read_text().splitlines()) for path in SOURCE.rglob("*.py")}


def test_no_source_file_holds_several_ideas() -> None:
    assert {NAMES[path]: n for path, n in LENGTHS.items() if n > MOST_LINES} == {}


def test_no_idea_is_spread_over_several_files() -> None:
    assert len(LENGTHS) <= MOST_FILES


@cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text())))


def test_no_name_of_a_file_or_a_class_stands_for_two_things() -> None:
    stems = [path.stem for path in LENGTHS if not path.stem.startswith("__")]
    classes = [
        node.name for path in LENGTHS for node in nodes(path) if isinstance(node, ast.ClassDef)
    ]
    assert {name for names in (stems, classes) for name in names if names.count(name) > 1} == set()


def test_every_slow_test_is_there() -> None:
    lines = (ROOT / "tests" / "slow.txt").read_text(encoding="utf-8").splitlines()
    for path, _, name in (line.partition("::") for line in lines if not line.startswith("#")):
        assert f"def {name.partition('[')[0]}(" in (ROOT / "tests" / path).read_text("utf-8"), name


# Imports


def module_name(path: Path) -> str:
    """`model.effects` for model/effects/__init__.py; the root package is empty."""
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in SOURCE.rglob("*.py")}


def imported(module: str, path: Path) -> set[str]:
    """The modules of elastocal that `module` imports, at its top or inside a function."""
    full: list[str] = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            full += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module} imports relatively"
            full += [f"{node.module}.{alias.name}" for alias in node.names]
    names = {name.removeprefix("elastocal.") for name in full if name.startswith("elastocal.")}
    return {found for name in names if (found := _module_of(name)) not in ("", module)}


def _module_of(name: str) -> str:
    """`model.manipulator` for the name `model.manipulator.Model`."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name


@cache
def imports() -> dict[str, set[str]]:
    return {module: imported(module, path) for module, path in MODULES.items()}


def unit(module: str) -> str:
    return module.partition(".")[0]


def rank(module: str) -> int:
    """0 at the bottom; the root package, which gives the public names, stands above all."""
    if not module:
        return len(LAYERS) + 1
    return next((k for k, layer in enumerate(LAYERS, 1) if unit(module) in layer), 0)


def test_imports_point_down_the_layers() -> None:
    up = [
        f"{module} imports {target}"
        for module, targets in imports().items()
        for target in sorted(targets)
        if rank(target) > rank(module)
    ]
    assert not up


def test_no_circle_of_modules() -> None:
    TopologicalSorter(imports()).prepare()  # raises a CycleError that names the circle


def test_nobody_within_goes_by_the_front_door() -> None:
    """From elastocal itself all may take the version; its other names would be circles unseen."""
    taken = {
        (module, alias.name)
        for module, path in MODULES.items()
        for node in nodes(path)
        if isinstance(node, ast.ImportFrom) and node.module == "elastocal"
        for alias in node.names
        if alias.name not in ("__version__", *map(unit, MODULES))
    }
    assert not taken


def test_only_the_door_exports() -> None:
    """Every other package holds its docstring alone: a name is had from its module."""
    doors = {SOURCE / "__init__.py"}
    told = {
        str(path.relative_to(SOURCE))
        for path in sorted(SOURCE.rglob("__init__.py"))
        if path not in doors
        for node in ast.parse(path.read_text()).body
        if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
    }
    assert not told


def test_no_message_of_the_library_names_a_flag() -> None:
    """Options are named by `messages.option`: a keyword in Python, a flag on the command line."""
    named = {
        f"{module}: {text}"
        for module, path in MODULES.items()
        if unit(module) != "cli"
        for text in _strings(path)
        if set(re.findall(r"(?<![\w-])--[a-z-]+", text)) - set(ELSEWHERE)
    }
    assert not named


def _strings(path: Path) -> Iterator[str]:
    """Sentences in a module's code: no docstrings, no words that are passed to other programs."""
    told = {id(node.value) for node in nodes(path) if isinstance(node, ast.Expr)}
    for node in nodes(path):
        words = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if words and id(node) not in told and " " in node.value.strip():
            yield node.value


# Effects


def options(path: Path) -> set[int]:
    calls = [n for n in nodes(path) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    return {id(word) for n in calls if n.func.id == "option" for word in n.args}


def test_no_module_but_the_catalogue_names_an_effect() -> None:
    """Others ask an effect for its traits, or take the one they mean by its class's name.

    An option of a verb may be called as an effect is, as `base_frame` of export.
    """
    from elastocal.model.effects.catalogue import CATALOGUE

    named = [
        f"{module}, line {node.lineno}: {node.value}"
        for module, path in MODULES.items()
        if not module.startswith("model.effects")
        for node in nodes(path)
        if isinstance(node, ast.Constant) and node.value in CATALOGUE
        if id(node) not in options(path)
    ]
    assert named == []


def test_no_module_imports_scipy_stats_when_it_is_imported() -> None:
    """A third of a second at every start; `scipy.special` has the quantiles."""
    first = re.compile(r"^from scipy(\.stats import|(.*[ ,])stats\b)|^import scipy\.stats", re.M)
    assert not [path for path in SOURCE.rglob("*.py") if first.search(path.read_text("utf-8"))]
