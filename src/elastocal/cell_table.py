"""What every table of the cell file is made of: strict keys that say what they take."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector2 = Annotated[list[float], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[float], Field(min_length=3, max_length=3)]
Positive3 = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Positives = Annotated[list[Positive], Field(min_length=1)]
Numbers = Annotated[list[float], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=10_000_000)]


def key(takes: str) -> Any:
    """An optional key; `takes` completes the sentence 'key … takes …' in messages."""
    return Field(default=None, description=takes)


def required(takes: str) -> Any:
    """A key that must be there; `takes` as for `key`."""
    return Field(description=takes)


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
