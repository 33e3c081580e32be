"""The keys of the knowledge file, and complaints about them as sentences."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from elastocal.errors import InputError
from elastocal.text import did_you_mean, listed, quoted

Name = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]
Terms = Annotated[dict[Name, float], Field(min_length=1)]
FACTORS = 'factors by parameter, as in { "joint2.compliance" = 1.0, "joint3.compliance" = -1.0 }'


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class PriorTable(Table):
    mean: float = Field(description="a finite number in SI units")
    std: Positive = Field(description="a positive number in SI units")


class BoundsTable(Table):
    parameter: Name = Field(description='the name of a parameter, as in "joint2.compliance"')
    lower: float | None = Field(None, description="a finite number in SI units; without one, none")
    upper: float | None = Field(None, description="a finite number in SI units; without one, none")


class EqualityTable(Table):
    terms: Terms = Field(description=FACTORS)
    value: float = Field(0.0, description="a finite number in SI units")
    label: str = Field("", description="a text")


class SemidefiniteTable(Table):
    entries: Annotated[list[list[str | float | dict[str, float]]], Field(min_length=1)] = Field(
        description="rows of parameter names, numbers or factors by parameter, as in "
        '[["a", "b"], ["b", "c"]]'
    )
    label: str = Field("", description="a text")


class KnowledgeTable(Table):
    physical: bool = Field(False, description="true or false")
    prior: dict[Name, PriorTable] = Field(
        default_factory=dict,
        description='tables by parameter, as in [prior."joint2.compliance"]',
    )
    bounds: list[BoundsTable] = Field(default_factory=list, description="[[bounds]] tables")
    equality: list[EqualityTable] = Field(default_factory=list, description="[[equality]] tables")
    semidefinite: list[SemidefiniteTable] = Field(
        default_factory=list, description="[[semidefinite]] tables"
    )


TABLES: dict[str, type[Table]] = {
    "prior": PriorTable,
    "bounds": BoundsTable,
    "equality": EqualityTable,
    "semidefinite": SemidefiniteTable,
}


def complaint(path: Path, data: dict[str, Any], error: ValidationError) -> InputError:
    """The first problem pydantic found in the parsed TOML `data`, told as an InputError."""
    problems = error.errors(include_url=False, include_context=False)
    # A misspelt key is the cause, the key then missing only its consequence.
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    loc = first["loc"]
    where, table, key = _place(loc)
    takes = table.model_fields[key].description if key in table.model_fields else "a table"
    found = _found(data, loc)
    if first["type"] == "missing":
        return InputError(f"{path}: {where}key '{key}' is missing; it takes {takes}")
    if key not in table.model_fields and first["type"] == "extra_forbidden":
        if isinstance(found, dict) and loc[0] == "prior":
            full = f"{loc[1]}.{key}"
            return InputError(
                f'{path}: write a parameter\'s full name in quotes: [prior."{full}"], not '
                f"[prior.{full}]"
            )
        valid = list(table.model_fields)
        return InputError(
            f"{path}: {where}unknown key {quoted(key)}{did_you_mean(key, valid)}; "
            f"there are {listed(valid)}"
        )
    if isinstance(found, dict) and len(loc) > 2 and key == "terms":
        return InputError(f"{path}: {where}key 'terms' takes {FACTORS}; write full names in quotes")
    shown = quoted(found) if not isinstance(found, bool) else str(found).lower()
    return InputError(f"{path}: {where}key '{key}' takes {takes}; found {shown}")


def _place(loc: tuple[int | str, ...]) -> tuple[str, type[Table], str]:
    """Where a complaint lies ("[[bounds]] no. 2, "), the table there, and its key."""
    head = str(loc[0])
    if len(loc) == 1 or head not in TABLES:
        return "", KnowledgeTable, head
    entry = f"[prior.{quoted(loc[1])}]" if head == "prior" else f"[[{head}]] no. {int(loc[1]) + 1}"
    if len(loc) == 2:
        return f"{entry}: ", KnowledgeTable, head
    return f"{entry}, ", TABLES[head], str(loc[2])


def _found(data: Any, loc: tuple[int | str, ...]) -> Any:
    """What stands at a location, as far as the file goes; pydantic adds names of union branches."""
    for part in loc:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            break
    return data
