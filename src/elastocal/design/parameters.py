"""What a plan can make certain: the parameters that some feasible pose shows, and their scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from elastocal.design.information import PoseInformation
from elastocal.errors import InputError, InsufficientDataError, option
from elastocal.identification.reduction import Reduction, reduce
from elastocal.identification.selection import WORTH_A_COLUMN
from elastocal.manipulator.effects import effect_of
from elastocal.manipulator.limits import joint_index
from elastocal.manipulator.model import Model
from elastocal.manipulator.observation import observe
from elastocal.text import did_you_mean, listed, quoted

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SURE = 1e3  # standard deviations that a typical deviation counts for where a prior is stated
SAMPLE = 2000  # poses that show what is visible: more would not change a rank
# Effects that say where things stand rather than what the arm is; D, A, E and O pass them over.


@dataclass(frozen=True)
class Estimable:
    """`reduction` over all parameters (kept, dropped, mixing), `sizes` (parameters,) and
    `structure`: the reduction that any number of poses would come to.

    Identification holds parameters that N poses show only below their noise; a plan of N poses
    must promise what identification then does.  Such are in `structure.kept` alone.
    """

    reduction: Reduction
    sizes: Array
    structure: Reduction

    @property
    def columns(self) -> IntArray:
        return self.reduction.kept


def typical_sizes(information: PoseInformation, q: Array, load: IntArray) -> Array:
    """Typical deviation (parameters,) of each parameter, as identification takes them."""
    model, x = information.model, information.scenarios[0]
    some = _sample(model, q, load)
    table = information.rows(q[some], load[some], x)
    return model.sizes(model.regressor(table, x, None, observe(table, model.observe)).B)


def estimable(
    information: PoseInformation,
    q: Array,
    load: IntArray,
    free: IntArray,
    prior: Array,
    n_poses: int,
    stated: NDArray[np.bool_] | None = None,
) -> Estimable:
    """A minimal complete set of the `free` parameters for plans of `n_poses` of the poses q (N, n).

    As identification chooses it, from a sample of the poses weighed as `n_poses` of them.  `prior`
    (parameters, parameters): information known before, scaled by `information.sizes`; parameters
    with a `stated` prior (parameters,) are kept whatever the poses show of them.
    Raises InsufficientDataError where no pose shows anything.
    """
    model = information.model
    some = _sample(model, q, load)
    first = replace(information, scenarios=information.scenarios[:1])
    blocks = first.blocks(q[some], load[some])[0]
    columns = np.searchsorted(information.columns, free)
    B = blocks.reshape(-1, blocks.shape[-1])[:, columns] * np.sqrt(n_poses / len(some))
    known = prior[np.ix_(free, free)]
    if known.any():
        values, vectors = linalg.eigh(known)
        B = np.vstack([B, np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T])
    if stated is not None:
        B = np.vstack([B, SURE * np.eye(len(free))[stated[free]]])
    structure, reduction = (
        _reduced(model, B, free, information.sizes, threshold)
        for threshold in (0.0, WORTH_A_COLUMN)
    )
    if not len(reduction.kept):
        raise InsufficientDataError(
            f"{model.cell.path or model.cell.name}: no feasible pose shows any parameter of the "
            "model; state the load that will hang ([design] loads_N), or choose other effects"
        )
    return Estimable(reduction, information.sizes, structure)


def _reduced(model: Model, B: Array, free: IntArray, sizes: Array, threshold: float) -> Reduction:
    """The reduction of B (rows, free), whose columns are scaled by sizes, over all parameters."""
    parameters = tuple(model.parameters[c] for c in free)
    local = reduce(B, np.ones(len(free)), parameters, sigma=1.0, threshold=threshold)
    kept, dropped = free[local.kept], free[local.dropped]
    mixing = local.mixing * sizes[kept][:, None] / sizes[dropped][None, :]
    return Reduction(kept, dropped, mixing, free[local.invisible])


def interest_of(model: Model, found: Estimable) -> IntArray:
    """Indices into the kept parameters that D, A, E and the indices O count.

    `[design] interest` names parameters, places or effects; by default all but base and markers.
    Raises InputError for an unknown name, InsufficientDataError where a named parameter cannot be
    seen in any feasible pose.
    """
    wanted = model.cell.design.interest
    kept = [model.parameters[c] for c in found.columns]
    where = f"{model.cell.path or model.cell.name}: [design] interest"
    if not wanted:
        own = [k for k, p in enumerate(kept) if not effect_of(p.effect).registered]
        return np.array(own or range(len(kept)), dtype=np.int64)
    chosen: set[int] = set()
    for name in wanted:
        meant = model.meant_by(name)
        if not meant:
            valid = model.all_names
            raise InputError(
                f"{where} names {quoted(name)}, which is no parameter, place or effect of the model"
                f"{did_you_mean(name, valid)}; there are {listed(valid)}"
            )
        here = [k for k, c in enumerate(found.columns) if c in meant]
        if not here:
            raise InsufficientDataError(
                f"{where} names {quoted(name)}; {why(model, found, meant[0])}"
            )
        chosen.update(here)
    return np.array(sorted(chosen), dtype=np.int64)


def why(model: Model, found: Estimable, index: int) -> str:
    """Why parameter `index` is not among the kept ones, and what would help."""
    name, r = model.names[index], found.structure
    if index in r.kept:
        return (
            f"so many poses show less of {name} than their noise, and identification would hold "
            f"it; measure more poses or repeats, or state a prior ({option('knowledge')})"
        )
    if index in r.invisible:
        return (
            f"no feasible pose shows {name}: it moves no marker in any of them; change the load's "
            f"direction or the limits, or leave it out ({option('fixed', name)})"
        )
    if index in r.dropped:
        share = np.abs(r.mixing[:, list(r.dropped).index(index)]) / found.sizes[r.kept]
        partner = model.names[r.kept[int(share.argmax())]]
        return (
            f"no set of poses tells {name} from others ({partner} moves the markers in the same "
            f"way); ask for {partner} instead, or hold one of them ({option('fixed', name)})"
        )
    return f"{name} is held; drop it from {option('fixed')}"


def _sample(model: Model, q: Array, load: IntArray) -> IntArray:
    """Indices of about SAMPLE poses, equally many of each level and load state where there are."""
    cell = model.cell
    held = [joint_index(cell, model.chain, name, "[design.levels]") for name in cell.design.levels]
    kinds, kind = np.unique(np.column_stack([q[:, held], load]), axis=0, return_inverse=True)
    each = -(-SAMPLE // len(kinds))
    found = []
    for k in range(len(kinds)):
        members = np.flatnonzero(kind.ravel() == k)
        found.append(members[:: -(-len(members) // each)])
    return np.sort(np.concatenate(found))
