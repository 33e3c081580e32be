"""Which engine evaluates a function: asked for, chosen by rule, refused, and reported."""

from __future__ import annotations

import pickle
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.backends import compilations, counting_compiler, failing_compiler, system_compiler
from support.cells import kr270_cell, kr270_chain, random_table

from elastocal.errors import InputError
from elastocal.model import (
    BackendReport,
    BatchFunction,
    Model,
    Work,
    chosen_backend,
    summary,
)
from elastocal.model import evaluate as backend_module

X = ca.SX.sym("x", 2)
ROWS = np.linspace(0.1, 2.0, 20).reshape(10, 2)
MANY = np.linspace(0.1, 2.0, 400).reshape(200, 2)  # too many for CasADi row by row


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No cache, and no choice of another test."""
    monkeypatch.setenv("ELASTOCAL_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("ELASTOCAL_BACKEND", raising=False)


def function(backend: str | None = None) -> BatchFunction:
    return BatchFunction([X], [ca.vertcat(ca.sin(X[0]) * X[1], X[0] / X[1])], backend)


def without_compiler(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(folder))


def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under "auto" compiling pays at once."""
    monkeypatch.setattr(backend_module, "COMPILE_START", 0.0)
    monkeypatch.setattr(backend_module, "COMPILE_INSTRUCTION", 0.0)


# --- asked for -----------------------------------------------------------------------------


def test_auto_is_the_default() -> None:
    assert chosen_backend() == "auto"


def test_argument_before_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ELASTOCAL_BACKEND", "compiled")
    assert chosen_backend() == "compiled"
    assert chosen_backend("auto") == "auto"


def test_an_unknown_name_is_refused_with_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"backend: unknown backend 'nunpy'.*'numpy'"):
        function("nunpy")
    with pytest.raises(InputError, match="unknown backend 'fortran'"):
        function("fortran")
    monkeypatch.setenv("ELASTOCAL_BACKEND", "complied")
    with pytest.raises(InputError, match=r"ELASTOCAL_BACKEND in the environment: .*'compiled'"):
        function()(ROWS)


def test_numpy_never_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", str(counting_compiler(tmp_path)))
    impatient(monkeypatch)
    plain = function("numpy")
    plain(ROWS)
    assert plain.report.backend == "numpy"
    assert compilations(tmp_path) == 0


def test_compiled_compiles_at_once_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", str(counting_compiler(tmp_path)))
    compiled = function("compiled")
    for _ in range(3):
        compiled(ROWS)
    assert compiled.report.backend == "compiled"
    assert compilations(tmp_path) == 1


# --- chosen by rule ------------------------------------------------------------------------


def test_few_rows_are_evaluated_by_casadi_as_by_numpy() -> None:
    """Sparse outputs, what is the same in all rows, no row at all; and no more of them than pay."""
    p = ca.SX.sym("p", 2)
    sparse = ca.diagcat(X[0] * p[1], ca.atan2(X[1], p[0]), ca.if_else(X[0] > 1, X[1] ** 3, 0))
    few, plain = (BatchFunction([X, p], [sparse, X + p], name) for name in (None, "numpy"))
    for n in (0, 1, 10):
        for found, expected in zip(*(f(ROWS[:n], ROWS[3]) for f in (few, plain)), strict=True):
            np.testing.assert_array_equal(found, expected)
        assert few.report.backend == "casadi"
    few(MANY, ROWS[3])
    assert few.report.backend == "numpy"


def test_auto_replays_what_compiling_would_not_pay_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", str(counting_compiler(tmp_path)))
    once = function()
    once(MANY)
    assert once.report.backend == "numpy"
    assert compilations(tmp_path) == 0


def test_auto_compiles_once_replaying_has_cost_as_much(monkeypatch: pytest.MonkeyPatch) -> None:
    system_compiler()
    monkeypatch.setattr(backend_module, "COMPILE_INSTRUCTION", 0.0)
    calls = function()
    # Of five calls' waste the price of the compiler, so that the fifth call buys it.
    each = Work(calls.n_instructions)
    each.add(len(MANY), 1)
    monkeypatch.setattr(backend_module, "COMPILE_START", 4.5 * each.wasted)
    used = []
    for _ in range(7):
        calls(MANY)
        used.append(calls.report.backend)
    assert used == ["numpy"] * 4 + ["compiled"] * 3


def test_the_call_itself_counts_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    system_compiler()
    monkeypatch.setattr(backend_module, "NUMPY_ROW", 1.0)
    monkeypatch.setattr(backend_module, "CASADI_ROW", 1.0)
    large = function()
    large(MANY)
    assert large.report.backend == "compiled"


