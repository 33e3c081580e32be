"""What the functions and results of the front door have in common.

Functions have their arguments checked by their annotations, which name kinds, `A | B`: of each
that is known here it is checked whether a value is one, and a value that is none is an InputError
that names the argument.  What a value means (a marker that is there, a share below 1) is for the
function itself.

Results are shown by `elastocal.report` and written by `elastocal.saving`, which lie above the
packages whose results they serve, and import them.  A result therefore asks for its views and
writers by name when they are wanted, as one asks for a plug-in: the only way up.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from numbers import Integral, Real
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ForwardRef, TypeVar

from elastocal.messages import GONE, InputError, did_you_mean, option, quoted, require

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
            InputError: The file cannot be written, the result came from it, or is not of its kind.

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
        import_module(VIEWS).write_page(self, path, inputs, command, seed)

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


# numpy is loaded where a value is looked at: the command line reads the kinds alone, for --help.

MOST = 10_000_000  # of anything that is counted: more is a slip of the key
# No length, angle, force, stiffness or compliance in SI units is as large; squares and products of
# several such numbers are still numbers.
LARGEST = 1e30
LARGEST_SEED = 2**63 - 1  # as far as whole numbers of files go
F = TypeVar("F", bound=Callable[..., Any])

Check = Callable[[Any], bool]


def _array(value: Any) -> bool:
    """Numbers, or what numpy makes numbers of, of any shape; not what it reads of a text."""
    import numpy as np

    try:
        numbers = np.asarray(value)
        if numbers.dtype == object:
            numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return False
    return numbers.dtype.kind in "iuf" and bool((np.abs(numbers) <= LARGEST).all())


def _values(value: Any, kinds: str = "iufc") -> bool:
    """Numbers, complex ones too; what computes with them says whether it can."""
    import numpy as np

    try:
        return np.asarray(value).dtype.kind in kinds
    except ValueError:  # rows of different length
        return False


def _truth(value: Any) -> bool:
    return type(value).__name__ in ("bool", "bool_")


def _whole(value: Any) -> bool:
    return isinstance(value, Integral) and not _truth(value)


def _counted(value: Any) -> bool:
    return _whole(value) and abs(value) <= MOST


def _number(value: Any) -> bool:
    size: Any = abs(value) if isinstance(value, Real) and not _truth(value) else math.inf
    return bool(size <= LARGEST)


def _list_of(check: Check, least: int = 0, most: float = math.inf) -> Check:
    def checked(value: Any) -> bool:
        several = isinstance(value, Collection) and not isinstance(value, str | bytes)
        # An array of numpy without an axis is a collection too, and has no length.
        sized = several and getattr(value, "ndim", 1) > 0
        return sized and least <= len(value) <= most and all(map(check, value))

    return checked


def _by_name(check: Check) -> Check:
    return lambda value: (
        isinstance(value, Mapping)
        and all(isinstance(k, str) and check(v) for k, v in value.items())
    )


def _is_a(name: str) -> Check:
    """Whether a class of that name is among those of a value, which need not be loaded for it."""
    return lambda value: any(each.__name__ == name for each in type(value).__mro__)


# Kind as it is annotated → how a message names it, and whether a value is one.  Names that are not
# here are classes; a value is one by the name of its own.
KINDS: dict[str, tuple[str, Check]] = {
    "int": (f"a whole number of at most {MOST:,}", _counted),
    "float": ("a finite number", _number),
    "bool": ("True or False", _truth),
    "str": ("a text", lambda v: isinstance(v, str)),
    "Path": ("a path", lambda v: isinstance(v, str | Path) and v != ""),
    "ArrayLike": ("finite numbers", _array),
    "Array": ("numbers", _values),
    "Sequence[int]": ("a list of whole numbers", _list_of(_counted)),
    "Sequence[str]": ("a list of names", _list_of(lambda v: isinstance(v, str))),
    "Sequence[int | str | Path]": ("a list of them", _list_of(lambda v: True)),
    "Sequence[TargetPose]": ("a list of TargetPose", _list_of(_is_a("TargetPose"))),
    "Mapping[str, float]": ("numbers by name", _by_name(_number)),
    "Mapping[str, Sequence[float]]": ("a list of numbers by name", _by_name(_list_of(_number, 1))),
    "Mapping[str, Mapping[str, float]]": (
        'mean and std by parameter, {"joint2.compliance": {"mean": 2.9e-7, "std": 3e-8}}',
        _by_name(_by_name(_number)),
    ),
    "Measurements": ("measurements (Model.read, Model.table)", _is_a("Measurements")),
    "tuple[ArrayLike, ArrayLike]": ("two corners", _list_of(_array, 2, 2)),
    "Progress": ("a function", callable),
    "None": ("None", lambda v: v is None),
    "Any": ("anything", lambda v: True),
}  # fmt: skip
ALIASES = {
    "AnyModel": "Model | Cell | str | Path",
    "Table": "Measurements | str | Path | DataFrame",
    "Prior": "Mapping[str, Mapping[str, float]] | GaussianPrior",
    "Seed": "int",
    **dict.fromkeys(
        ("Effort", "Method", "WeightKind", "IntervalKind", "FaultyReadings", "Convention"), "str"
    ),
}
# A load is the argument `load`, and in a table its column `force`; each is taken for the other.
SAME = {"force": "load", "load": "force"}
# Arguments that are the same wherever they stand; whether a load is one its function says.
BY_NAME: dict[str, list[tuple[str, Check]]] = {
    "seed": [(f"a whole number from 0 to {LARGEST_SEED}, or a numpy Generator",
              lambda v: (_whole(v) and 0 <= v <= LARGEST_SEED) or _is_a("Generator")(v))],
    "load": [("finite numbers", lambda v: _values(v, "iuf"))],
}  # fmt: skip


def checked_arguments(function: F) -> F:
    """The function, whose arguments are checked by its annotations before it runs.

    In place of a `seed` it takes a numpy Generator, of which one is drawn, and what SAME says.
    """
    signature = inspect.signature(function)
    kinds = {
        name: [KINDS.get(kind, (f"a {kind}", _is_a(kind))) for kind in kinds_of(given.annotation)]
        for name, given in signature.parameters.items()
        if isinstance(given.annotation, str)
    }
    none = KINDS["None"]
    kinds |= {n: BY_NAME[n] + [none] * (none in kinds[n]) for n in kinds if n in BY_NAME}
    renamed = {o: n for o, n in SAME.items() if n in kinds and o not in kinds}

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        for other, name in renamed.items():
            if other in kwargs and name not in kwargs:
                kwargs[name] = kwargs.pop(other)
        for name in kwargs:
            key = f"{function.__name__}.{name}"
            require(key not in GONE, f"{option(name)} is gone: {GONE.get(key)}")
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            unknown = [name for name in kwargs if name not in signature.parameters]
            near = did_you_mean(unknown[0], signature.parameters) if unknown else ""
            raise TypeError(f"{function.__qualname__}() {error}{near}") from None
        given = bound.arguments
        for name, known in kinds.items():
            if name in given and not any(fits(given[name]) for _, fits in known):
                takes = " or ".join(dict.fromkeys(words for words, _ in known))
                raise InputError(f"{option(name)} takes {takes}; found {shown(given[name])}")
        if hasattr(given.get("seed"), "integers"):
            given["seed"] = int(given["seed"].integers(LARGEST_SEED))
        return sealed(function(*bound.args, **bound.kwargs))

    return run  # type: ignore[return-value]


def sealed(result: Any) -> Any:
    """A result whose arrays, and those of arm and covariance in it, nobody can write into: what it
    says of itself, and what follows from it, would no longer be what was found."""
    kind = type(result).__name__
    if kind == "Covariance" or (isinstance(result, Saved) and kind != "Measurements"):
        import numpy as np

        for name, value in vars(result).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(result, name, np.broadcast_to(value, value.shape))
            else:
                sealed(value)
    return result


# The files that a result came from.
SOURCES = {
    "Comparison": "old.model.cell.path old.source new.source", "Plan": "model.cell.path",
    "Compensation": "targets.table.source", "Measurements": "source",
    "Calibration": "model.cell.path observations.table.source",
    "CalibratedArm": "model.cell.path source", "Diagnosis": "model.cell.path data",
}  # fmt: skip


def sources(result: Any) -> list[Path]:
    named = SOURCES.get(type(result).__name__, "").split()
    found = [path for path in (attrgetter(name)(result) for name in named) if path is not None]
    return [Path(path) for path in found if Path(path).is_file()]


def kinds_of(annotation: str) -> list[str]:
    """The members of a union, aliases resolved; a Literal is a text, which the function checks, and
    a Callable whatever can be called."""
    found: list[str] = []
    for part in re.split(r" \| (?![^\[]*\])", annotation.strip("\"'")):
        part = "str" if part.startswith("Literal[") else part
        part = "Progress" if part.startswith("Callable[") else part
        found += kinds_of(ALIASES[part]) if part in ALIASES else [part]
    return found


def shown(value: Any) -> str:
    if value is None or isinstance(value, str | Real | list | tuple | dict):
        return quoted(value)
    shape = getattr(value, "shape", ())
    return f"{type(value).__name__}{f' of shape {shape}' if shape else ''}"


def whole(name: str, given: Any) -> int:
    told = f"{option(name)} takes a whole number of at most {MOST:,}, 1 or more"
    require(_counted(given) and given > 0, f"{told}; found {quoted(given)}")
    return int(given)
