"""What takes long and is not what a test is of is short here, or done once."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer import testing

gc.disable()  # what is collected stays: to look for garbage in it is a third of the time

WHOLE = {"order"}  # tests of that search itself


SLOW = Path(__file__).with_name("slow.txt").read_text(encoding="utf-8").splitlines()


@pytest.hookimpl(tryfirst=True)  # before those that -m leaves out are
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    slow = {f"tests/{line}" for line in SLOW if not line.startswith("#")}
    for item in items:
        if {item.nodeid, item.nodeid.partition("[")[0]} & slow:
            item.add_marker("slow")


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def short_search(request: pytest.FixtureRequest) -> Iterator[None]:
    """One lot of new points and no second for the bound on the continuum, which in pools as small
    as those of tests is searched again and again; few steps in search of an order.  One start of
    the search instead of several."""
    if WHOLE & {*request.path.parts} or getattr(request.module, "WHOLE_SEARCH", False):
        yield
        return
    drift, search = (import_module(f"elastocal.planning.{n}") for n in ("execution", "search"))
    with pytest.MonkeyPatch.context() as patch:
        quick = replace(search.EFFORTS["quick"], starts=1)
        patch.setitem(search.EFFORTS, "quick", quick)
        patch.setattr(search, "REFINED", 0)
        patch.setattr(search, "POINTS", 1)
        patch.setattr(search, "STARTS", 1)
        patch.setattr(drift, "STEPS", 1000)
        patch.setattr(drift, "FEW", 1000)
        yield


@pytest.fixture(scope="module", autouse=True)
def plain_layout(request: pytest.FixtureRequest) -> Iterator[None]:
    """Figures whose labels may overlap: to lay them out takes as long as to draw them.  Where
    reports are not what is tested, what is drawn is not turned into SVG."""
    from elastocal.report import figures

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "LAYOUT", None)
        if "report" not in request.path.parts:
            patch.setattr(figures, "rendered", lambda figure: '<svg viewBox="0 0 1 1"></svg>')
        yield


@pytest.fixture(scope="session", autouse=True)
def once() -> Iterator[None]:
    """What is the same all through: the command line that typer builds of its functions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(testing, "_get_command", cache(testing._get_command))
        yield


@pytest.fixture(scope="session", autouse=True)
def known_instructions() -> Iterator[None]:
    """Models of the same cell are made in hundreds of tests: half of what that takes is to ask
    CasADi for the instructions, which are the same wherever the expressions are."""
    from elastocal.model import evaluate

    ask, known = evaluate.instructions, {}

    def remembered(function: Any) -> Any:
        key = function.serialize()
        if key not in known:
            known[key] = [*ask(function)]
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "instructions", remembered)
        yield
