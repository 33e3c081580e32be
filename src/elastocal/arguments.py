"""What the functions of the front door take: their arguments checked by their annotations.

    @checked_arguments
    def compare(old: CalibratedArm, *, level: float = 0.05, poses: int = 300, seed: int = 0): ...

An annotation names kinds, `A | B`: of each that is known here it is checked whether a value is one,
and a value that is none is an InputError that names the argument.  What a value means (a marker
that is there, a share below 1) is for the function itself.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from elastocal.above import Saved
from elastocal.errors import GONE, InputError, option, require
from elastocal.text import quoted

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


def _values(value: Any) -> bool:
    """Numbers; whether they can be computed with is for what computes with them."""
    import numpy as np

    return np.asarray(value).dtype.kind in "iufc"


def _truth(value: Any) -> bool:
    return type(value).__name__ in ("bool", "bool_")


def _whole(value: Any) -> bool:
    return isinstance(value, Integral) and not _truth(value)


def _counted(value: Any) -> bool:
    return _whole(value) and abs(value) <= MOST


def _number(value: Any) -> bool:
    size: Any = abs(value) if isinstance(value, Real) and not _truth(value) else math.inf
    return bool(size <= LARGEST)


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _list_of(check: Check, least: int = 0) -> Check:
    def checked(value: Any) -> bool:
        several = isinstance(value, Collection) and not isinstance(value, str | bytes)
        flat = several and getattr(value, "ndim", 1) == 1
        return flat and least <= len(value) and all(map(check, value))

    return checked


def _table_of(key: Check, check: Check) -> Check:
    def checked(value: Any) -> bool:
        return isinstance(value, Mapping) and all(key(k) and check(v) for k, v in value.items())

    return checked


def _seed(value: Any) -> bool:
    whole = _whole(value) and 0 <= value <= LARGEST_SEED
    return whole or type(value).__name__ == "Generator"


# Kind as it is annotated → how a message names it, and whether a value is one.  Names that are not
# here are classes; a value is one by the name of its own.
KINDS: dict[str, tuple[str, Check]] = {
    "int": (f"a whole number of at most {MOST:,}", _counted),
    "float": ("a finite number", _number),
    "bool": ("True or False", _truth),
    "str": ("a text", _text),
    "Path": ("a path", lambda v: isinstance(v, Path) or bool(_text(v) and v)),
    "ArrayLike": ("finite numbers", _array),
    "Array": ("numbers", _values),
    "Sequence[int]": ("a list of whole numbers", _list_of(_counted)),
    "Sequence[str]": ("a list of names", _list_of(_text)),
    "Sequence[TargetPose]": (
        "a list of TargetPose", _list_of(lambda v: type(v).__name__ == "TargetPose"),
    ),
    "Mapping[str, float]": ("numbers by name", _table_of(_text, _number)),
    "Mapping[str, Sequence[float]]": (
        "a list of numbers by name", _table_of(_text, _list_of(_number, 1)),
    ),
    "tuple[ArrayLike, ArrayLike]": (
        "two corners", lambda v: isinstance(v, Collection) and len(v) == 2 and all(map(_array, v)),
    ),
    "Progress": ("a function", callable),
    "None": ("None", lambda v: v is None),
}  # fmt: skip
CLASSES = {"a path"}  # words for what a function tells apart itself
ALIASES = {
    "AnyModel": "Model | Cell | str | Path",
    "Table": "Measurements | str | Path | DataFrame",
    "Prior": "Mapping | GaussianPrior",
    "Seed": "int",
    **dict.fromkeys(
        ("Effort", "Method", "WeightKind", "IntervalKind", "FaultyReadings", "Convention"), "str"
    ),
}
# A load is the argument `load`, and in a table its column `force`; each is taken for the other.
SAME = {"force": "load", "load": "force"}
SEED = (f"a whole number from 0 to {LARGEST_SEED}, or a numpy Generator", _seed)


def checked_arguments(function: F) -> F:
    """The function, whose arguments are checked by its annotations before it runs.

    In place of a `seed` it takes a numpy Generator, of which one is drawn, and what SAME says.
    """
    signature = inspect.signature(function)
    kinds = {
        name: [SEED] if name == "seed" else [_kind(text) for text in kinds_of(given.annotation)]
        for name, given in signature.parameters.items()
        if isinstance(given.annotation, str) and name != "self"
    }

    renamed = {o: n for o, n in SAME.items() if n in kinds and o not in kinds}

    def check(given: Mapping[str, Any], names: Collection[str]) -> None:
        for name in names:
            if name in given and not any(fits(given[name]) for _, fits in kinds[name]):
                takes = " or ".join(dict.fromkeys(words for words, _ in kinds[name]))
                raise InputError(f"{option(name)} takes {takes}; found {_shown(given[name])}")

    # What may be one of several classes the function tells apart itself, and says it better.
    simple = [
        name
        for name, known in kinds.items()
        if name != "load" and sum(words in CLASSES for words, _ in known) < 2
    ]

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        for other, name in renamed.items():
            if other in kwargs and name not in kwargs:
                kwargs[name] = kwargs.pop(other)
        for name in kwargs:
            key = f"{function.__name__}.{name}"
            require(key not in GONE, f"{option(name)} is gone: {GONE.get(key)}")
        bound = signature.bind(*args, **kwargs)
        given = bound.arguments
        check(given, simple)
        if hasattr(given.get("seed"), "integers"):
            given["seed"] = int(given["seed"].integers(LARGEST_SEED))
        try:
            return sealed(function(*bound.args, **bound.kwargs))
        except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError):
            check(given, kinds)
            raise

    return run  # type: ignore[return-value]


def sealed(result: Any) -> Any:
    """A result whose arrays, and those of the calibrated arm in it, nobody can write into: what it
    says of itself, and what follows from it, would no longer be what was found."""
    if isinstance(result, Saved) and type(result).__name__ != "Measurements":
        import numpy as np

        for name, value in vars(result).items():
            if isinstance(value, np.ndarray):
                view = value.view()
                view.flags.writeable = False
                object.__setattr__(result, name, view)
            else:
                sealed(value)
    return result


def kinds_of(annotation: str) -> list[str]:
    """The members of a union, aliases resolved; a Literal is a text, which the function checks."""
    found: list[str] = []
    for part in re.split(r" \| (?![^\[]*\])", annotation.strip("\"'")):
        part = "str" if part.startswith("Literal[") else part
        found += kinds_of(ALIASES[part]) if part in ALIASES else [part]
    return found


def _kind(name: str) -> tuple[str, Check]:
    def of_class(value: Any) -> bool:
        return any(each.__name__ == name for each in type(value).__mro__) or (
            name == "Mapping" and isinstance(value, Mapping)
        )

    if name not in KINDS:
        CLASSES.add(f"a {name}")
    return KINDS.get(name, (f"a {name}", of_class))


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str | Real | list | tuple | Mapping):
        return quoted(value)
    shape = getattr(value, "shape", ())
    return f"{type(value).__name__}{f' of shape {shape}' if shape else ''}"


def whole(name: str, given: Any, least: int | None = None) -> int:
    more = "" if least is None else f", {least} or more"
    if _whole(given) and abs(given) > MOST:
        more += f" and at most {MOST:,}"
    require(
        _counted(given) and (least is None or given >= least),
        f"{option(name)} takes a whole number{more}; found {quoted(given)}",
    )
    return int(given)
