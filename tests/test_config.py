"""TOML files: what is wrong with one is told by file, key, what it takes and what was found."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import pytest
from pydantic import Field

from elastocal.config import (
    Numbers,
    Positive,
    Table,
    Vector3,
    checked,
    key,
    read_toml,
    required,
)
from elastocal.errors import InputError


class Wheel(Table):
    radius_mm: Positive = required("a positive number in mm")
    kind: Literal["round", "square"] | None = key('"round" or "square"')


class Cart(Table):
    wheel: list[Wheel] | None = key("tables, each headed [[wheel]]")
    part: dict[str, Wheel] = Field(default_factory=dict, description="tables by name")
    place_m: Vector3 | None = key("three numbers in m")
    spare: Annotated[list[Wheel | Numbers], Field(min_length=1)] | None = key("wheels or numbers")


@pytest.fixture
def told(tmp_path):
    def told(text):
        path = tmp_path / "cart.toml"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError) as caught:
            checked(Cart, read_toml(path, "cart file"), path)
        return str(caught.value).removeprefix(f"{path}: ")

    return told


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("wheels = 1", "unknown key wheels; did you mean wheel? the top level takes wheel, part,"),
        ("radius_mm = 1", "unknown key radius_mm; did you mean it in [[wheel]] or [part] or"),
        ("[[wheel]]\nradius = 1", "unknown key radius of [[wheel]] no. 1; missing unit: did you"),
        ("[[wheel]]\n", "key radius_mm of [[wheel]] no. 1 is missing; it takes a positive number"),
        ("[[wheel]]\nradius_mm = true", "key radius_mm of [[wheel]] no. 1 takes a positive number"),
        (
            "[[wheel]]\nradius_mm = 1\n[[wheel]]\nradius_mm = 1\nkind = 'rond'",
            "key kind of [[wheel]] no. 2 takes \"round\" or \"square\"; found 'rond' (did you mean "
            "'round'?)",
        ),
        ("wheel = [3]", "key [[wheel]] no. 1 takes a table; found 3"),
        ("[part.left]\nradius_mm = 0", "key part.left.radius_mm takes a positive number in mm"),
        ("[part.left.front]\nradius_mm = 1", 'unknown key part.left.front; write a full name in'),
        ("place_m = [0, 0, nan]", "key place_m takes three numbers in m; found [0, 0, nan]"),
        ("place_m = [0, 0, true]", "key place_m takes three numbers in m; found [0, 0, True]"),
        ("place_m =", "not valid TOML: "),
    ],
)  # fmt: skip
def test_the_first_thing_wrong_is_told_in_one_sentence(told, text, sentence):
    assert told(text).startswith(sentence)


@pytest.mark.parametrize(
    "value", [[], [1, 2], [1, 2, "3"], [1, 2, True], [1, 2, np.inf], [1, 2, 10**400], 1, "abc", {}]
)
def test_a_vector_is_three_finite_numbers(value):
    with pytest.raises(InputError, match="place_m takes three numbers in m"):
        checked(Cart, {"place_m": value}, "cart")
