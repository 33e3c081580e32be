"""Every reader of text takes time in proportion to its length, whatever the text is."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from elastocal.cell import read_cell
from elastocal.compensation import read_targets
from elastocal.files import read_json
from elastocal.importing.assemble import import_files
from elastocal.importing.mapping_file import read_mapping
from elastocal.measurements import read_matrix, read_measurements
from elastocal.messages import ElastocalError
from elastocal.model.dh import read_dh
from elastocal.model.mjcf import read_mjcf
from elastocal.model.urdf import read_urdf

KINDS = ("revolute",) * 6


def imported(preset: str) -> Callable[[Path], object]:
    return lambda path: import_files([path], read_mapping(None, [preset]), None, "out.csv")


READERS: dict[str, Callable[[Path], object]] = {
    "cell": read_cell,
    "mapping": lambda path: read_mapping(path, []),
    "json": lambda path: read_json(path, "result", 10**9, "look at it"),
    "measurements": lambda path: read_measurements(
        path, joint_kinds=KINDS, marker_names=("M1",), observe="position"
    ),
    "plan": lambda path: read_measurements(path, joint_kinds=KINDS, observe="plan"),
    "matrix": lambda path: read_matrix(path, "covariance"),
    "dh": read_dh,
    "targets": lambda path: read_targets(path, KINDS, "base"),
    "urdf": read_urdf,
    "mjcf": read_mjcf,
    **{preset: imported(preset) for preset in ("kuka", "abb", "spatialanalyzer", "leica", "ros")},
}
# What a text is made of, and how it begins: strings and brackets without an end, blanks, words and
# numbers of any length, lines of nothing.
PIECES = (
    '\\"""', '"', "'''", "\\", "[", "{", " ", "a", "a ", "A1", "1", "1,", "1;", "(", "_ ", "a=",
    "[a]\n", "a=1\n", "{A1 1}", "a{1,", "[[1", "[1],", ":=", "<a>", "<a/>", "\n", ",", "# ",
)  # fmt: skip
TEXTS = [("", piece) for piece in PIECES] + [
    ('x = "', "\\"), ('x = """', "a"), ("{A1 1,A2 ", "a"), ("{A1 1,A2 ", " "), ("p:=[[", "1"),
    ("p:=[[", " "), ("configuration,q1_deg,x_mm\n1,", "1"), ("a", " "), ("// axes=(", "("),
]  # fmt: skip
SIZES = 1000, 16_000
# A reader that is linear takes 16 times as long, one that is quadratic 256 times; the cost of a
# call and the noise of the clock are in both, so that what takes a two-hundredth of a second counts
# as that.
LEAST, MOST = 0.005, 60.0


def cost(reader: Callable[[Path], object], path: Path, text: str) -> float:
    path.write_text(text, encoding="utf-8")
    begun = time.process_time()
    with suppress(ElastocalError):
        reader(path)
    return time.process_time() - begun


@pytest.mark.parametrize("reader", READERS)
def test_time_grows_as_the_text_does(reader: str, tmp_path: Path) -> None:
    read, path = READERS[reader], tmp_path / "text"
    for beginning, piece in TEXTS:
        texts = [beginning + piece * (size // len(piece)) for size in SIZES]
        costs = [max(cost(read, path, text), LEAST) for text in texts]
        if costs[1] > MOST * costs[0]:  # a second look: another program had the processor
            costs = [max(cost(read, path, text), LEAST) for text in texts]
        assert costs[1] <= MOST * costs[0], (beginning, piece, costs)
