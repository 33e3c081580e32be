"""What the truth says of a diagnosis once it is given: d of each effect, and the true shrinkage.

Uses elastocal's model and columns, at the fit to the campaign's own noisy readings.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from draw import World

from elastocal.cell import read_cell
from elastocal.diagnosis.baseline import Baseline, NoiseValues, fit_baseline, project
from elastocal.diagnosis.diagnosis_data import diagnosis_data_of
from elastocal.diagnosis.evidence import Grams
from elastocal.diagnosis.hypotheses import possible
from elastocal.model.manipulator import Model


def plain_fit(visible: Path) -> Baseline:
    """The cell's own effects fitted to the campaign."""
    model = Model(visible / "cell.toml")
    return fit_baseline(model, model.read(visible / "data.csv"))


def distances(base: Baseline, world: World, without: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    """Of each true effect: d from nothing and from its nearest rival, in standard deviations.

    d² = min over β, γ of |v − Xβ − Cγ|²_V⁻¹ + |γ|²/s², where v is what the effect does to the
    noise-free readings beside the other effects, V the true noise with repeatability, X the
    fitted columns and those of the other effects, C the columns of the rival, at the best of its
    settings, and s the width of its size prior.  `distance` is the smaller of the two.  Effects
    that the tool went `without` are no rivals.
    """
    hypotheses, _ = possible(base.model, base.observed.table)
    scene = diagnosis_data_of(base, hypotheses)
    known = {(h.name, h.where): h for h in hypotheses}
    joint = world.noise.repeatability
    noise = NoiseValues(1 / world.noise.stated, joint, np.full_like(joint, 1e-6))
    whole = world.noise_free(world.visits)
    out = []
    for effect in world.effects:
        others = tuple(e for e in world.effects if e is not effect)
        v = whole - replace(world, effects=others).noise_free(world.visits)
        data = replace(scene.data, r=scene.blocks.pack(v.reshape(-1, 3, 1))[:, :, 0])
        for e in others:  # there too: its columns beside the data
            h = known[e.name, e.where]
            C = scene.packed(h, np.array([e.settings[s.key] for s in h.settings]))
            data = data.with_columns(C, np.full(C.shape[2], h.scales.max() ** -2.0))
        at = project(data, noise)
        grams = Grams(scene, data, at)
        alone = float((data.r * at.u).sum())
        taken = {(e.name, e.where) for e in world.effects}
        rivals = {k: h for k, h in known.items() if k not in taken and h.name not in without}
        left = {
            key: alone - float(grams.of(h).explained(float(h.scales.max())).max())
            for key, h in rivals.items()
        }
        rival = min(left, key=left.__getitem__)
        nothing, nearest = (float(np.sqrt(max(d, 0.0))) for d in (alone, left[rival]))
        out.append({
            "effect": effect.name, "where": effect.where, "nothing": nothing,
            "rival": ":".join(rival), "distance": min(nothing, nearest),
        })  # fmt: skip
    return out


def true_reduction(base: Baseline, answer: dict[str, Any], extended: Path, fresh: Path) -> float:
    """1 − e₁/e₀: how far the rms error of fresh noise-free readings falls with what was found.

    e₀ of the cell's own model, e₁ of the `extended` cell's from the values that the diagnosis
    published, both fitted to the campaign under the stated noise.
    """
    model = Model.assembled(base.model.chain, read_cell(extended))
    start = dict(zip(base.model.names, base.x, strict=True))
    known = (p for e in answer["effects"] for p in e["parameters"] if p["value"] is not None)
    start |= {p["name"]: p["value"] for p in known}  # others stand in the cell
    x0 = np.array([start.get(p.name, p.nominal) for p in model.parameters])
    after = fit_baseline(model, base.observed.table, x0=x0)
    table = base.model.read(fresh)
    assert table.position is not None
    off = (fit.model.predict(table, fit.x) - table.position.ravel() for fit in (base, after))
    e0, e1 = (float(np.sqrt(np.mean(each**2))) for each in off)
    return 1 - e1 / e0
