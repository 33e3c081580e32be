"""Klimchik et al. 2013 on one page: the model, its B_i, OLS, WLS, weights, a measurement plan.

The fifteen poses of Table 2, the scatter of Table 1 and the compliances of Table 3, on the KR 270
that elastocal brings along.  `python examples/klimchik2013.py` takes some seconds.
"""

from dataclasses import replace
from importlib.resources import files

import numpy as np

import elastocal as ec
from elastocal.identification.published import eq14, eq14_weights, group_sigma, ols, wls
from elastocal.simulation import LOAD_N, published_compliances, reading_sigma

# The model: deflections Δp_i = h(q_i, f_i; X) of the markers under 265 kg, X the compliances.
folder = files("elastocal.demo")
model = ec.Model(folder / "cell.toml")
truth, _ = published_compliances(folder)  # Table 3, in rad/(N m)

# The campaign: Table 2's poses, six repeats, three markers, noise as large as Table 1 says.
poses = replace(model.read_plan(folder / "plan.csv"), sigma=reading_sigma(folder))
data = ec.simulate(model, poses, values=truth, load=LOAD_N, repeats=6, seed=2013)

# Eq. (4), Δp = B X with B_i = ∂Δp_i/∂X.  The load moves with the arm, so B is taken anew at each
# estimate.  A vertical load does not turn joint 1: its column of B is zero and is left out.
X = model.nominal
for _ in range(4):
    at = model.regressor(data, X)
    shown = np.abs(at.B).max(axis=0) > 1e-6 * np.abs(at.B).max()
    B, dp = at.B[:, shown], at.residual + at.B[:, shown] @ X[shown]
    plain = ols(B, dp)  # eq. (6), its covariance by eq. (7)
    X[shown] = plain.x

# Eq. (10) with the weights 1/σ_i has the covariance of eq. (13); with any others, of eq. (11).
configuration, direction = np.repeat(at.observations.configuration, 3), np.tile(range(3), 270)
group = 3 * configuration + direction
sigma = np.sqrt(2) * reading_sigma(folder)[configuration, direction]  # of a difference of readings
weighted = wls(B, dp, 1 / sigma)
once = wls(B, dp, eq14_weights(group_sigma(plain.residual, group)), sigma)
settled = eq14(B, dp, group)[-1]  # eq. (14) until values and intervals stay; σ_i from residuals

fits = {"OLS (6), (7)": plain, "WLS (10), (13)": weighted, "(14) once, (11)": once,
        "(14) iterated": settled}  # fmt: skip
print(f"Compliances in µrad/(N·m), ±3σ as stated; B has {B.shape[0]} rows, {B.shape[1]} columns")
print(" " * 24, " truth", *(f"{name:>16}" for name in fits))
for j, name in enumerate(np.array(model.names)[shown]):
    row = (f"{1e6 * fit.x[j]:7.4f} ± {3e6 * fit.std[j]:.4f}" for fit in fits.values())
    print(f"{name:24} {1e6 * truth[name]:6.3f}", *row)

# The plan: three poses at each level of joint 2 that leave the least error in Table 2's poses.
plan = ec.design(
    model, criterion="test_pose", test_poses=poses.q, loads=[LOAD_N], fixed="joint1.compliance",
    levels={"joint2": np.unique(poses.q[:, 1])}, per_level=[3] * 5, candidates=2000, effort="quick",
)  # fmt: skip
print(f"\nFifteen poses leave {plan.reported:.2f} µm, random ones {plan.chance.median:.2f} µm; no "
      f"choice among {plan.certificate.pool} candidates leaves less than "
      f"{plan.bound_reported:.2f} µm")  # fmt: skip
