"""Random blocks of readings whose noise is shared, and their covariance written out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from elastocal.diagnosis.baseline import Blocks, NoiseValues, NoisyData

Array = np.ndarray


def random_blocks(seed: int, sizes: Sequence[int] = (4, 2, 6, 4, 1), size: int = 3) -> Blocks:
    """Blocks of unequal length, two or three observations to a visit, rows in no order."""
    rng = np.random.default_rng(seed)
    configuration = np.repeat(np.arange(len(sizes)), sizes)
    local = np.concatenate([np.arange(s) // rng.integers(2, 4) for s in sizes])
    visit = 10 * configuration + local
    order = rng.permutation(len(configuration))
    return Blocks.of(configuration[order], visit[order], size)


def random_data(
    seed: int, blocks: Blocks | None = None, p: int = 4, joints: int = 3, stated: bool = True
) -> NoisyData:
    """Everything random, of order one in its own units, some readings left out."""
    rng = np.random.default_rng((seed, 7))
    blocks = blocks or random_blocks(seed)
    n, size = blocks.n, blocks.size
    root = rng.normal(size=(n, size, size))
    covariance = 1e-10 * (root @ root.transpose(0, 2, 1) + size * np.eye(size))
    data = NoisyData(
        blocks=blocks,
        r=blocks.pack(2e-5 * rng.normal(size=(n, size, 1)))[:, :, 0],
        X=blocks.pack(1e-5 * rng.normal(size=(n, size, p))),
        precision=rng.uniform(0.2, 3.0, p),
        covariance=blocks.pack_square(covariance),
        G=blocks.pack(rng.normal(size=(n, size, joints))),
        left_out=blocks.absent,
        stated=stated,
    )
    return data.without(rng.random(n) < 0.15)


def used_rows(data: NoisyData) -> Array:
    """Places in the flattened blocks (C·m) of the rows that count."""
    return np.flatnonzero(~data.left_out.ravel())


def dense_noise(data: NoisyData, noise: NoiseValues) -> Array:
    """V of the rows that count, entry by entry from the observations' labels."""
    blocks, size = data.blocks, data.blocks.size
    observation = np.repeat(blocks.member, size, axis=1).ravel()
    m = data.r.shape[1]
    rows = used_rows(data)
    G = data.G.reshape(-1, data.G.shape[2])
    V = np.zeros((len(rows), len(rows)))
    for a, i in enumerate(rows):
        for b, j in enumerate(rows):
            if i // m != j // m:
                continue
            one, other = observation[i], observation[j]
            joint = noise.joint**2 * G[i] * G[j]
            V[a, b] = float(joint @ noise.shared**2)
            if blocks.visit[one] == blocks.visit[other]:
                V[a, b] += float(joint.sum())
            if one == other:
                V[a, b] += noise.factor**2 * data.covariance[i // m, i % m, j % m]
    return V
