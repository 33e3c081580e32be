"""The same model with dense matrices over all rows, written from the formulas and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.identification.noise_structure import Readings

BY = {
    "configuration": ("configuration",),
    "configuration and load": ("configuration", "load"),
    "configuration and marker": ("configuration", "marker"),
    "configuration, load and marker": ("configuration", "load", "marker"),
}


@dataclass(frozen=True)
class Table:
    """What a made-up table looks like."""

    size: int = 3
    configurations: int = 6
    loads: int = 1
    markers: int = 2
    repeats: int = 3
    p: int = 4
    unbalanced: bool = True


def readings(table: Table, seed: int, noise: float = 1e-5, shared: float = 0.0) -> Readings:
    """Readings in random order, a third of the repeats missing if unbalanced; noise in m."""
    rng = np.random.default_rng(seed)
    every = table.configurations, table.loads, table.markers, table.repeats
    labels = np.array(list(np.ndindex(every)))[:, :3]
    keep = rng.permutation(len(labels))
    if table.unbalanced:
        keep = keep[: 2 * len(keep) // 3]
    labels = labels[keep]
    n, size, p = len(labels), table.size, table.p
    cells = rng.normal(size=(table.configurations, table.loads, table.markers, size, p))
    B = cells[tuple(labels.T)]
    common = rng.normal(size=(table.configurations, size))[labels[:, 0]]
    e = noise * rng.normal(size=(n, size)) + shared * common
    sight = reach = None
    if size == 3:  # the same for all repeats of a cell
        frames = np.linalg.qr(rng.normal(size=(*cells.shape[:3], 3, 3)))[0]
        sight = frames[tuple(labels.T)]
        reach = rng.uniform(1, 6, size=cells.shape[:3])[tuple(labels.T)]
    root = rng.normal(size=(n, size, size)) + 2 * np.eye(size)
    stated = noise**2 * root @ root.transpose(0, 2, 1)
    return Readings(B, e, *labels.T, sight, reach, stated)


def own_parts(name: str, r: Readings, names: tuple[str, ...]) -> list[np.ndarray]:
    """V_k (rows, rows) of a structure's own variances, from its definition."""
    n, size = r.e.shape
    reading = np.repeat(np.arange(n), size)
    component = np.tile(np.arange(size), n)
    if name == "independent":
        kind = component >= 3 if size == 6 else np.zeros(n * size, dtype=int)
        return [np.diag((kind == k).astype(float)) for k in range(2 if size == 6 else 1)]
    if name == "axis":
        return [np.diag((component == a).astype(float)) for a in range(size)]
    if name == "marker":
        labels = np.unique(r.marker)
        assert names == tuple(f"marker {m}" for m in labels)
        return [np.diag((r.marker[reading] == m).astype(float)) for m in labels]
    if name == "groups":
        parts = []
        for text in names:
            c, load, a = (int(word.split()[1]) for word in text.split(", "))
            here = (r.configuration == c) & (r.load == load)
            parts.append(np.diag((here[reading] & (component == a)).astype(float)))
        return parts
    if name == "polar":
        u = r.sight[:, 0]
        along = np.einsum("ni,nj->nij", u, u)
        blocks = [along, np.eye(3) - along]
        if "angular" in names:
            blocks.append((np.eye(3) - along) * (r.reach**2)[:, None, None])
    else:
        blocks = [r.stated]
    return [_block_diagonal(block) for block in blocks]


def _block_diagonal(blocks: np.ndarray) -> np.ndarray:
    n, size, _ = blocks.shape
    whole = np.zeros((n, size, n, size))
    whole[np.arange(n), :, np.arange(n), :] = blocks
    return whole.reshape(n * size, n * size)


def shared_part(name: str, r: Readings) -> np.ndarray:
    by = BY[name.removeprefix("common to each ").removesuffix(" (rotation)")]
    same = np.all([(lab := getattr(r, b))[:, None] == lab[None, :] for b in by], axis=0)
    size = r.size
    axes = np.arange(size) >= 3 if name.endswith("(rotation)") else np.arange(size) < 3
    return np.kron(same.astype(float), np.diag(axes.astype(float)))


@dataclass(frozen=True)
class Dense:
    """Restricted likelihood at θ with V = Σ θ_k V_k."""

    B: np.ndarray
    e: np.ndarray
    parts: list[np.ndarray]
    theta: np.ndarray

    @property
    def V(self) -> np.ndarray:
        return sum(t * part for t, part in zip(self.theta, self.parts, strict=True))

    @property
    def Phi(self) -> np.ndarray:
        return np.linalg.inv(self.B.T @ np.linalg.solve(self.V, self.B))

    @property
    def P(self) -> np.ndarray:
        W = np.linalg.inv(self.V)
        return W - W @ self.B @ self.Phi @ self.B.T @ W

    @property
    def x(self) -> np.ndarray:
        return self.Phi @ self.B.T @ np.linalg.solve(self.V, self.e)

    @property
    def log_likelihood(self) -> float:
        m, p = self.B.shape
        logs = np.linalg.slogdet(self.V)[1] - np.linalg.slogdet(self.Phi)[1]
        return -0.5 * (logs + self.e @ self.P @ self.e + (m - p) * np.log(2 * np.pi))

    @property
    def score(self) -> np.ndarray:
        Pe = self.P @ self.e
        return np.array([0.5 * (Pe @ V @ Pe - np.trace(self.P @ V)) for V in self.parts])

    @property
    def information(self) -> np.ndarray:
        PV = [self.P @ V for V in self.parts]
        return np.array([[0.5 * np.trace(a @ b) for b in PV] for a in PV])

    @property
    def observed(self) -> np.ndarray:
        """−∂²ℓ/∂θ_k∂θ_l."""
        P, Pe = self.P, self.P @ self.e
        outer = [[Pe @ a @ P @ b @ Pe for b in self.parts] for a in self.parts]
        return np.array(outer) - self.information

    def kenward_roger(self, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Φ_A and dof (p,) as Kenward and Roger 1997 print them; W is the covariance of θ̂."""
        inverse, Phi = np.linalg.inv(self.V), self.Phi
        first = [-self.B.T @ inverse @ V @ inverse @ self.B for V in self.parts]
        total = np.zeros_like(Phi)
        for i, Vi in enumerate(self.parts):
            for j, Vj in enumerate(self.parts):
                Q = self.B.T @ inverse @ Vi @ inverse @ Vj @ inverse @ self.B
                total += W[i, j] * (Q - first[i] @ Phi @ first[j])
        dof = []
        for lam in np.eye(len(Phi)):
            # One contrast: A1 = A2 = gᵀWg / (λᵀΦλ)², F's moments match with m = 2/A2.
            g = np.array([lam @ Phi @ Pi @ Phi @ lam for Pi in first])
            A2 = g @ W @ g / (lam @ Phi @ lam) ** 2
            dof.append(2 / A2)
        return Phi + 2 * Phi @ total @ Phi, np.array(dof)


def dense(name: str, r: Readings, names: tuple[str, ...], shared: list[str], theta) -> Dense:
    parts = own_parts(name, r, names) + [shared_part(s, r) for s in shared]
    return Dense(r.B.reshape(-1, r.n_parameters), r.e.ravel(), parts, np.asarray(theta))
