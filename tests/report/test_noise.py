"""What the report says of noise, method and intervals: everything named, nothing claimed twice."""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from support.pages import Page

from elastocal.identification.constrained import ActiveConstraint
from elastocal.identification.findings import judged
from elastocal.identification.intervals import KINDS as INTERVALS
from elastocal.identification.noise_choice import Trial
from elastocal.identification.noise_structure import noise_models
from elastocal.identification.noise_summary import LackOfFit, Noise, NoiseSize
from elastocal.identification.options import METHODS
from elastocal.identification.residuals import summarise_residuals
from elastocal.report.identification_view import summary_lines
from elastocal.report.method_and_noise import (
    candidate_rows,
    constraints_line,
    does_noise_explain_it,
    intervals_line,
    kind_in_words,
    method_and_weights,
    noise_model_line,
    prior_line,
    repeats_line,
    shape_line,
    size_rows,
)
from elastocal.report.page import page_of
from elastocal.report.terminal import print_result

MISFIT = LackOfFit(F=9.31, p=2e-9, dof_between=30, dof_pure=60)
AXES = tuple(NoiseSize(n, v * 1e-6) for n, v in (("x", 12.0), ("y", 31.4), ("rz", 5.0)))
TRIED = (Trial("independent", 1, -90.0), Trial("axis+configuration", 4, -104.25))
NONE = Noise("none", "")


def changed(result: Any, noise: dict[str, Any] | None = None, **fields: Any) -> Any:
    """The result with other fields, judged anew."""
    return judged(replace(result, noise=replace(result.noise, **(noise or {})), **fields))


@pytest.fixture(scope="module")
def noisy(case: Any) -> Any:
    """A result with everything that the report can tell of noise."""
    observed = case.result.observations
    e = np.random.default_rng(0).normal(size=len(observed.value))
    e[np.repeat(observed.configuration, 3) == 3] *= 4
    noise = {
        "kind": "axis+configuration",
        "description": "one variance per axis, and a deviation common to each configuration",
        "reason": "smallest of all",
        "sizes": (*AXES, NoiseSize("common to each configuration", 40e-6)),
        "tried": TRIED,
        "lack_of_fit": MISFIT,
        "interval_kind": "kenward-roger",
        "interval_description": "adjusted",
    }
    name = "joint2.compliance"
    active = (ActiveConstraint(f"{name} >= 0", "lower", (name,), 0.0, 1.0),)
    share = {"joint4.offset": 0.83, "joint5.offset": 0.2, "joint6.offset": float("nan")}
    return changed(
        case.result, noise, method="reml", active=active, prior_share=share,
        residual_summary=summarise_residuals(observed, e),
    )  # fmt: skip


@pytest.mark.parametrize("method", [m for m in METHODS if m != "auto"] + ["constrained"])
def test_every_method_has_words_of_its_own(case: Any, method: str) -> None:
    text = method_and_weights(changed(case.result, method=method))
    assert len(text) > len(method) + 10
    others = {method_and_weights(changed(case.result, method=m)) for m in METHODS if m != method}
    assert text not in others
    assert method_and_weights(changed(case.result, method=method.replace("-", "_"))) == text


def test_stated_weights_are_named_with_the_method(case: Any) -> None:
    noise = {"kind": "axis", "description": "tracker sigma 10 µm"}
    text = method_and_weights(changed(case.result, noise, method="wls"))
    assert text == "weighted least squares, tracker sigma 10 µm"
    ols = method_and_weights(changed(case.result, {"kind": "none"}, method="ols"))
    assert ols == "ordinary least squares, all readings weighted alike"


@pytest.mark.parametrize(
    "kind",
    [
        *(k for k in INTERVALS if k != "auto"),
        "kenward-roger",
        "H2",
        "CR1",
        "clustered",
        "eq8",
        "t under constraints",
        "posterior",
        "constrained profile",
    ],
)
def test_every_kind_of_interval_says_what_it_assumes(case: Any, kind: str) -> None:
    given = {"interval_kind": kind}
    text = intervals_line(changed(case.result, given))
    assert "in other words" not in text
    assert re.search("assume|take|known|independent", text)
    unknown = {"interval_kind": "new", "interval_description": "in other words"}
    assert intervals_line(changed(case.result, unknown)) == "new: in other words"


