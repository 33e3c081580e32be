"""What may be true at fresh poses, given what was found: each as probable as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from elastocal.diagnosis.alike import signal_of
from elastocal.diagnosis.baseline import Baseline
from elastocal.diagnosis.confirm import Truth
from elastocal.diagnosis.estimate import fit_extended
from elastocal.diagnosis.extend import extended
from elastocal.diagnosis.found import Found
from elastocal.diagnosis.fresh import fresh_table
from elastocal.diagnosis.heldout import left_out_residual, squared_lengths
from elastocal.diagnosis.hypotheses import Hypothesis
from elastocal.diagnosis.model_set import Item, ModelSet, beside, fit_set
from elastocal.diagnosis.noise import NoiseValues
from elastocal.diagnosis.noise_draws import noise_draws
from elastocal.diagnosis.play_law import EFFECT, under_other_law
from elastocal.diagnosis.projection import project
from elastocal.diagnosis.refit import Linear, Posterior
from elastocal.diagnosis.scene import Scene
from elastocal.diagnosis.uncertain_settings import other_settings
from elastocal.manipulator.model import Model, Regression
from elastocal.manipulator.observation import Observations, observe

Array = NDArray[np.float64]

DRAWN = 200  # fresh poses that the sets are drawn from
NOISES = 10  # values of the noise that a truth is drawn under
NUDGE = 0.01  # of a setting's grid step: a difference quotient in constants that are not parameters
WORTH_A_DRAW = 0.01  # probability from which a rival may be drawn as the truth


@dataclass(frozen=True)
class Confirmation:
    """Models before and after effects are added, and fresh poses to compare them at.

    `fitted` is the exact model with all known effects, fitted to the scene's readings; `plain` the
    cell's own model.
    """

    scene: Scene
    chosen: ModelSet
    plain: Baseline
    fitted: Baseline
    seen: Observations
    noise: tuple[NoiseValues, ...]

    @classmethod
    def of(cls, found: Found, plain: Baseline, rng: np.random.Generator) -> Confirmation:
        chosen, scene = found.chosen, found.scene
        fitted = fit_extended(scene, chosen, _known(chosen.items))
        table = fresh_table(plain.model, plain.seen.table, DRAWN, rng)
        seen = observe(table, plain.model.observe)
        noise = noise_draws(chosen.data, chosen.noise, NOISES, rng)
        return cls(scene, chosen, plain, fitted, seen, tuple(noise))

    @cached_property
    def parameters(self) -> Posterior:
        """The exact model's values, weighted by all the noise that was found."""
        measured = self._regressions(self.fitted)[0]
        return Linear.of(self.scene, self.fitted, at=measured).posterior(self.chosen.noise)

    @cached_property
    def _after(self) -> Array:
        return self._regressions(self.fitted)[1].prediction

    @cached_property
    def _known_regressions(self) -> dict[tuple[Model, bytes], tuple[Regression, Regression]]:
        return {}

    def _regressions(self, base: Baseline) -> tuple[Regression, Regression]:
        """A model at the measured rows and at the fresh ones; kept, since the truths of all items
        begin with the one that was fitted."""
        key = base.model, base.x.tobytes()
        if key not in self._known_regressions:
            self._known_regressions[key] = (
                base.model.regressor(base.seen.table, base.x, observations=base.seen),
                base.model.regressor(self.seen.table, base.x, observations=self.seen),
            )
        return self._known_regressions[key]

    def truths(self, k: int, rivals: tuple[tuple[Item, float], ...]) -> list[Truth]:
        """Errors without and with item k if the truth is item k at any plausible setting, or one
        of its `rivals`, of which itself is the first, with their probabilities."""
        others = _known(self.chosen.without(k))
        before = self._calibrated(
            fit_extended(self.scene, self.chosen, others) if others else self.plain
        )
        out = []
        for item, share in other_settings(self.scene, self.chosen, k):
            like = replace(self.chosen, items=self._with(k, item))
            at = replace(self.fitted, model=extended(self.plain.model, _known(like.items)))
            out += self._truth(at, like, item, before, rivals[0][1] * share)
        out = self._under_both_laws(k, before, out)
        for item, share in rivals[1:]:
            if share < WORTH_A_DRAW or not item.known:
                continue
            rival = fit_set(self.scene, self._with(k, item), self.chosen.noise)
            at = fit_extended(self.scene, rival, _known(rival.items))
            out += self._truth(at, rival, item, before, share)
        return out

    def _under_both_laws(self, k: int, before: Array, truths: list[Truth]) -> list[Truth]:
        """What is true if item k, where it is play, follows its law, and if it follows another."""
        doubt, item = self.scene.other_play, self.chosen.items[k]
        if not (isinstance(item.what, Hypothesis) and item.what.name == EFFECT and doubt):
            return truths
        held = [replace(t, probability=t.probability * (1 - doubt)) for t in truths]
        other = extended(under_other_law(self.plain.model), _known(self.chosen.items))
        share = doubt * sum(t.probability for t in truths)
        at = replace(self.fitted, model=other)
        return held + self._truth(at, self.chosen, item, before, share)

    def _with(self, k: int, item: Item) -> tuple[Item, ...]:
        return (*self.chosen.items[:k], item, *self.chosen.items[k + 1 :])

    @cached_property
    def unnamed(self) -> float:
        """Mean squared length (m²) of what is in the set without a name, of each block what the
        fitted parameters cannot follow: the error of configurations left out of a fit to it."""
        total = 0.0
        for k, item in enumerate(self.chosen.items):
            if not item.known:
                signal = signal_of(self.scene, self.chosen, k)
                alone = replace(beside(self.scene, self.chosen, k), r=signal)
                error = left_out_residual(project(alone, self.chosen.noise.of_instrument()))
                squares, count = squared_lengths(alone, alone.masked(error))
                total += float(squares.sum() / count.sum())
        return total

    def _calibrated(self, base: Baseline) -> Array:
        """What a model reads at the fresh poses, fitted as a calibration would that knows nothing
        of the joints' scatter; and the scatter fitted beside a missing effect is the effect,
        which weights by it would spare."""
        return base.model.predict(self.seen.table, base.x, self.seen)

    def _truth(
        self, base: Baseline, true: ModelSet, item: Item, before: Array, probability: float
    ) -> list[Truth]:
        """If that set is true, fitted as `base`, under each of the noises."""
        measured, fresh = self._by_constant(base, _known(true.items), item)
        here, at = self._regressions(base)
        linear = Linear.of(self.scene, base, measured, self._prior(true), here)
        B = np.hstack([at.B, fresh])
        start = np.append(base.x, np.zeros(measured.shape[1]))
        size = self.seen.size
        shown = min(size, 3)

        def lengths(rows: Array) -> Array:
            return rows.reshape(-1, size, *rows.shape[1:])[:, :shown]

        out = []
        for noise in self.noise:
            fit = linear.posterior(noise)
            readings = at.prediction + B @ (fit.x - start)
            out.append(
                Truth(
                    lengths(before - readings),
                    lengths(self._after - readings),
                    lengths(B @ fit.spread),
                    self.seen.configuration,
                    probability / len(self.noise),
                )
            )
        return out

    def _prior(self, true: ModelSet) -> dict[str, float]:
        """Prior deviations of the set's parameters: their typical sizes, times the scale that the
        readings prefer where the effect is larger than usual; a tie to the usual size would
        make the truth smaller than what was found."""
        out = {}
        for item, scale in zip(true.items, true.scales, strict=True):
            if isinstance(item.what, Hypothesis):
                size = self.scene.sizes[item.what.name, item.what.where] * max(scale, 1.0)
                for p, s in zip(item.what.parameters, size, strict=True):
                    out[f"{item.what.where}.{p.key}"] = float(s)
        return out

    def _by_constant(self, base: Baseline, known: list[Item], item: Item) -> list[Array]:
        """Difference quotients (rows, k) in the item's constants that vary smoothly, of the
        measured readings and of the fresh ones, each by the step of the grid it was searched on:
        it is not known better than the data tell."""
        what = item.what
        assert isinstance(what, Hypothesis)
        sets = (self.scene.base.seen, self.seen)
        columns = [np.zeros((seen.size * len(seen.lead), 0)) for seen in sets]
        for s, setting in enumerate(what.settings):
            if setting.kind == "change_time":
                continue
            grid = self.scene.grids[what.name, what.where]
            step = float(grid.step[grid.nearest(item.settings), s])
            # At a bound, where the search may well end, the quotient is one-sided.
            near = item.settings[s] + NUDGE * step * np.array([1.0, -1.0])
            near = np.clip(near, setting.lower, setting.upper)
            ends = []
            for value in near:
                moved = item.settings.copy()
                moved[s] = value
                items = [replace(i, settings=moved) if i.same_as(item) else i for i in known]
                model = extended(self.plain.model, items)
                ends.append([model.predict(seen.table, base.x, seen) for seen in sets])
            apart = float(near[0] - near[1]) / step
            slopes = [(up - down) / apart for up, down in zip(*ends, strict=True)]
            columns = [np.column_stack(pair) for pair in zip(columns, slopes, strict=True)]
        return columns


def _known(items: tuple[Item, ...]) -> list[Item]:
    return [item for item in items if item.known]
