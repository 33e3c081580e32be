"""study.toml: seed, option defaults, files and columns of a study."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from elastocal.errors import InputError, require
from elastocal.files import read_text
from elastocal.text import did_you_mean, listed, quoted

KEYS = ("title", "seed", "files", "options", "columns")
MOST_BYTES = 1_000_000


@dataclass(frozen=True)
class Definition:
    """A study as its study.toml states it.

    `files` are read by `run` and lie in the folder; `columns` maps each column of the results to
    its unit, or to `text`, `yes/no` or `count`, which are no units but types.
    """

    folder: Path
    title: str
    seed: int
    options: Mapping[str, Any]
    files: tuple[str, ...]
    columns: Mapping[str, str]

    @property
    def script(self) -> Path:
        return self.folder / "study.py"

    def with_options(self, assignments: Iterable[str]) -> Definition:
        """The same with KEY=VALUE in place of defaults; a value is of its default's type.

        Raises InputError where a key is unknown or a value is of another type.
        """
        options = dict(self.options)
        for text in assignments:
            key, equals, value = (part.strip() for part in text.partition("="))
            require(bool(equals), f"--set takes KEY=VALUE; found {quoted(text)}")
            require(
                key in options,
                f"--set {text}: {self.folder / 'study.toml'} has no option "
                f"{quoted(key)}{did_you_mean(key, options)}; it has "
                f"{listed(options) or 'none'}",
            )
            options[key] = _like(options[key], value, text)
        return replace(self, options=options)


def _like(default: Any, text: str, assignment: str) -> Any:
    """`text` as a value of the type of `default`."""
    if isinstance(default, str) and not text.startswith(('"', "'")):
        return text
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = None
    if type(default) is float and type(value) is int:
        value = float(value)
    kinds = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    kind = kinds.get(type(default), f"a TOML value like {quoted(default)}")
    if type(value) is not type(default):
        raise InputError(f"--set {assignment}: takes {kind}, as in study.toml")
    return value


def read_definition(folder: str | Path) -> Definition:
    """The study in `folder`.

    Raises InputError where the folder, study.py or study.toml is absent, or a key is wrong.
    """
    folder = Path(folder)
    require(folder.is_dir(), f"{folder}: no such folder; name the folder of a study")
    for name, what in (("study.py", "tasks() and run()"), ("study.toml", "seed and columns")):
        require(
            (folder / name).is_file(),
            f"{folder}: holds no {name}; a study has one, with its {what}",
        )
    path = folder / "study.toml"
    try:
        table = tomllib.loads(read_text(path, "study file", MOST_BYTES))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML ({error}); correct it there") from None
    for key in table:
        require(
            key in KEYS,
            f"{path}: unknown key {quoted(key)}{did_you_mean(key, KEYS)}; known are {listed(KEYS)}",
        )
    seed, title = table.get("seed"), table.get("title", folder.resolve().name)
    if type(seed) is not int or seed < 0:
        raise InputError(f"{path}: key seed takes a whole number from 0; found {quoted(seed)}")
    require(isinstance(title, str), f"{path}: key title takes text; found {quoted(title)}")
    options, columns = table.get("options", {}), table.get("columns", {})
    require(isinstance(options, dict), f"{path}: options is a table: write [options]")
    if not isinstance(columns, dict) or not columns:
        raise InputError(
            f'{path}: [columns] is missing; list there what run() returns, as in rms_um = "µm"'
        )
    for name, unit in columns.items():
        require(
            isinstance(unit, str),
            f'{path}: key columns.{name} takes the unit as text ("" for none, or text, yes/no, '
            f"count); found {quoted(unit)}",
        )
    return Definition(folder, title, seed, options, _files(path, table.get("files", [])), columns)


def _files(path: Path, names: Any) -> tuple[str, ...]:
    ok = isinstance(names, list) and all(isinstance(name, str) for name in names)
    require(ok, f'{path}: key files takes a list of names, as in files = ["cell.toml"]')
    for name in names:
        pure = PurePosixPath(name)
        require(
            not pure.is_absolute() and ".." not in pure.parts,
            f"{path}: key files names {quoted(name)}, outside the folder; a cluster cannot reach "
            "it, copy it into the folder",
        )
        require(
            (path.parent / name).is_file(),
            f"{path}: key files names {quoted(name)}, which is no file of the folder",
        )
    return tuple(names)
