"""The judgement: what spoils a calibration, what calls for care, and what to do then."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from typing import Any

import pytest

from elastocal.identification.findings import judged
from elastocal.identification.noise_summary import LackOfFit
from elastocal.identification.result import Finding, TestErrors
from elastocal.identification.sentences import Told
from elastocal.report import judgement_view
from elastocal.report.formatting import length
from elastocal.report.page import page_of

MISFIT = LackOfFit(9.0, 1e-5, 30, 20)


def judgement(result: Any) -> judgement_view.Judgement:
    """What is said of a result whose fields were changed, judged anew."""
    return judgement_view.judgement(judged(result))


@pytest.fixture(scope="module")
def fine(case: Any) -> Any:
    """A result that nothing speaks against."""
    return replace(
        case.result,
        noise=replace(case.result.noise, lack_of_fit=None, ratio_to_stated=1.0),
        heldout_rms=1.05 * case.result.residual_rms,
        converged=True,
        excluded=(),
        outliers=(),
    )


def test_what_nothing_speaks_against_can_be_trusted(fine: Any) -> None:
    found = judgement(fine)
    assert found.tone == "good"
    at = length(fine.predicted.ci95[1])
    assert found.headline.startswith(
        f"This calibration can be used. Expected error at new poses: ≤ {at} "
    )
    assert any("give them with `test`" in step for step in found.steps)
    assert not any("diagnose" in step for step in found.steps)
    tested = replace(fine, test=TestErrors(fine.heldout_rms, 0.0, 0.0, 9))
    assert not any("give them with `test`" in step for step in judgement(tested).steps)


def test_one_sentence_says_which_error_has_the_noise_of_a_reading(
    case: Any, no_figures: None
) -> None:
    """In terminal, page, notebook, certificate and JSON."""
    fit = case.result
    sentence = judgement_view.judgement(fit).headline
    own, _, read = sentence.partition(" Held-out error: ")
    assert "measurement noise excluded" in own and length(fit.verdict.at) in own
    assert length(fit.heldout_rms) in read
    json = fit.to_json()
    assert json["verdict"]["sentence"] == sentence
    assert json["verdict"]["at_um"] == pytest.approx(fit.predicted.ci95[1] * 1e6)
    shown = [str(fit), fit._repr_html_(), page_of(fit), page_of(fit, certificate=True)]
    for text in shown:
        assert sentence in " ".join(unescape(re.sub("<.*?>", "", text)).split())


def test_each_doubt_is_named_with_its_remedy(fine: Any) -> None:
    doubts = {
        "times the stated noise": (
            replace(fine, noise=replace(fine.noise, ratio_to_stated=2.0)), "diagnose"
        ),
        "scatter more than their repeats": (
            replace(fine, noise=replace(fine.noise, lack_of_fit=MISFIT)), "diagnose"
        ),
        "held-out error is larger": (
            replace(fine, heldout_rms=3 * fine.residual_rms), "augment"
        ),
        "there is no held-out error": (
            replace(fine, heldout_rms=float("inf"),
                    predicted=replace(fine.predicted, unchecked=float("inf"))), "augment"
        ),
        "the test error (": (
            replace(fine, test=TestErrors(2 * fine.heldout_rms, 0.0, 0.0, 9)), ""
        ),
    }  # fmt: skip
    for text, (result, remedy) in doubts.items():
        found = judgement(result)
        assert found.tone == "warn", text
        assert text in found.headline
        assert any(remedy in step for step in found.steps), text


@pytest.mark.parametrize(
    ("ratio", "n", "doubted"),
    [(1.4, 20, True), (1.4, 5, False), (1.3, 20, False), (1.3, 200, True), (1.2, 10000, False)],
)
def test_test_data_count_where_chance_does_not_explain_them(fine, ratio, n, doubted) -> None:
    """Twenty readings may be 1.38 times worse by chance (1 %), five 1.74 times."""
    known = replace(fine, dof=600, test=TestErrors(ratio * fine.heldout_rms, 0.0, 0.0, n))
    found = judgement(known)
    assert ("larger than chance explains" in found.headline) == doubted
    assert any("Compare the test poses" in step for step in found.steps) == doubted


def test_what_is_no_better_than_nominal_must_not_be_used(fine: Any) -> None:
    useless = judgement(replace(fine, heldout_rms=2 * fine.nominal_rms))
    lost = judgement(replace(fine, converged=False, reason="100 steps"))
    assert useless.tone == lost.tone == "poor"
    assert "is not below that of the nominal arm" in useless.headline
    assert "did not converge (100 steps)" in lost.headline


def test_what_is_only_a_note_is_not_called_a_warning(fine: Any) -> None:
    found = (Finding("ill_conditioned", "note"), Finding("not_held_out", "care"))
    told = (Told("a", "ill_conditioned"), Told("b", "not_held_out"), "of the table")
    result = replace(fine, findings=(*fine.findings, *found), warnings=told)
    labels = [("Note", "a"), ("Warning", "b"), ("Warning", "of the table")]
    assert judgement_view.warnings_beside(result) == labels
