"""The benchmarks run at all, and compare like with like."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
MODULES = ("bench_part", "bench_clock", "bench_arms", "evaluation_numpy", "evaluation_rivals",
           "evaluation", "scaling", "startup", "diagnosis", "million_rows", "run", "fits_clock",
           "fits_arm", "fits_elastocal")  # fmt: skip


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    """The modules by name, as their own scripts import them; forgotten afterwards."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield {name: importlib.import_module(name) for name in MODULES}
    finally:
        sys.path.remove(str(BENCHMARKS))
        for name in MODULES:
            sys.modules.pop(name, None)


def test_b_by_hand_and_every_other_way_is_the_models_b(bench, tmp_path: Path) -> None:
    """At disturbed parameters; `agreement` ends the benchmark where one way differs."""
    evaluation, arms = bench["evaluation"], bench["bench_arms"]
    model = arms.kr270(tmp_path, arms.GEOMETRY)
    table, x = arms.poses(model, 20), arms.truth(model)
    expected = model.regressor(table, x).B.reshape(20, 3, -1)
    by_hand = bench["evaluation_numpy"].NumpyRegressor(model)(table.q, x)
    np.testing.assert_allclose(by_hand, expected, rtol=0, atol=1e-9)
    rivals = bench["evaluation_rivals"]
    symbolic = model._symbolic
    inputs = [*symbolic.arm.inputs.values(), symbolic.p]
    f = rivals.function_of(inputs, [symbolic.reading])
    arrays = [*evaluation.row_inputs(symbolic.arm, table), x]
    position = model.predict(table, x).reshape(20, 3)
    for way in (rivals.python_loop, rivals.buffered_loop, rivals.Mapped(f, 7)):
        found = way(arrays, 20) if isinstance(way, rivals.Mapped) else way(f, arrays, 20)
        np.testing.assert_allclose(found[0][..., 0], position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("how", ["plain", "ols"])
def test_a_fit_beside_its_peers_ends_at_the_arm(
    bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """At 30 poses of 50 µm, 25 parameters: new poses within 100 µm of where the arm is."""
    monkeypatch.setenv("ELASTOCAL_BACKEND", "")  # which the script sets
    arm = bench["fits_arm"]
    given = arm.campaign("mdh", 30, 1)
    arm.write(given, tmp_path)
    bench["fits_elastocal"].main(how, tmp_path, tmp_path / "found.npz")
    found = np.load(tmp_path / "found.npz")
    error = np.linalg.norm(found["predicted"] - given.fresh_exact, axis=1)
    assert np.sqrt((error**2).mean()) < 1e-4
    assert found["parameters"] >= 25


def test_an_exponent_is_the_slope_of_the_logarithms(bench) -> None:
    x = np.array([1e3, 1e4, 1e6])
    assert bench["bench_clock"].exponent(x, 3e-7 * x**1.3) == pytest.approx(1.3)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.000123, "1.23e-04"), (0.0123, "0.0123"), (1.234, "1.23"), (12.34, "12.3"), (1234.5, "1234"),
     (0.0, "0"), (None, "–"), (300, "300"), ("numpy", "numpy"), (9.999, "10.00")],
)  # fmt: skip
def test_numbers_have_three_digits(bench, value, text: str) -> None:
    assert bench["bench_part"].number(value) == text


def test_what_is_kept_reads_back_and_goals_have_their_direction(bench, tmp_path: Path) -> None:
    import json
    from dataclasses import asdict

    module = bench["bench_part"]
    part = module.Part("a", "A", [module.Table("t", ["x", "y"], [[1, 0.5], ["b", None]])])
    part.goal("at most 2", 2.5, 2.0, "s")
    part.goal("at least 10", 15.0, 10.0, "times", least=True)
    assert [g.met for g in part.goals] == [False, True]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(asdict(part)))
    assert module.read_part(path) == part


def test_only_what_stands_between_the_marks_of_the_page_is_written(
    bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = bench["run"]
    page = tmp_path / "performance.md"
    page.write_text(f"before\n{run.BEGIN}\nold\n{run.END}\nafter\n")
    monkeypatch.setattr(run, "PAGE", page)
    monkeypatch.setattr(run, "KEPT", tmp_path)
    monkeypatch.setattr(run, "FIGURE", tmp_path / "none.png")
    run.page()
    text = page.read_text()
    assert text.startswith(f"before\n{run.BEGIN}\n") and text.endswith(f"{run.END}\nafter\n")
    assert "old" not in text and "| goal |" in text
    kept = Path(__file__).parents[1] / "docs" / "performance.md"
    assert run.BEGIN in kept.read_text("utf-8") and run.END in kept.read_text("utf-8")


def test_memory_is_the_commands_own(bench) -> None:
    """A parent's memory is not counted: a child of this process starts with its peak."""
    held = np.ones(40_000_000)  # 320 MB
    ran = bench["bench_clock"].process([sys.executable, "-c", "print('done')"])
    assert held.sum() == len(held)
    assert (ran.code, ran.out.strip()) == (0, "done")
    assert ran.peak_mb < 100


@pytest.mark.long
@pytest.mark.parametrize("part", ["evaluation", "scaling", "startup", "diagnosis"])
def test_every_part_runs_in_tiny(part: str, tmp_path: Path) -> None:
    command = [sys.executable, str(BENCHMARKS / f"{part}.py"), "--size", "tiny"]
    done = subprocess.run([*command, "--json", str(tmp_path / "part.json")], capture_output=True,
                          text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "| " in done.stdout and (tmp_path / "part.json").exists()
