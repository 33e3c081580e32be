"""What an MJCF file asks of MuJoCo, counted before MuJoCo sees it.

Its compiler takes memory and time by numbers in the file, however small that is.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path

from elastocal.errors import InputError, require
from elastocal.files import check_regular, check_size, open_input
from elastocal.model.xml_file import MAX_BYTES, Tag, XmlFile
from elastocal.text import printable, quoted

# A humanoid with hands and keyframes has 1500.  MuJoCo's compiler takes 1 s for so many bodies with
# free joints; its time grows with their square, and that of 20 000 is beyond a minute.
MOST_ELEMENTS = 5000
MOST_MESH_BYTES = 100_000_000  # of a file
MOST_FILES_BYTES = 300_000_000  # of all, each as often as it is named
MOST_CELLS = 1_000_000  # of all height fields
VERTEX_BYTES = 50  # of a mesh file, at least
# The largest numbers of attributes that MuJoCo sets memory aside by.
LARGEST: dict[str, dict[str, float]] = {
    "size": {"nuserdata": 1e6, "nkey": 1e3, "njmax": 1e6, "nconmax": 1e6, "nstack": 1e8,
             "memory": 4e9} | {f"nuser_{kind}": 1e3 for kind in
             ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
    "numeric": {"size": 1e5},
    "mesh": {"params": 200, "octree_maxdepth": 8},
    "composite": {"subgrid": 10},
}  # fmt: skip
NAMES = ("name", "class", "childclass", "model", "prefix", "file")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_UNITS = {unit: 1024.0**k for k, unit in enumerate("KMGTPE", start=1)}


def check_bounds(file: XmlFile) -> None:
    """Raise InputError where an MJCF file asks for more than an arm needs.

    Counted are elements as often as they are replicated, sizes, and what files it names: included
    models stand in its folder, and all are regular files.  The message names file and element.
    """
    weight = _Model(file.path).weight_of(file)
    require(
        weight <= MOST_ELEMENTS,
        f"{file.path}: makes {weight:.3g} elements of all it replicates and includes; more than "
        f"{MOST_ELEMENTS} are no arm, so keep the arm alone",
    )


class _Model:
    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        # The folder as it is named, and that of the file where the name is a link.
        self._roots = path.parent.resolve(), path.resolve().parent
        self._weights: dict[Path, float] = {}
        self._text = self._bytes = self._cells = 0

    def weight_of(self, file: XmlFile) -> float:
        """How many elements MuJoCo makes of a file and all that it includes."""
        path, real = file.path, file.path.resolve()
        if real not in self._weights:
            self._weights[real] = math.nan  # until it is known
            self._text += len(file.data)
            check_size(path, "MuJoCo model with all it includes", self._text, MAX_BYTES)
            self._weights[real] = self._weight(file, file.root)
        require(
            not math.isnan(self._weights[real]), f"{path}: includes itself; take out the <include>"
        )
        return self._weights[real]

    def _weight(self, file: XmlFile, tag: Tag) -> float:
        _check_sizes(file.path, tag)
        if tag.name == "hfield":
            sides = (math.prod(_numbers(tag.get(key))) for key in ("nrow", "ncol"))
            self._count_cells(file.path, math.prod(sides))
        inside = 1 + sum(self._weight(file, child) for child in tag.inside)
        return _count(tag) * (inside + sum(self._named(file, tag)))

    def _named(self, file: XmlFile, tag: Tag) -> Iterator[float]:
        """Weights of the files that it names: of a model its elements, of a grid its vertices."""
        name = tag.get("file")
        if tag.name == "attach":
            models = {one.get("name") or Path(one.get("file")).stem: one.get("file")
                      for one in file.tags if one.name == "model"}  # fmt: skip
            name = models.get(tag.get("model"), "")
        if tag.name in ("include", "model", "attach"):
            yield from map(self.weight_of, self._included(file.path, name) if name else ())
            return
        for each in [v for k, v in tag.stated.items() if k.startswith("file") and v]:
            for found in self._places(file, each):
                try:
                    size = self._size_of(found)
                except InputError as error:
                    told = f"{file.path}: <{printable(tag.name)}> names {error}"
                    raise InputError(told) from None
                if tag.name == "flexcomp":
                    yield size / VERTEX_BYTES
                elif tag.name == "hfield":
                    self._count_cells(file.path, _pixels(found))

    def _included(self, path: Path, name: str) -> Iterator[XmlFile]:
        """The files that an element of the file `path` includes by `name`: beside the model or
        beside the file itself, as versions of MuJoCo differ."""
        for found in {self._folder / name, path.parent / name}:
            if os.path.lexists(found):
                require(
                    any(found.resolve().is_relative_to(root) for root in self._roots),
                    f"{path}: includes {printable(name)}, which is outside its folder; put a copy "
                    "there",
                )
                yield XmlFile.read(found, "included model", "an MJCF file")

    def _places(self, file: XmlFile, name: str) -> set[Path]:
        """Where a file may stand; the last part of its name alone counts under `strippath`."""
        stated = [tag.get(f"{kind}dir") for tag in file.tags if tag.name == "compiler"
                  for kind in ("asset", "mesh", "texture")]  # fmt: skip
        names = {name, re.split(r"[\\/]", name)[-1]} - {""}
        places = {folder / place / each for folder in (file.path.parent, self._folder)
                  for place in ("", *stated) for each in names}  # fmt: skip
        return {place for place in places if os.path.lexists(place) and not place.is_dir()}

    def _size_of(self, path: Path) -> int:
        size = check_regular(path, "file")
        check_size(path, "file", size, MOST_MESH_BYTES)
        self._bytes += size
        require(
            self._bytes <= MOST_FILES_BYTES,
            f"{path}: with it the files that the model names have more than "
            f"{MOST_FILES_BYTES / 1e6:g} MB; keep the arm alone",
        )
        return size

    def _count_cells(self, path: Path, cells: float) -> None:
        self._cells += int(min(cells, 1e18))
        require(
            self._cells <= MOST_CELLS,
            f"{path}: <hfield> has more than {MOST_CELLS} points, which no arm needs; take it out",
        )


def _check_sizes(path: Path, tag: Tag) -> None:
    for key, text in tag.stated.items():
        stated = f"{path}: <{printable(tag.name)} {printable(key)}={quoted(text)}>"
        require(
            key in NAMES or not re.search(r"(?i)(?<!\S)[-+]?nan(?!\S)", text),
            f"{stated} is no number; correct it",
        )
        largest = LARGEST.get(tag.name, {}).get(key, math.inf)
        require(
            max(_numbers(text) if largest < math.inf else (), default=0.0) <= largest,
            f"{stated} asks for more than {largest:g}, which no arm needs; take it out",
        )


def _numbers(text: str) -> list[float]:
    """Sizes of the numbers in a text, of one with a unit ("2G") too."""
    found = _NUMBER.finditer(text)
    return [abs(float(m[0])) * _UNITS.get(text[m.end() : m.end() + 1].upper(), 1.0) for m in found]


def _count(tag: Tag) -> float:
    """How often MuJoCo makes what an element states; a dimension that is 0 or not there counts as
    one, and a vertex or segment is a body with three joints and a geom."""
    if tag.name not in ("replicate", "composite", "flexcomp"):
        return 1.0
    count = math.prod(max(n, 1.0) for n in _numbers(tag.get("count")))
    if tag.name == "replicate":
        return count
    return 5 * max(count, *(len(tag.get(k).split()) / 3 for k in ("point", "vertex")))


def _pixels(path: Path) -> float:
    """Points of a height field's file: a PNG says them where it begins, however small it is."""
    with open_input(path, "file of <hfield>") as handle:
        head = handle.read(24)
    if head.startswith(b"\x89PNG") and len(head) == 24:
        return math.prod(map(float, struct.unpack(">II", head[16:24])))
    return 0.0