def test_lack_of_fit_says_what_follows_for_the_intervals(case: Any) -> None:
    def line(p: float, kind: str, intervals: str = "classical") -> str | None:
        misfit = replace(MISFIT, p=p)
        noise = {"lack_of_fit": misfit, "kind": kind, "interval_kind": intervals}
        return repeats_line(changed(case.result, noise))

    assert "no common deviation worth counting" in (line(0.4, "axis") or "")
    # A noise model that has one must not stand beside a sentence that there is none.
    both = line(0.4, "axis+configuration") or ""
    assert "Repeats agree" in both and "has one; the intervals include it" in both
    assert "worth counting" not in both
    assert "too narrow" in (line(1e-9, "axis") or "")
    for text in (line(1e-9, "axis+configuration"), line(1e-9, "axis", "CR2")):
        assert text is not None
        assert "include it" in text
        assert "too narrow" not in text
        assert "F = 9.31 on 30 and 60 degrees of freedom, p < 1e-6" in (text)
        assert "does not come back" in text.replace("\n", " ")
    assert repeats_line(changed(case.result, {"lack_of_fit": None})) is None


def test_sizes_are_all_named_or_told_by_their_extremes() -> None:
    assert size_rows(replace(NONE, sizes=AXES)) == [
        ("x", "12.0 µm"), ("y", "31.4 µm"), ("rz", "5.00 µrad"),
    ]  # fmt: skip
    many = [NoiseSize(f"configuration {k}", (10.0 + k) * 1e-6) for k in range(91)]
    rows = size_rows(replace(NONE, sizes=(*many, NoiseSize("common to each cell", 7e-6))))
    assert rows == [
        ("median of 91", "55.0 µm"),
        ("smallest (configuration 0)", "10.0 µm"),
        ("largest (configuration 90)", "100 µm"),
        ("common to each cell", "7.00 µm"),
    ]
    factor = NoiseSize("factor", None, 1.25)
    assert size_rows(replace(NONE, sizes=(factor,))) == [("factor", "1.25")]
    assert size_rows(NONE) == []


def test_candidates_are_ranked_by_their_criterion() -> None:
    assert candidate_rows(replace(NONE, tried=TRIED)) == [
        ("one size per axis + deviations of a configuration", "4", "0.0"),
        ("equal noise", "1", "14.2"),
    ]
    words = [kind_in_words(kind) for kind in noise_models() if kind != "auto"]
    assert len(set(words)) == len(words)
    assert not set(words) & set(noise_models())


def test_estimated_noise_is_judged_against_the_stated_one(case: Any) -> None:
    def line(ratio: float | None, method: str) -> str:
        given = {"ratio_to_stated": ratio, "sigma": 25e-6}
        return does_noise_explain_it(changed(case.result, given, method=method))

    assert "agrees" in line(1.0, "reml")
    assert "follow the noise that the readings show" in line(3.0, "reml")
    assert "follow" not in line(3.0, "wls")
    assert "too large" in line(0.2, "reml")
    assert "25.0 µm per coordinate" in line(None, "ols")
    assert "estimated from the readings" in line(None, "reml")


def test_shape_of_the_residuals_in_words(case: Any) -> None:
    observed, rng = case.result.observations, np.random.default_rng(1)
    n = len(observed.value)

    def line(e: np.ndarray) -> str:
        found = summarise_residuals(observed, e / e.std())
        assert found is not None
        return shape_line(found)

    normal = line(rng.normal(size=n))
    assert "agree with a normal distribution" in normal
    assert "No group of readings scatters" in normal
    assert "far readings are more frequent" in line(rng.standard_t(2, size=n))
    assert "lean to one side" in line(rng.exponential(size=n) ** 0.7)
    assert "far readings are rarer" in line(rng.uniform(-1, 1, size=n))


