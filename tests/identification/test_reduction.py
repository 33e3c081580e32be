"""Which parameters the data determine, on arms whose redundancies are known by name."""

from functools import lru_cache

import numpy as np
import pytest
from scipy import linalg, stats
from scipy.spatial.transform import Rotation
from support.calibration import (
    GEOMETRY,
    binomial_band,
    cell_of,
    combination_truth,
    covered,
    measured,
    placement,
    planar_chain,
    random_chain,
    table_at,
    true_values,
    z_scores,
)
from support.cells import choices, kr270_chain, random_poses

from elastocal.cell.arm_description import Nominal
from elastocal.identification.identify import identify
from elastocal.identification.solve import reduce
from elastocal.model.chain import Chain, Joint
from elastocal.model.manipulator import Model

DOWN = ((0.0, 0.0, -300.0),)
SIDEWAYS = ((300.0, 0.0, 0.0),)


def z_chain():
    """Every joint turns about its own z: 1 vertical, 2 horizontal, 3 and 4 parallel to each
    other and to nothing else, the flange turned away."""
    flat = Rotation.from_euler("x", 90, degrees=True)
    turned = Rotation.from_euler("y", 70, degrees=True)
    placements = [
        placement([0, 0, 0.3]),
        placement([0.1, 0, 0.2], flat),
        placement([0.3, 0.1, 0.2], turned),
        placement([0.4, 0.05, 0.1]),
    ]
    joints = tuple(
        Joint(f"q{i + 1}", "revolute", T, np.array([0.0, 0, 1]), -2.5, 2.5)
        for i, T in enumerate(placements)
    )
    return Chain("z", joints, placement([0.3, 0.1, 0.2], Rotation.from_euler("xy", [1, 1])))


def reduced(chain, effects, forces=((0, 0, 0),), seed=0, **cell):
    """Structural reduction of the model at nominal values, with names: kept → {dropped: share}."""
    model = Model.assembled(chain, cell_of(effects, **cell))
    B = model.regressor(table_at(random_poses(chain, 30, seed), forces)).B
    found = reduce(B, model.sizes(B), model.parameters, 1.0, 0.0)
    share = {
        model.names[d]: {
            model.names[k]: round(float(found.mixing[i, j]), 9)
            for i, k in enumerate(found.kept)
            if abs(found.mixing[i, j]) > 1e-9
        }
        for j, d in enumerate(found.dropped)
    }
    return [model.names[k] for k in found.kept], share, [model.names[d] for d in found.invisible]


# --- cases whose algebra is known -----------------------------------------------------------


def test_parallel_axes_leave_only_the_sum_of_shifts_along_them():
    """Joints 3 and 4 turn about parallel z axes: a shift of joint 3's frame (link2.dz) and of
    joint 4's (link3.dz) along them do the same."""
    effects = ("link_geometry:link2", "link_geometry:link3")
    _, share, invisible = reduced(z_chain(), effects)
    assert not invisible
    pair = {"link2.dz", "link3.dz"}
    (dropped,) = pair & set(share)
    assert share[dropped] == {(pair - {dropped}).pop(): 1.0}
    # a tilt of the first about its axis moves the second as a turn and a shift of it, too
    assert set(share) <= {"link2.dz", "link3.dz", "link2.rz", "link3.rz"}


def test_a_vertical_joint_1_leaves_base_z_and_link1_dz_as_a_sum():
    kept, share, _ = reduced(planar_chain(), GEOMETRY)
    assert share["link1.dz"] == {"base.z": 1.0}
    assert share["joint1.offset"] == {"base.rz": 1.0}
    assert share["link3.dx"] == {"marker:M1.x": 1.0}
    assert {f"base.{k}" for k in ("x", "y", "z", "rx", "ry", "rz")} <= set(kept)
    assert {f"marker:M1.{k}" for k in "xyz"} <= set(kept)


@pytest.mark.parametrize("nominal", [None, Nominal(joint_compliance=(1e-5, 2e-5, 3e-5))])
def test_a_vertical_load_does_not_show_a_vertical_joint(nominal):
    model = {} if nominal is None else {"nominal": nominal}
    kept, share, invisible = reduced(planar_chain(), ("joint_compliance",), DOWN, **model)
    assert kept == ["joint2.compliance", "joint3.compliance"]
    assert share == {"joint1.compliance": {}} and invisible == ["joint1.compliance"]
    kept, share, invisible = reduced(planar_chain(), ("joint_compliance",), SIDEWAYS, **model)
    assert len(kept) == 3 and not share and not invisible


# --- properties -----------------------------------------------------------------------------

CHOICES = [
    ("base_frame", "marker_position"),
    ("joint_offset", "link_geometry"),
    GEOMETRY,
    ("base_frame", "link_geometry"),
    (*GEOMETRY, "encoder_scale"),
    (*GEOMETRY, "joint_compliance", "off_axis_compliance", "base_compliance"),
]


@lru_cache
def regression(chain_name, effects, seed=0):
    chain = {"planar": planar_chain, "kr270": kr270_chain, "random": lambda: random_chain(2, 5)}[
        chain_name
    ]()
    nominal = Nominal(joint_compliance=(1e-6,) * chain.n_joints)
    model = Model.assembled(chain, cell_of(effects, nominal=nominal))
    table = table_at(random_poses(chain, 25, seed), ((0, 0, 0), (100, 50, -200)))
    B = model.regressor(table).B
    return model, B, model.sizes(B)


