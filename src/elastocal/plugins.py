"""Effects, noise models and criteria of one's own.

A file or package that registers them begins with `from elastocal.plugins import …`: what such code
needs stands here, wherever it lives inside.

    from elastocal.plugins import Effect, register_effect

    class MyEffect(Effect):
        ...

    register_effect(MyEffect())

From then on `identify`, `design` and `diagnose` know the effect.  On the command line the code is
run by `[plugins] modules = ["my_effects.py"]` in the cell and the option --plugins, or by an entry
point of the group `elastocal.plugins` of an installed package.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from elastocal.cell import Cell
from elastocal.files import REGISTERED, load_plugins
from elastocal.identification import noise_structure
from elastocal.identification.noise_structure import NoiseModel, Readings
from elastocal.messages import InputError
from elastocal.model import rigid
from elastocal.model.chain import Chain
from elastocal.model.effects import catalogue
from elastocal.model.effects.base import (
    Arm,
    BaseMotion,
    DrivenEffect,
    Effect,
    JointMotion,
    LinkFrame,
    LinkLength,
    MarkerMotion,
    ParameterSpec,
    Setting,
    Spring,
    Symbols,
    index,
    joints,
    links,
    motion_unit,
    turning_joints,
)
from elastocal.model.effects.statics import LoadedEffect, TorqueEffect, add_deflection
from elastocal.planning import criteria
from elastocal.planning.criteria import (
    CriterionInputs,
    ScenarioCriterion,
    SpectralCriterion,
    TraceCriterion,
)

__all__ = [
    "Arm", "BaseMotion", "Cell", "Chain", "CriterionInputs", "DrivenEffect", "Effect",
    "JointMotion", "LinkFrame", "LinkLength", "LoadedEffect", "MarkerMotion", "NoiseModel",
    "ParameterSpec", "Readings", "ScenarioCriterion", "Setting", "SpectralCriterion",
    "SpectralTerm", "Spring", "Symbols", "Term", "TorqueEffect", "TraceCriterion", "TraceTerm",
    "add_deflection", "index", "joints", "links", "load_plugins", "motion_unit",
    "register_criterion", "register_effect", "register_noise_model", "rigid", "turning_joints",
]  # fmt: skip

# What the relaxation needs of a criterion, it states itself, as a function of the covariance.
Term, TraceTerm, SpectralTerm = ScenarioCriterion, TraceCriterion, SpectralCriterion

E = TypeVar("E", bound=Effect)
N = TypeVar("N", bound=NoiseModel)
C = TypeVar("C", bound=type[ScenarioCriterion])
T = TypeVar("T")


def register_effect(effect: E) -> E:
    """Make an effect known to `identify`, `design` and `diagnose`.

    It acts behind the last effect of its stage; cells name it by `effect.name`.

    Args:
        effect: An object of a class derived from `Effect`.

    Returns:
        The effect itself.

    Raises:
        InputError: It is no effect, says too little, or has the name of another one; the message
            names file and line of the call.

    Examples:
        >>> from elastocal.plugins import (
        ...     DrivenEffect, JointMotion, ParameterSpec, index, turning_joints
        ... )
        >>> class SquareGear(DrivenEffect):
        ...     "δq = a q² with the commanded joint angle q; a in 1/rad."
        ...
        ...     name, stage, entry = "square_gear", "transmission", JointMotion()
        ...
        ...     def places(self, chain, cell):
        ...         return turning_joints(chain)
        ...
        ...     def parameters(self, place, chain, cell):
        ...         return (ParameterSpec("square", "1/rad", 0.0, 1e-5),)
        ...
        ...     def drive(self, arm, place, p):
        ...         return p["square"] * arm.q_commanded[index(place)] ** 2
        >>> ec.register_effect(SquareGear()).name
        'square_gear'
    """
    return _registered(catalogue.register, effect)


def register_noise_model(model: N) -> N:
    """Make a noise model known to `identify`, which tries it beside the built-in ones.

    Args:
        model: An object of a class derived from `NoiseModel`.

    Returns:
        The model itself.

    Raises:
        InputError: It is no noise model, or has the name of another one; the message names file
            and line of the call.

    Examples:
        >>> from elastocal.plugins import NoiseModel
        >>> class LoadedOrNot(NoiseModel):
        ...     "One variance for the loaded readings, one for the others."
        ...
        ...     name, description = "loaded_or_not", "one variance with the load, one without"
        ...
        ...     def components(self, readings):
        ...         loaded = readings.rows.force.any(axis=1)
        ...         return {"loaded": loaded * 1.0, "unloaded": ~loaded * 1.0}
        >>> model = ec.register_noise_model(LoadedOrNot())
    """
    return _registered(noise_structure.register, model)


def register_criterion(criterion: C) -> C:
    """Make a criterion known to `design`; usable as a decorator of its class.

    Args:
        criterion: A class derived from `ScenarioCriterion`, `TraceCriterion` or
            `SpectralCriterion`.

    Returns:
        The class itself.

    Raises:
        InputError: It is no criterion, is not complete, or has the name of another one; the
            message names file and line of the call.

    Examples:
        >>> from elastocal.plugins import TraceCriterion
        >>> @ec.register_criterion
        ... class ElbowAlone(TraceCriterion):
        ...     "Φ = std(k_3)², the variance of the compliance of joint 3."
        ...
        ...     name, unit = "elbow_alone", "rad/(N·m)"
        ...     title = "standard deviation of the compliance of joint 3"
        ...
        ...     @classmethod
        ...     def of(cls, inputs):
        ...         row = inputs.row({"joint3.compliance": 1.0})
        ...         return cls(row[None])
    """
    return _registered(criteria.register, criterion)


def _registered(register: Callable[[T], Any], what: T) -> T:
    try:
        register(what)
        REGISTERED.add(what if isinstance(what, type) else type(what))
        return what
    except InputError as error:
        caller = sys._getframe(2)
        file = caller.f_code.co_filename
        where = "" if file.startswith("<") else f"{file}, line {caller.f_lineno}: "
        raise InputError(f"{where}{error}") from None