def test_constraints_and_prior(noisy: Any, case: Any) -> None:
    line = constraints_line(noisy) or ""
    assert line.startswith("Active: joint2.compliance ≥ 0 µrad/(N·m). ")
    assert line.count("joint2.compliance") == 1
    prior = prior_line(noisy) or ""
    assert "joint4.offset 83 %" in prior
    assert "joint5" not in prior
    assert "largest share 20 %" in (prior_line(changed(noisy, prior_share={"a": 0.2})) or "")
    assert constraints_line(case.result) is None


def test_nothing_stated_is_only_said_where_it_is_so(case: Any, pose: Any, bare: Any) -> None:
    def line(result: Any, **noise: Any) -> str:
        return does_noise_explain_it(changed(result, {"ratio_to_stated": None, **noise}))

    assert line(bare.result).startswith("No noise was stated")
    assert "not compared" in line(bare.result, kind="covariance")
    assert "not compared" in line(case.result)
    assert "not compared" in line(pose.result)
    model, tracker = pose.result.model, pose.result.model.cell.tracker
    for left, which in ({"rotation_sigma": None}, "positions"), ({"noise": None}, "rotations"):
        partly = copy.copy(model)
        cell = replace(model.cell, tracker=replace(tracker, **left))
        object.__setattr__(partly, "cell", cell)
        assert f"stated for {which} only" in line(changed(pose.result, model=partly))
    assert prior_line(case.result) is None


@pytest.mark.parametrize("width", [40, 80, 120])
def test_terminal_has_tables_and_all_lines(noisy: Any, width: int) -> None:
    console = Console(width=width, force_terminal=False)
    with console.capture() as capture:
        print_result(console, noisy, details=True)
    text = capture.get()
    assert max(map(len, text.splitlines())) <= width
    joined = "".join(text.split())
    for piece in ("31.4µm", "5.00µrad", "equalnoise", "14.2"):
        assert piece in joined
    labels = [label for label, _ in summary_lines(noisy)]
    assert labels.index("Noise") < labels.index("Noise model") < labels.index("Repeats")
    assert {"Residuals", "Intervals", "Constraints", "Prior"} <= set(labels)


def test_page_has_a_section_on_noise(noisy: Any) -> None:
    page = page_of(noisy)
    section = page[page.index("<h2>Noise</h2>") : page.index("<h2>Faulty readings")]
    for piece in ("restricted likelihood", "31.4 µm", "common to each configuration", "14.2",
                  "the intervals include it", "Kenward and Roger", "scatters unlike",
                  "configuration 4"):  # fmt: skip
        assert piece in section
    assert section.count("<figure>") == 2
    verdict = page[: page.index("<h2>Parameters")]
    assert "joint2.compliance ≥ 0 µrad/(N·m)" in verdict
    assert "Mostly prior" in verdict
    assert len(set(re.findall(r'\bid="([^"]*)"', page))) == len(re.findall(r'\bid="', page))


def test_names_from_the_result_are_text(noisy: Any, no_figures: None) -> None:
    script = "<script>\x1b[31m"
    sizes = (NoiseSize(script, 1e-6),)
    tried = tuple(Trial(script, 1, float(k)) for k in range(2))
    noise = {"sizes": sizes, "tried": tried, "description": script, "reason": script}
    page = page_of(changed(noisy, noise))
    found = Page(page)
    found.check_harmless(page)
    assert script.replace("\x1b", "\\x1b") in found.text
    assert not any("\x1b" in text for _, text in summary_lines(changed(noisy, noise)))


def test_without_residuals_the_page_has_no_distribution(case: Any) -> None:
    nothing = changed(case.result, residual=np.zeros_like(case.result.residual), residual_rms=0.0)
    page = page_of(changed(nothing, residual_summary=None))
    assert page.count("<figure>") == 8
    assert "Weighted residuals of all coordinates" not in page
    assert noise_model_line(changed(case.result, {"sizes": (), "reason": None})) is None


def test_interval_without_an_end_has_no_bar(case: Any, no_figures: None) -> None:
    e = copy.copy(case.result.estimates[0])
    object.__setattr__(e, "ci95", (-np.inf, np.inf))
    page = page_of(changed(case.result, estimates=(e, *case.result.estimates[1:])))
    assert "nan" not in page[page.index("<h2>Parameters") : page.index("<h2>Combinations")]