@pytest.mark.parametrize("effects", CHOICES[1:4], ids="+".join)
@pytest.mark.parametrize("chain", ["kr270", "random"])
def test_units_do_not_matter(chain, effects):
    """Millimetres or microradians: B and sizes change together, nothing else does."""
    model, B, sizes = regression(chain, effects)
    # Powers of two, so that exact ties between like columns are not broken by rounding.
    unit = 2.0 ** np.random.default_rng(1).integers(-20, 21, len(sizes))
    a = reduce(B, sizes, model.parameters, 1.0, 0.0)
    b = reduce(B / unit, sizes * unit, model.parameters, 1.0, 0.0)
    assert np.array_equal(a.kept, b.kept)
    assert np.array_equal(a.invisible, b.invisible)
    expected = a.mixing * unit[a.kept][:, None] / unit[a.dropped][None, :]
    np.testing.assert_allclose(b.mixing, expected, rtol=1e-12)


# --- what a user gets -----------------------------------------------------------------------

IDENTIFIED = [
    ("base_frame", "marker_position"),
    GEOMETRY,
    ("base_frame", "link_geometry"),
    ("base_frame", "joint_offset", "marker_position", "encoder_scale"),
]


def simulated(chain, effects, seed, poses=25, sigma=5e-5):
    rng = np.random.default_rng(seed)
    model = Model.assembled(chain, cell_of(effects))
    truth = true_values(model, rng)
    table = measured(model, table_at(random_poses(chain, poses, seed)), truth, sigma, rng)
    return identify(model, table), truth


@pytest.mark.parametrize("effects", IDENTIFIED, ids="+".join)
@pytest.mark.parametrize("seed", range(1))
@pytest.mark.parametrize("chain", ["planar", "random"])
def test_no_interval_for_what_the_data_cannot_determine(chain, seed, effects):
    """Two arms with the same readings may not differ in any parameter that is given a value.

    Such arms are truth + v with B v = 0; with every |v_d| up to its typical size, a parameter
    with an interval may move by less than its standard deviation.
    """
    arm = planar_chain() if chain == "planar" else random_chain(seed, 4)
    result, _ = simulated(arm, effects, seed)
    model = result.model
    B = model.regressor(result.observations.table, result.x).B
    sizes = model.sizes(B)
    _, singular, Vt = linalg.svd(B * sizes)
    rank = int((singular > 1e-9 * singular[0]).sum())
    null = Vt[rank:]
    rng = np.random.default_rng(seed)
    for _ in range(20 if len(null) else 0):
        v = null.T @ rng.normal(size=len(null))
        v /= np.abs(v).max()
        for e, moved in zip(result.estimates, v * sizes, strict=True):
            if e.identifiable:
                assert abs(moved) < e.std, e.name
    for e in result.estimates:
        numbers = (e.value, e.std, e.ci95)
        assert all(n is None for n in numbers) or not any(n is None for n in numbers)
        assert e.identifiable == (not e.combined_with and not e.note)
        if e.identifiable:
            assert e.value == e.held and e.ci95[0] < e.value < e.ci95[1]
            assert e.name in result.determined


SEEDS = 10


def test_combinations_cover_the_true_combination():
    """Over 10 arms: each parameter's 95 % interval, and the joint 95 % ellipsoid of all.

    Counts per seed are independent, so the ellipsoid's count is Binomial(10, 0.95); per name the
    limit is Bonferroni's over the names.  Dropped parameters may bias by 0.1 std each at most.
    """
    inside, hits = 0, {}
    for seed in range(SEEDS):
        result, truth = simulated(planar_chain(), GEOMETRY, seed, poses=12)
        assert not result.outliers
        hit = covered(result, truth)
        for name, good in zip(result.determined, hit, strict=True):
            hits.setdefault(name, []).append(good)
        z = z_scores(result, truth)
        std = np.sqrt(np.diag(result.covariance))
        rho = result.covariance / np.outer(std, std)
        squared = z @ np.linalg.solve(rho, z) / len(z)
        inside += squared < stats.f.ppf(0.95, len(z), result.dof)
    low, high = binomial_band(SEEDS, 0.95)
    assert low <= inside <= high
    for name, good in hits.items():
        low, _ = binomial_band(len(good), 0.95, 1 - 0.001 / len(hits))
        assert sum(good) >= low, name


def test_what_another_effect_explains_completely_is_reported_with_it():
    """An effect switched on twice in disguise: joint 1's offset and the base's turn about it."""
    model = Model.assembled(planar_chain(), cell_of(("base_frame", "joint_offset:joint1")))
    assert model.cell.model.effects == choices(("base_frame", "joint_offset:joint1"))
    rng = np.random.default_rng(0)
    truth = true_values(model, rng, anywhere=False)
    table = measured(model, table_at(random_poses(model.chain, 15, 0)), truth, 1e-5, rng)
    result = identify(model, table)
    offset = result["joint1.offset"]
    assert not offset.identifiable and offset.combined_with == ("base.rz",)
    assert result.combination("base.rz").terms == pytest.approx(
        {"base.rz": 1.0, "joint1.offset": 1.0}, abs=1e-2
    )


def test_combinations_hold_where_the_readings_are_too_good_for_a_linear_sum():
    """At 1 µm what a millimetre and a milliradian do together is above the noise."""
    model, held, plain = Model.assembled(random_chain(3), cell_of(GEOMETRY)), [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = true_values(model, rng, anywhere=False)
        plan = table_at(random_poses(model.chain, 40, seed))
        found = identify(model, measured(model, plan, truth, 1e-6, rng))
        for name in found.determined:
            single = found[name].identifiable
            value = found[name] if single else found.combination(name)
            low, high = value.ci95
            held.append(low <= combination_truth(found, truth, name) <= high)
        plain.append(covered(found, truth).mean())
    assert np.mean(plain) < 0.85 < 0.9 < np.mean(held)
