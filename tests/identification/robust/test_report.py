"""The outlier report: silent on clean tables, right about who is to blame."""

import json

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from elastocal.identification.faulty_readings import CleanFit, outlier_report
from elastocal.identification.outliers import FALSE_ALARM
from elastocal.identification.robust import tukey


def agreeing(B, y, tests, seed=0):
    """Readings of three rows that the fit to the others does not contradict: those near the
    MM-estimate, and from there until the set stands.  `tests` is what their p-values share."""
    found = tukey(B, y, size=3, seed=seed)
    length = np.linalg.norm(found.residual.reshape(-1, 3), axis=1)
    good = length <= found.scale * stats.chi.isf(0.01, 3)
    for _ in range(30):
        better = CleanFit(found.design, good).reading_p() >= FALSE_ALARM / tests
        if 2 * better.sum() <= len(better) or np.array_equal(better, good):
            break
        good = better
    return good


def report(arm, noise, seed=0, B=None, unit=1.0, fitted=()):
    """Lines 2 to 271, in the order of configuration, marker, repeat."""
    B, y = (arm.B if B is None else B), unit * arm.observed(noise)
    return outlier_report(
        B, y, agreeing(B, y, 4 * 270, seed), size=3, configuration=arm.configuration,
        marker=np.array(["M1", "M2", "M3"])[arm.marker], line=np.arange(270) + 2,
        fitted_markers=fitted,
    )  # fmt: skip


def clean(arm, seed=0):
    return arm.errors(np.random.default_rng(seed))[0]


def alarms(arm, tables):
    return sum(bool(report(arm, clean(arm, 1000 + k), seed=k).findings) for k in range(tables))


def test_clean_tables_hardly_ever_raise_an_alarm(arm):
    """At 1 % per table more than 4 alarms in 30 tables have a probability below 1e-4."""
    assert alarms(arm, 30) <= stats.binom.isf(1e-4, 30, FALSE_ALARM)


def test_a_single_reading(arm):
    """12 σ in each of two components: named with its line, its size and no accomplices."""
    noise = clean(arm)
    noise[100] += [12.0, -12.0, 0.0]
    (finding,) = report(arm, noise).findings
    assert (finding.level, finding.lines, finding.readings) == ("reading", (102,), (100,))
    assert finding.error == pytest.approx(12 * np.sqrt(2), abs=4)
    assert finding.sigmas == pytest.approx(finding.error, rel=0.15)
    assert finding.p_value < 1e-10


@pytest.mark.parametrize("shift", [0.8, 8.0])
def test_a_displaced_marker_is_one_finding(arm, shift):
    """Also where no reading of it is beyond the noise; its 90 readings are not listed one by one,
    nor are the configurations that it was seen in."""
    noise = clean(arm)
    noise[arm.marker == 1] += [0.0, shift, 0.0]
    (finding,) = report(arm, noise).findings
    assert (finding.level, finding.name, finding.pattern) == ("marker", "M2", "common")
    assert len(finding.readings) == 90
    assert finding.error == pytest.approx(shift, abs=0.7)
    assert (finding.beyond > 80) == (shift == 8.0)


def test_a_marker_whose_position_is_fitted_has_no_shift_of_its_own(arm):
    """What its readings have in common is an error of the arm; its scatter is still its own."""
    noise = clean(arm)
    noise[arm.marker == 1] += [0.0, 0.8, 0.0]
    assert all(f.level != "marker" for f in report(arm, noise, fitted=("M2",)).findings)
    (other,) = report(arm, noise, fitted=("M1",)).findings
    assert (other.name, other.pattern) == ("M2", "common")
    turned = Rotation.random(15, random_state=1).as_matrix() @ [0.0, 8.0, 0.0]
    noise[arm.marker == 1] += turned[arm.configuration[arm.marker == 1]]
    (finding,) = report(arm, noise, fitted=("M2",)).findings
    assert (finding.name, finding.pattern) == ("M2", "scatter")


def test_a_marker_displaced_on_a_turning_flange(arm):
    """The same 8 σ along another direction in every configuration: no common shift, but M2."""
    noise = clean(arm)
    turned = Rotation.random(15, random_state=1).as_matrix() @ [0.0, 8.0, 0.0]
    noise[arm.marker == 1] += turned[arm.configuration[arm.marker == 1]]
    (finding,) = report(arm, noise).findings
    assert (finding.level, finding.name, finding.pattern) == ("marker", "M2", "scatter")
    assert finding.error == pytest.approx(np.hypot(8.0, np.sqrt(3)), rel=0.15)