def test_auto_uses_what_is_cached_before_compiling_pays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", str(counting_compiler(tmp_path)))
    function("compiled")(ROWS)
    monkeypatch.setattr(backend_module, "LOOKUP_START", 0.0)
    monkeypatch.setattr(backend_module, "LOOKUP_INSTRUCTION", 0.0)
    again = function()
    again(ROWS)
    assert (again.report.backend, again.report.cached) == ("compiled", True)
    assert compilations(tmp_path) == 1


def test_more_instructions_rows_or_blocks_waste_more() -> None:
    def wasted(instructions: int, rows: int, blocks: int) -> float:
        work = Work(instructions)
        work.add(rows, blocks)
        return work.wasted

    assert wasted(100, 1000, 1) < min(
        wasted(200, 1000, 1), wasted(100, 9000, 1), wasted(100, 1000, 2)
    )


# --- refused -------------------------------------------------------------------------------


def test_no_compiler_is_replayed_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_compiler(monkeypatch, tmp_path)
    impatient(monkeypatch)
    without = function()
    np.testing.assert_allclose(without(MANY)[0][:, 1, 0], MANY[:, 0] / MANY[:, 1])
    assert without.report.backend == "numpy"
    assert "no C compiler on the PATH" in without.report.reason


def test_compiled_without_a_compiler_says_how_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_compiler(monkeypatch, tmp_path)
    with pytest.raises(InputError, match=r"no C compiler on the PATH.*install one .*numpy"):
        function("compiled")(ROWS)


def test_a_cc_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-cc -m64")
    with pytest.raises(InputError, match="CC names 'no-such-cc', which is no program here"):
        function("compiled")(ROWS)


def test_cc_may_hold_options(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", f"{system_compiler()} -DUNUSED='a b'")
    optioned = function("compiled")
    optioned(ROWS)
    assert "UNUSED=a b" in str(optioned.report.compiler)


def test_a_compiler_that_fails_is_replayed_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", str(failing_compiler(tmp_path)))
    impatient(monkeypatch)
    failing = function()
    failing(MANY)
    assert failing.report.backend == "numpy"
    assert "exit code 3: out of ink" in failing.report.reason
    with pytest.raises(InputError, match="out of ink"):
        function("compiled")(ROWS)


def test_complex_numbers_are_replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    system_compiler()
    compiled = function("compiled")
    found = compiled(ROWS + 1e-30j)[0]
    assert compiled.report.backend == "numpy"
    expected = np.cos(ROWS[:, 0]) * ROWS[:, 1] + np.sin(ROWS[:, 0])
    np.testing.assert_allclose(found[:, 0, 0].imag / 1e-30, expected, rtol=1e-14)


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
@pytest.mark.parametrize("wrong", [
    (), (ROWS, ROWS), (ROWS[:, :1],), (ROWS[None],), (np.ones(3),), (np.float64(1),),
])  # fmt: skip
def test_arrays_of_other_shapes_are_refused(backend: str, wrong: tuple) -> None:
    if backend == "compiled":
        system_compiler()
    with pytest.raises(ValueError, match="per row"):
        function(backend)(*wrong)


def test_inputs_of_different_lengths_are_refused() -> None:
    p = ca.SX.sym("p", 2)
    with pytest.raises(ValueError, match="per row"):
        BatchFunction([X, p], [X + p])(ROWS, ROWS[:4])


# --- reported ------------------------------------------------------------------------------


def test_a_report_before_any_call() -> None:
    assert function().report == BackendReport("none")
    assert summary([function().report]) == "nothing evaluated yet"


def test_the_compiler_and_the_cache_are_reported() -> None:
    path = system_compiler()
    for cached in (False, True):
        compiled = function("compiled")
        compiled(ROWS)
        assert str(compiled.report.compiler).startswith(path)
        assert compiled.report.cached is cached


def test_a_summary_counts_expressions() -> None:
    compiled = BackendReport("compiled", "cc 12", 2, True)
    text = summary([compiled, compiled, BackendReport("numpy"), BackendReport("none")])
    assert text == (
        "2 of 3 expressions: compiled (cc 12; 2 threads); 1 of 3 expressions: numpy (1 thread)"
    )


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
def test_a_model_reports_what_evaluates_it(backend: str) -> None:
    if backend == "compiled":
        system_compiler()
    model = Model.assembled(kr270_chain(), kr270_cell(["joint_compliance"]), backend=backend)
    model.predict(random_table(model.chain, 2, 0))
    assert model.backend_report().startswith(f"{backend} (")
    assert model.rigid.backend_report() == "nothing evaluated yet"


def test_a_tape_travels_to_another_process() -> None:
    system_compiler()
    for backend in ("numpy", "compiled"):
        sent = function(backend)
        expected = sent(ROWS)[0]
        arrived = pickle.loads(pickle.dumps(sent))
        np.testing.assert_array_equal(arrived(ROWS)[0], expected)
        assert arrived.report.backend == backend
