"""What time and order make of a plan: effects that show only once its poses stand in an order.

Poses are chosen for the other parameters, which every order shows alike.  The order then says when
each reading is made and from where each joint came, so that B holds the columns of drift, warming
and hysteresis too.  More parameters never lower Φ: the certificate's bound holds for them as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from elastocal.errors import InsufficientDataError
from elastocal.identification.start import fixed_and_free
from elastocal.measurements import STILL
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe
from elastocal.planning.execution import Execution
from elastocal.planning.information import marker_sigmas, minimal_set, observed_weights
from elastocal.planning.plan import Plan, Scheduled, predicted, remaining_rms
from elastocal.planning.setup import Known, known_before
from elastocal.planning.test_poses import TargetPoses, on_kept, prediction_rows
from elastocal.simulation.simulate import expand_plan, simulate


def clocked(execution: Execution) -> Execution:
    """With the time of each stop, in s from the beginning to the middle of its readings, and the
    sign of each joint's last motion on the way to it, 0 where it has not moved yet."""
    motion, now, stops = execution.motion, 0.0, []
    last = execution.stops[0].q if motion.home is None else motion.home
    sign = np.zeros(len(last), dtype=np.int64)
    for stop in execution.stops:
        for q in (*stop.via, stop.q):
            step = q - last
            sign = np.where(np.abs(step) > STILL, np.sign(step), sign).astype(np.int64)
            last = q
        now += stop.travel + (0.0 if stop.change_after is None else motion.load_change)
        came = sign if stop.approach is None else stop.approach
        stops.append(replace(stop, time=now + motion.dwell / 2, approach=came))
        now += motion.dwell
    return replace(execution, stops=tuple(stops))


@dataclass(frozen=True)
class ScheduledEffects:
    """The model `whole` with its effects of time and approach, of which `without` lacks some."""

    whole: Model
    without: Model

    def promised(self, plan: Plan, targets: TargetPoses, known: Known) -> Plan:
        """The plan with times and sides, and what it promises of all parameters."""
        model, spec = self.whole, self.whole.cell.design
        plan = replace(plan, model=model, execution=clocked(plan.execution))
        rows = expand_plan(plan.table(), tuple(model.cell.tool.markers), spec.repeats)
        x = model.nominal
        table = marker_sigmas(model.cell, simulate(model, rows, x, 0, noise=False))
        observed = observe(table, model.observe)
        at = model.regressor(table, x, None, observed)
        sizes = model.sizes(at.B)
        B = observed_weights(model, observed, x).apply(at.B) * sizes
        prior, stated = known_before(model, known, sizes)
        found = minimal_set(model, B, fixed_and_free(model, known.fixed), sizes, prior, stated)
        kept = found.columns
        M = B[:, kept].T @ B[:, kept] + prior[np.ix_(kept, kept)]
        own = np.isin([model.names[c] for c in kept], self.without.names)
        shown = predicted(model, found, M, len(B))
        names = dict.fromkeys(
            p.effect for p in model.parameters if p.name not in self.without.names
        )
        try:
            A = on_kept(model, prediction_rows(model, targets, x), found)
        except InsufficientDataError:
            return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), None, None))
        weight = np.sqrt(targets.weight)[:, None, None]
        R = np.asarray((weight * A).reshape(-1, A.shape[-1]))
        errors = remaining_rms(R, M), remaining_rms(R[:, own], M[np.ix_(own, own)])
        return replace(plan, predicted=shown, scheduled=Scheduled(tuple(names), *errors))
