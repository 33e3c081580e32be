"""What a result asks of the layers above it, found by name: the only way up.

How a result looks is known by `elastocal.report`, and how it is written to a file by
`elastocal.saving`; both lie above the packages whose results they serve, and import them.  A
result therefore does not import its views and writers; it asks for them by name when they are
wanted, as one asks for a plug-in.  Import order, start-up time and the layers stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ForwardRef

from elastocal.errors import InputError, option

if TYPE_CHECKING:
    from pandas import DataFrame as DataFrame  # for those who import it from here


def later(*rooms: str) -> dict[str, Any]:
    """Names that annotations alone need, by "module name name …": references, of which each loads
    its module only when `typing.get_type_hints` of a public function asks for it."""
    found = {}
    for module, *names in map(str.split, rooms):
        for name in names:
            found[name] = ForwardRef(f"import_module('{module}').{name}", module="importlib")
    return found


globals().update(later("pandas DataFrame"))

VIEWS = "elastocal.report.renderers"
WORDS = "elastocal.report.judgement_view"
WRITERS = "elastocal.saving"
NAMES = "elastocal.report.blocks"


class ByValue:
    """Objects that are equal where what they are made of is: to the last digit, NaN like NaN.

    Names of the files that they came from do not count.
    """

    def _compared(self) -> Mapping[str, Any]:
        told: Any = self
        return {f.name: getattr(self, f.name) for f in fields(told) if f.compare}

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return self is other or same(self._compared(), other._compared())

    def __hash__(self) -> int:
        plain = (v for v in self._compared().values() if isinstance(v, str | int))
        return hash((type(self).__name__, *plain))


ROUNDED = 1e-15  # of a number: what is left of it when it has been to a file in µm


def same(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if hasattr(a, "nnz") and hasattr(b, "nnz"):  # sparse
        return bool(a.shape == b.shape and (a != b).nnz == 0)
    if hasattr(a, "shape") or hasattr(b, "shape"):
        import numpy as np

        return np.shape(a) == np.shape(b) and bool(np.all((a == b) | ((a != a) & (b != b))))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if is_dataclass(a) and type(a) is type(b) and not isinstance(a, ByValue):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare)
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (a != a and b != b) or math.isclose(a, b, rel_tol=ROUNDED)
    return bool(a == b)


class Saved(ByValue):
    """Gives an object `save`."""

    def save(self, path: str | Path, **how: Any) -> None:
        """Write it to a file as the command line does, whole or not at all.

        Args:
            path: The file, whose ending says what of it is written.  `Calibration`: .json, or
                .csv for the table of its residuals.  `Plan`: .csv, and the JSON beside it.
                `Diagnosis`: .json, or .toml for the cell with the effects found, which the next
                `ec.identify` takes.  `Compensation`: .csv, the table of commands.  `Comparison`:
                .json.  `Measurements`: .csv, .parquet.  `NextPoses`: .csv, their plan, if any.
                `CalibratedArm`: .urdf, .xml or .mjcf (MuJoCo), .csv (DH table), .yaml, .json.
            **how: For an arm: `format` (as "mdh"), `load` (3,) N, `time_s`, `temperature_c`,
                `frames`, `base_frame`, `joint_correction` (a path), `poses` and `seed`, as
                `elastocal export` has them.

        Raises:
            InputError: The file cannot be written, or the result not under this ending.

        Examples:
            >>> arm = ec.identify("cell.toml", "data.csv").arm
            >>> arm.save("calibrated.urdf")
            >>> arm.save("modified_dh.csv", format="mdh")
        """
        import_module(WRITERS).save(self, path, **how)


class Result(Saved):
    """What every result of a verb offers: `report`, `plot`, `to_dataframe`, `save`, HTML."""

    def __str__(self) -> str:
        """The result as the command line prints it: tables and sentences."""
        return str(import_module(VIEWS).printed_text(self))

    def summary(self) -> str:
        """The same text."""
        return str(self)

    def _repr_html_(self) -> str:
        """The result as HTML, which notebooks show of themselves; text of the user is escaped."""
        return str(import_module(VIEWS).html(self))

    def report(
        self, path: str | Path, *, inputs: Any = None, command: str | None = None,
        seed: int | None = None,
    ) -> None:  # fmt: skip
        """Write the result's report: one HTML page that needs no network.

        Args:
            path: The page.
            inputs: Files that the result came from, which the page names with their SHA-256;
                default the cell and the tables, as far as they are files.
            command: The command line that repeats the run, where there is one.
            seed: The seed of the run, to be named.

        Raises:
            InputError: An input cannot be read, or the page not written.

        Examples:
            >>> fit = ec.identify("cell.toml", "data.csv")
            >>> commands = ec.compensate(fit, [1.8, 0.0, 0.9], load=[0, 0, -2600])
            >>> commands.report("commands.html", inputs=["cell.toml", "data.csv"])
        """
        write_page(self, path, inputs, command, seed)

    def plot(self, kind: str | None = None, interactive: bool = False, ax: Any = None) -> Any:
        """A figure of the result.

        Args:
            kind: Which of the result's figures, the first being the default.  `Calibration`:
                "residuals", "waterfall" (error budget), "sureness" (expected error over the
                workspace), "against_joints", "space", "over_time" (with times).  `Diagnosis`:
                "budget", "effects" and "curves" (of what was found), "space", "residuals",
                "against_joints", "over_time".  `Plan`: "poses", "curve" (where asked for).
                `NextPoses`: "gain" and those of its plan.  `Compensation`: "errors".
                `Comparison`: "moved".  `Measurements`: "joints".
            interactive: The arm in space ("space", "poses") to be turned.
            ax: Axes of matplotlib's subplots, in whose place the figure is drawn.

        Returns:
            matplotlib's Figure, the part of it in the place of `ax`, or plotly's where
            `interactive`.

        Raises:
            InputError: There is no such figure, or it cannot be turned; the message names those
                that there are.

        Examples:
            >>> figure = ec.identify("cell.toml", "data.csv").plot("waterfall")
            >>> figure.savefig("waterfall.png")
        """
        return import_module(VIEWS).plot(self, kind, interactive, ax)

    def to_dataframe(self) -> DataFrame:
        """The result's main table as a pandas data frame; units stand in the column names.

        Examples:
            >>> frame = ec.identify("cell.toml", "data.csv").to_dataframe()
            >>> list(frame.columns[:4])
            ['parameter', 'unit', 'value', 'std']
        """
        return import_module(VIEWS).frame(self)


def write_page(
    result: object, path: str | Path, inputs: Any, command: str | None, seed: int | None,
    **told: Any,
) -> None:  # fmt: skip
    import_module(VIEWS).write_page(result, Path(path), inputs, command, seed, **told)


def headline(result: object) -> str:
    """The verdict on a calibration, in the words of terminal, page and notebook."""
    return str(import_module(WORDS).judgement(result).headline)


def effects(cell: Any = None) -> DataFrame:
    """The physical effects that can be fitted.

    Args:
        cell: The cell, its file or model, whose arm decides on places and sizes; None takes the
            KR 270 of the demo.

    Returns:
        A row per effect: name, stage, whether the cell has it `on`, what it is, its places, the
        columns that it needs, and its parameters with unit, nominal value and typical size.

    Raises:
        InputError: The cell is wrong.

    Examples:
        >>> found = ec.effects("cell.toml")
        >>> "joint_compliance" in set(found["name"])
        True
    """
    import pandas as pd

    given = Path(__file__).parent / "demo" / "cell.toml" if cell is None else cell
    given = getattr(given, "cell", given)
    if not isinstance(given, str | Path) and type(given).__name__ != "Cell":
        found = type(cell).__name__
        raise InputError(f"{option('cell')} takes a Cell or the path of a cell file; found {found}")
    return pd.DataFrame(import_module(NAMES).effect_entries(given))