@pytest.mark.parametrize("shift", [2.5, 10.0])
def test_a_displaced_configuration_is_one_finding(arm, shift):
    noise = clean(arm)
    noise[arm.configuration == 7] += [shift, 0.0, 0.0]
    (finding,) = report(arm, noise).findings
    assert (finding.level, finding.name) == ("configuration", "7")
    assert finding.lines == tuple(range(7 * 18 + 2, 8 * 18 + 2))
    assert finding.error == pytest.approx(shift, abs=1.5)


def test_a_block_of_lines_is_one_finding(arm):
    """60 consecutive readings across five configurations, shifted by 20 σ."""
    noise = clean(arm)
    noise[40:100] += [20.0, 0.0, 5.0]
    (finding,) = report(arm, noise).findings
    assert finding.level == "block"
    assert (finding.lines[0], finding.lines[-1]) == (42, 101)
    assert finding.error == pytest.approx(np.hypot(20, 5), abs=2)


def test_several_faults_are_told_apart(arm):
    noise = clean(arm)
    noise[arm.marker == 1] += [0.0, 2.0, 0.0]
    noise[arm.configuration == 3] += [0.0, 0.0, 15.0]
    noise[250] += 30.0
    found = {(f.level, f.name) for f in report(arm, noise).findings}
    assert found == {("marker", "M2"), ("configuration", "3"), ("reading", "252")}


@pytest.mark.parametrize("seed", range(1))
def test_scattered_blunders_make_no_bad_marker_configuration_or_block(arm, seed):
    """30 % at random: all of them found, one by one, and at most one good reading accused."""
    noise, bad = arm.errors(np.random.default_rng(seed), 0.3, 100, 1000)
    result = report(arm, noise)
    assert {f.level for f in result.findings} == {"reading"}
    accused = {f.readings[0] for f in result.findings}
    assert set(bad) <= accused and len(accused) <= len(bad) + 1
    assert not result.good[bad].any()


def test_influence_is_the_change_by_fitting_the_readings_along(arm):
    noise = clean(arm)
    noise[arm.configuration == 7] += [4.0, 0.0, 0.0]
    result = report(arm, noise)
    (finding,) = result.findings
    y, kept = arm.observed(noise), np.repeat(result.good, 3)
    without = np.linalg.lstsq(arm.B[kept], y[kept])[0]
    np.testing.assert_allclose(result.x, without, rtol=1e-9, atol=1e-12)
    std = result.sigma * np.sqrt(np.diag(np.linalg.inv(arm.B[kept].T @ arm.B[kept])))
    moved = np.abs(np.linalg.lstsq(arm.B, y)[0] - without) / std
    assert finding.influence == pytest.approx(moved.max(), rel=1e-6)
    assert finding.column == moved.argmax()


def test_a_shift_that_the_model_absorbs_is_not_blamed_on_the_marker(arm):
    """With the position of M2 among the columns its displacement is a parameter, not an error."""
    own = np.kron((arm.marker == 1)[:, None], np.eye(3))
    noise = clean(arm)
    noise[arm.marker == 1] += 50.0
    y = arm.observed(noise)
    B = np.hstack([arm.B, own])
    good = agreeing(B, y, 3 * 270)
    result = outlier_report(B, y, good, size=3, marker=arm.marker, configuration=arm.configuration)
    assert result.findings == ()
    np.testing.assert_allclose(result.x[-3:], 50.0, atol=1.0)


def test_scaling_rows_and_columns_changes_no_verdict(arm):
    noise, _ = arm.errors(np.random.default_rng(5), 0.05, 10, 100)
    plain = report(arm, noise)
    scaled = report(arm, noise, B=arm.B * 10.0 ** np.arange(-8, 1), unit=1e-5)
    assert np.array_equal(plain.good, scaled.good)
    for a, b in zip(plain.findings, scaled.findings, strict=True):
        assert (a.level, a.name) == (b.level, b.name)
        assert b.error == pytest.approx(1e-5 * a.error, rel=1e-6)
        assert b.influence == pytest.approx(a.influence, rel=1e-6)


def test_json_holds_plain_numbers(arm):
    noise = clean(arm)
    noise[100] += 30.0
    result = report(arm, noise)
    parsed = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert parsed["findings"][0]["lines"] == [102]
    assert parsed["readings_used"] == 269
    assert set(parsed["tests"]) == {"reading", "marker", "configuration", "block"}
