"""The judgement: what spoils a calibration, what calls for care, what to do then, and of which
point it speaks; the error budget below it."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from identification.test_far_values import CASES

import elastocal as ec
from elastocal.identification.findings import judged, next_steps
from elastocal.identification.noise_summary import LackOfFit
from elastocal.identification.result import TestErrors
from elastocal.report import judgement_view
from elastocal.report.blocks import ShownVerdict, length
from elastocal.report.renderers import page_of

MISFIT = LackOfFit(9.0, 1e-5, 30, 20)


def judgement(result: Any) -> ShownVerdict:
    """What is said of a result whose fields were changed, judged anew."""
    return judgement_view.judgement(judged(result))


def steps(result: Any) -> list[str]:
    return [f.remedy for f in next_steps(judged(result))]


@pytest.fixture(scope="module")
def fine(case: Any) -> Any:
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
    assert found.sentence.startswith(
        f"This calibration can be used. Expected error at new poses: ≤ {at} "
    )
    assert "give them with `test`" in steps(fine)[0] and "cannot be" in steps(fine)[-1]
    assert not any("diagnose" in step for step in steps(fine))
    tested = replace(fine, test=TestErrors(fine.heldout_rms, 0.0, 0.0, 9))
    assert not any("give them with `test`" in step for step in steps(tested))


def test_one_sentence_says_which_error_has_the_noise_of_a_reading(
    case: Any, no_figures: None
) -> None:
    """In terminal, page, notebook, certificate and JSON."""
    fit = case.result
    sentence = judgement_view.judgement(fit).sentence
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
    noise, lost = fine.noise, replace(fine.predicted, unchecked=float("inf"))
    alone = fine.held_out.copy()
    alone[:3] = float("inf")
    for text, remedy, changed in (
        ("times the stated noise", "diagnose", {"noise": replace(noise, ratio_to_stated=2.0)}),
        ("scatter more than their repeats", "diagnose",
         {"noise": replace(noise, lack_of_fit=MISFIT)}),
        ("held-out error is larger", "augment", {"heldout_rms": 3 * fine.residual_rms}),
        ("some pose alone determines a parameter", "augment",
         {"held_out": alone, "predicted": lost}),
        ("the test error (", "", {"test": TestErrors(2 * fine.heldout_rms, 0.0, 0.0, 9)}),
    ):  # fmt: skip
        found = judgement(replace(fine, **changed))
        assert found.tone == "warn" and text in found.sentence, text
        assert any(remedy in step for step in steps(replace(fine, **changed))), text
    for text, changed in (
        ("is not below that of the nominal arm", {"heldout_rms": 2 * fine.nominal_rms}),
        ("did not converge (100 steps)", {"converged": False, "reason": "100 steps"}),
    ):
        found = judgement(replace(fine, **changed))
        assert found.tone == "poor" and text in found.sentence


@pytest.mark.parametrize(
    ("ratio", "n", "doubted"),
    [(1.4, 20, True), (1.4, 5, False), (1.3, 20, False), (1.3, 200, True)],
)
def test_test_data_count_where_chance_does_not_explain_them(fine, ratio, n, doubted) -> None:
    """Twenty readings may be 1.38 times worse by chance (1 %), five 1.74 times."""
    known = replace(fine, dof=600, test=TestErrors(ratio * fine.heldout_rms, 0.0, 0.0, n))
    assert ("larger than chance explains" in judgement(known).sentence) == doubted
    assert any("Compare the test poses" in step for step in steps(known)) == doubted


def test_headline_default_point_and_map_speak_of_the_same_point(tmp_path: Path) -> None:
    """Of the cell as init writes it: nobody said where the load point lies among the markers."""
    folder = CASES / "init_markers"
    fit = ec.identify(folder / "cell.toml", folder / "train.csv")
    told = fit.to_json()
    assert "is known only to 2" in told["verdict"]["sentence"]
    assert "measure a marker there, or state `point` M1" in told["verdict"]["sentence"]
    assert told["load_point_um"] > 10 * fit.verdict.at * 1e6
    fit.report(tmp_path / "r.html")
    assert "marker M1" in (tmp_path / "r.html").read_text(encoding="utf-8")
    cell = replace(fit.model.cell, tool=replace(fit.model.cell.tool, load_point=0 * fit.x[:3]))
    bare = ec.identify(cell, folder / "train.csv")
    assert bare.load_point_error is None
    assert "load point" not in bare.to_json()["verdict"]["sentence"]
