"""The outlier report: silent on clean tables, right about who is to blame."""

import numpy as np
import pytest
from scipy import stats

from elastocal.identification.faulty_readings import outlier_report
from elastocal.identification.outliers import FALSE_ALARM, FitToGood, majority

WIDE = 1e3  # deviation that the weak prior gives each parameter


def agreeing(B, y, tests, seed=0):
    """Readings that the fit to the others does not contradict: the majority, and from there until
    the set stands.  `tests` is what their p-values share."""
    good = majority(B, y, seed)[0]
    for _ in range(30):
        fit = FitToGood(B * WIDE, y, good, 1.0)
        better = fit.p_values(fit.T, fit.e, good) >= FALSE_ALARM / tests
        if 2 * better.sum() <= len(better) or np.array_equal(better, good):
            break
        good = better
    return good


def report(arm, noise, seed=0):
    """Lines 2 to 271, in the order of configuration, marker, repeat."""
    B, y = arm.B.reshape(270, 3, -1), arm.observed(noise).reshape(270, 3)
    good = agreeing(B, y, 4 * 270, seed)
    residual = y - B @ np.linalg.lstsq(B[good].reshape(-1, 9), y[good].ravel())[0]
    marker = np.array(["M1", "M2", "M3"])[arm.marker]
    lines = np.arange(270) + 2
    return outlier_report(B * WIDE, residual, residual, good, lines, marker, arm.configuration)


def clean(arm, seed=0):
    return arm.errors(np.random.default_rng(seed))[0]


def alarms(arm, tables):
    return sum(bool(report(arm, clean(arm, 1000 + k), seed=k).findings) for k in range(tables))


def test_clean_tables_hardly_ever_raise_an_alarm(arm):
    """At 1 % per table more than 4 alarms in 30 tables have a probability below 1e-4."""
    assert alarms(arm, 30) <= stats.binom.isf(1e-4, 30, FALSE_ALARM)


def test_a_displaced_marker_is_one_finding_though_none_of_its_readings_is_beyond_the_noise(arm):
    """Its 90 readings are not listed one by one, nor the configurations that it was seen in."""
    noise = clean(arm)
    noise[arm.marker == 1] += [0.0, 0.8, 0.0]
    (finding,) = report(arm, noise).findings
    assert (finding.level, finding.name, finding.pattern) == ("marker", "M2", "common")
    assert len(finding.readings) == 90
    assert finding.error == pytest.approx(0.8, abs=0.7) and finding.beyond < 9


def test_several_faults_are_told_apart(arm):
    noise = clean(arm)
    noise[arm.marker == 1] += [0.0, 2.0, 0.0]
    noise[arm.configuration == 3] += [0.0, 0.0, 15.0]
    noise[250] += 30.0
    found = {(f.level, f.name) for f in report(arm, noise).findings}
    assert found == {("marker", "M2"), ("configuration", "3"), ("reading", "252")}


def test_scattered_blunders_make_no_bad_marker_configuration_or_block(arm):
    """30 % at random: all of them found, one by one, and at most one good reading accused."""
    noise, bad = arm.errors(np.random.default_rng(0), 0.3, 100, 1000)
    result = report(arm, noise)
    assert {f.level for f in result.findings} == {"reading"}
    accused = {f.readings[0] for f in result.findings}
    assert set(bad) <= accused and len(accused) <= len(bad) + 1
    assert not result.good[bad].any()
