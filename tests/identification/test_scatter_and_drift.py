"""What `identify` says of joints that settle anew at each visit, and of a drift in time."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from support.calibration import PLACED, cell_of, random_chain, table_at, true_values
from support.cells import random_poses

import elastocal as ec
from elastocal.cell_tables import CartesianNoise, Tracker, Unsteadiness
from elastocal.identification.findings import judged, warning_sentences
from elastocal.identification.identify import identify
from elastocal.identification.noise_structure import LASTING as TRIED
from elastocal.identification.start import Options
from elastocal.model.manipulator import Model
from elastocal.report.judgement_view import noise_model_line
from elastocal.simulation import simulate

SIGMA, SCATTER, DRIFT, LASTING = 2e-5, 1e-4, 1e-4, 0.2
MARKERS = {"M1": np.array([0.3, 0, 0.1]), "M2": np.array([-0.2, 0.2, 0.1])}


@cache
def identified(
    scatter=0.0, drift=0.0, timed=True, ordered=False, stated=True, seed=0, repeats=1, options=None,
    decimals=9,
):  # fmt: skip
    """36 poses of an arm whose base and markers are unknown."""
    rng = np.random.default_rng(seed)
    tracker, span = Tracker(noise=CartesianNoise(np.full(3, SIGMA))), 60.0 * 35
    cell = cell_of(
        (*PLACED, "joint_offset"), MARKERS, tracker,
        noise=Unsteadiness(np.array([scatter]), drift, LASTING * span),
    )  # fmt: skip
    model = Model.assembled(random_chain(3), cell)
    q = random_poses(model.chain, 36, seed)
    if ordered:
        q = np.clip(np.cumsum(0.4 * rng.normal(size=q.shape), axis=0), -2.4, 2.4)
    table = table_at(q, markers=tuple(MARKERS))
    truth = true_values(model, rng, anywhere=False)
    table = table.take(np.repeat(np.arange(len(table)).reshape(-1, 2), repeats, axis=0).ravel())
    table = replace(table, repeat=np.tile(np.repeat(np.arange(repeats), 2), len(q)))
    time = np.repeat(60.0 / repeats * np.arange(len(q) * repeats), len(MARKERS))
    read = simulate(model, replace(table, time=time), truth, rng)
    if not stated:
        model = Model.assembled(model.chain, replace(cell, noise=Unsteadiness()))
    q = np.radians(np.round(np.degrees(read.q), decimals))
    return identify(model, replace(read, q=q, time=time if timed else None), options)


def test_joints_that_settle_anew_are_told_with_their_size():
    result = identified(scatter=SCATTER)
    finding = result.finding("joint_scatter")
    assert finding.severity == "note" and abs(finding.numbers["sigma_urad"][0] / 100 - 1) < 0.3
    assert "rounded to 0.1°" in identified(decimals=1).finding("joint_scatter").remedy
    assert any("settle anew" in warning for warning in result.warnings)
    assert "µrad" in noise_model_line(result)
    told = result.to_json()
    assert any("sigma_urad" in size for size in told["noise"]["variances"])
    assert abs(told["cell_noise"]["joints_urad"][0] / 100 - 1) < 0.3
    assert (result.unsteadiness.joints > 0).all() and result.unsteadiness.drift == 0


def test_a_drift_is_told_and_whole_blocks_are_left_out():
    finding = (result := identified(drift=DRIFT)).finding("drift")
    assert finding.severity == "care" and "time" in result.noise.kind
    table = result.observations.table
    fits = (result, identify(result.model, replace(table, time=(table.time + 85_400) % 86_400)))
    assert ["at midnight" in "".join(fit.warnings) for fit in fits] == [False, True]
    assert finding.numbers["by"] == "times" and finding.number("lasting_s") > 60
    noise = result.to_json()["noise"]
    assert noise["held_out_by"] == "blocks in time" and noise["drift"]["seconds"] > 60
    assert any("drift" in warning and "reference pose" in warning for warning in result.warnings)
    assert np.isfinite(result.heldout_rms)
    assert result.unsteadiness.drift > 0 and result.unsteadiness.lasting > 60
    # Of one that may last as long as the campaign nobody knows whether it comes back.
    for ends in (True, False):
        noise = replace(result.noise, drift=replace(result.noise.drift, ends=ends))
        drift = judged(replace(result, noise=noise)).finding("drift")
        assert ("random walk" in drift.remedy) != ends


def test_how_long_a_drift_lasts_is_not_taken_for_known_unless_the_cell_states_it():
    stated = identified(drift=DRIFT)
    drift, (_, only) = stated.noise.drift, *stated.spread.among
    assert drift is not None and drift.ends and drift.seconds == LASTING * 60 * 35
    np.testing.assert_allclose(only, stated.spread.matrix)
    # In an order without times no seconds can be told.
    assert identified(drift=DRIFT, timed=False).noise.drift.share in TRIED
    result = identified(drift=DRIFT, stated=False)
    spread, names = result.spread, result.determined
    weights, matrices = zip(*spread.among, strict=True)
    assert len(weights) > 2 and np.isclose(sum(weights), 1)
    np.testing.assert_allclose(np.tensordot(weights, matrices, 1), spread.matrix)
    base, offset = names.index("base.x"), names.index("joint3.offset")
    assert spread.dof[base] < 20 < spread.dof[offset]
    single = np.eye(len(names))[[base, offset], None]
    dof, share = spread.tails(single)
    assert dof[0] < 20 < dof[1] and share[0] < 0.95 < share[1] <= 1
    at = result.position(np.zeros(6), point="M1")
    normal = replace(at, dof=np.full(1, np.inf))
    assert at.dof[0] < 20 and (at.half_axes() > 1.1 * normal.half_axes()).all()


def test_without_times_the_order_of_the_rows_stands_for_them_unless_it_is_one_of_poses():
    told = identified(drift=DRIFT, timed=False).finding("drift")
    assert told is not None and told.numbers["by"] == "order of the rows"
    assert "record times" in told.remedy
    along = identified(drift=DRIFT, timed=False, ordered=True, stated=False)
    assert along.finding("drift") is None
    # Whoever states one knows that it is there.
    assert identified(drift=DRIFT, timed=False, ordered=True).finding("drift") is not None


def test_an_axis_that_the_parameters_can_meet_has_no_noise_of_its_own():
    """Else x is read without error and decides all: 1.7 times the noise, a reading set apart."""
    cell = Path(__file__).parents[1] / "cases" / "axis_met" / "cell.toml"
    fit = ec.identify(cell, cell.with_name("train.csv"))
    assert fit.noise.kind == "independent" and not fit.excluded
    assert 0.7 < fit.noise.ratio_to_stated < 1.3 and fit.load_point_error > 1e-3
    drifting = fit.model.with_effects((*fit.model.cell.model.effects, "joint_drift:joint2"))
    assert ec.identify(drifting, cell.with_name("train.csv")).load_point_error > 1e-3


def test_the_stated_noise_is_all_that_the_cell_states():
    """Its scatter of joints and drift are in the data: nothing is missing, nothing to be stated."""
    for options in (None, Options(method="wls")):
        fit = identified(scatter=SCATTER, drift=DRIFT, repeats=2, options=options)
        assert fit.finding("residual_agrees_with_stated_noise") is not None
        assert 0.85 < fit.noise.ratio_to_stated < 1.15
        # But that on wls, whose intervals do not count what readings share.
        told = [w for w, kind in warning_sentences(fit).items() if kind != "lack_of_fit"]
        assert not any("State it" in w or "an effect is missing" in w for w in told)
    fit = identified(scatter=SCATTER, drift=DRIFT)
    assert (
        "It agrees with [noise] joints_urad of the cell (100)"
        in fit.finding("joint_scatter").remedy
    )


def test_scatter_that_the_cell_does_not_state_stays_above_the_stated_noise():
    fit = identified(scatter=SCATTER, stated=False)
    assert fit.finding("residual_above_stated_noise") is not None
    assert "State it as [noise] joints_urad" in fit.finding("joint_scatter").remedy
