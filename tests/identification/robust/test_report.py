"""The outlier report: silent on clean tables, right about who is to blame."""

import numpy as np
import pytest
from scipy import stats

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
