"""How far apart effects and their rivals stand in 30 poses, whichever these are.

    python namable.py [--arms 100]

For each arm of the second study, the missing effect's signal in the readings is compared with what
the model's own parameters can follow (d, in standard deviations) and with what these and the
nearest rival of the catalogue can follow (r); both beside random poses, those planned by ρ₀ and
`robust`, and a plan made to show all effects: of many poses those whose information

    Σ_k w_k log det(1 + S_k),   S_k the information on effect k that its own parameters leave,

is largest, by multiplicative weights (concave; w shares equally among kinds and their places).  And
the d of the best 30 poses for each arm alone, which no other arm has to share.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from study import LOADS, NAMED_FROM, SIGMA, TrueArm, feasible, model, planned, poses

from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.doubts import in_doubt
from elastocal.planning.information import ALL_LOADS, load_states, rows_of
from elastocal.planning.setup import Known

POOL, STEPS, LOOSE = 1500, 60, 10.0  # poses; of the weights; own parameters, in typical sizes
LARGER = 3.0  # times its typical size that a rival may have
CLASSES = (0, 1, 2, 3, 4, 6, np.inf)

Array = np.ndarray


def blocks(of: Model, q: Array) -> Array:
    """B (poses, rows, parameters) in units of the noise."""
    table = rows_of(q, np.full(len(q), ALL_LOADS), load_states(model().cell), ("M1",))
    table = replace(table, position=np.zeros((len(table), 3)))
    observed, every = observe(table, "position"), np.arange(len(of.parameters))
    B = of.regressor(table, of.nominal, every, observed).B / SIGMA
    return B.reshape(len(q), 3 * len(LOADS), -1)


def own_columns(of: Model, B: Array) -> tuple[Array, Array]:
    """Columns of the model's own parameters, LOOSE typical sizes each, and which these are."""
    names = model().names
    own = np.array([name in names for name in of.names])
    size = [LOOSE * (p.typical or 0.1) for p in of.parameters]
    return (B * size)[..., own], own


def left(signal: Array, columns: Array) -> float:
    """Length of what columns, their coefficients of prior variance one, leave of a signal."""
    A = np.vstack([columns, np.eye(columns.shape[1])])
    y = np.concatenate([signal, np.zeros(columns.shape[1])])
    return float(np.linalg.norm(y - A @ np.linalg.lstsq(A, y, rcond=None)[0]))


def weighed(gain: Callable[[Array], Array]) -> Array:
    """Weights (POOL,) of sum NAMED_FROM, none above one, that multiplication by what each pose
    gains leads to."""
    w = np.full(POOL, NAMED_FROM / POOL)
    for _ in range(STEPS):
        g = gain(w)
        w = w * (g / max(g @ w / NAMED_FROM, 1e-300)) ** 0.6
        for _ in range(8):
            w = np.minimum(w, 1.0)
            free = w < 1.0
            if free.any():
                w[free] *= (NAMED_FROM - (~free).sum()) / max(w[free].sum(), 1e-300)
    return w


def information(w: Array, a: Array, b: Array) -> Array:
    return np.einsum("i,imk,iml->kl", w, a, b, optimize=True)


def for_naming(X: Array, effects: list[tuple[float, Array]]) -> Array:
    """Poses (NAMED_FROM,) of the pool that show all effects, of weights and columns."""

    def gain(w: Array) -> Array:
        inverse = np.linalg.inv(information(w, X, X) + np.eye(X.shape[2]))
        out = np.zeros(POOL)
        for share, C in effects:
            cross = inverse @ information(w, X, C)
            rest = C - X @ cross
            S = information(w, C, C) - information(w, C, X) @ cross
            each = np.linalg.inv(np.eye(len(S)) + S)
            out += share * np.einsum("imk,kl,iml->i", rest, each, rest, optimize=True)
        return out

    return np.argsort(-weighed(gain))[:NAMED_FROM]


def best_alone(X: Array, signal: Array) -> float:
    """The largest distance (relaxed: shares of poses) between a signal (POOL, rows) and nothing."""

    def fitted(w: Array) -> Array:
        M = information(w, X, X) + np.eye(X.shape[2])
        return np.linalg.solve(M, np.einsum("i,imk,im->k", w, X, signal, optimize=True))

    w = weighed(lambda w: ((signal - X @ fitted(w)) ** 2).sum(axis=1))
    beta = fitted(w)
    return float(np.sqrt(w @ ((signal - X @ beta) ** 2).sum(axis=1) + beta @ beta))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=100)
    arms = [TrueArm(k, True) for k in range(parser.parse_args().arms)]
    pool, q = feasible(POOL, 77), feasible(100, 0)
    loads = np.full(len(q), ALL_LOADS)
    whole, known, places = in_doubt(model(), Known(), load_states(model().cell), q, loads)
    assert known.prior is not None
    std = dict(zip(known.prior.names, np.sqrt(np.diag(known.prior.covariance)), strict=True))
    rivals = {
        place: (
            [k for k, p in enumerate(whole.parameters)
             if (p.effect, p.where) == place and p.name in std],
            [std[p.name] / np.sqrt(probability) for p in whole.parameters
             if (p.effect, p.where) == place and p.name in std],
        )
        for place, probability in places.items()
    }  # fmt: skip
    B = blocks(whole, pool)
    X, _ = own_columns(whole, B)
    kinds = Counter(name for name, _ in rivals)
    effects = [
        (1 / (len(kinds) * kinds[place[0]]), B[..., columns] * size)
        for place, (columns, size) in rivals.items()
    ]
    plans = {"ρ₀": planned(NAMED_FROM), "robust": planned(NAMED_FROM, "robust"),
             "made to show all effects": pool[for_naming(X, effects)]}  # fmt: skip
    d: dict[str, list[float]] = {name: [] for name in ("random", *plans, "best for it alone")}
    r: dict[str, list[float]] = {name: [] for name in ("random", *plans)}
    for arm in arms:
        off = arm.x - arm.model.nominal
        for name, at in {"random": poses("random", NAMED_FROM, arm.number), **plans}.items():
            whole_B, own_B = blocks(whole, at), blocks(arm.model, at)
            columns, own = own_columns(arm.model, own_B)
            signal, columns = (own_B[..., ~own] @ off[~own]).ravel(), np.vstack(list(columns))
            d[name].append(left(signal, columns))
            r[name].append(min(
                left(signal, np.hstack([columns, np.vstack(list(whole_B[..., k] * LARGER * s))]))
                for place, (k, s) in rivals.items() if place != (arm.effect, arm.where)
            ))  # fmt: skip
        own_B = blocks(arm.model, pool)
        columns, own = own_columns(arm.model, own_B)
        d["best for it alone"].append(best_alone(columns, own_B[..., ~own] @ off[~own]))
    for what, each in (("d, from what the model follows", d), ("r, from the nearest rival", r)):
        between = pairwise(CLASSES)
        ends = [f"{a} to {b}" if np.isfinite(b) else f"above {a}" for a, b in between]
        print(f"| {what} | median | {' | '.join(ends)} |\n|{'---|' * (len(ends) + 2)}")
        for name, values in each.items():
            counts = np.histogram(values, CLASSES)[0]
            print(f"| {name} | {np.median(values):.1f} | {' | '.join(map(str, counts))} |")
        print()


if __name__ == "__main__":
    main()
