"""Effects, noise models and criteria of one's own.

A file or package that registers them begins with `from elastocal.plugins import …`: what such code
needs stands here, wherever it lives inside.

    from elastocal.plugins import Effect, register_effect

    class MyEffect(Effect):
        ...

    register_effect(MyEffect())

From then on `identify`, `design` and `diagnose` know the effect.  On the command line the code is
run by `[plugins] modules = ["my_effects.py"]` in the cell, or by an entry point of the group
`elastocal.plugins` of an installed package.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TypeVar

from elastocal import plugin_loader
from elastocal.cell.work_cell import Cell
from elastocal.errors import InputError
from elastocal.identification.noise_structure import NoiseModel, Readings
from elastocal.model import effects, rigid
from elastocal.model.arm import Arm, ParameterSpec, Setting, Spring
from elastocal.model.chain import Chain
from elastocal.model.effects.base import (
    Effect,
    Symbols,
    index,
    joints,
    links,
    motion_unit,
    turning_joints,
)
from elastocal.model.effects.compliances import LoadedEffect, TorqueEffect, add_deflection
from elastocal.model.effects.driven import (
    BaseMotion,
    DrivenEffect,
    JointMotion,
    LinkFrame,
    LinkLength,
    MarkerMotion,
)

__all__ = [
    "Arm",
    "BaseMotion",
    "Cell",
    "Chain",
    "DrivenEffect",
    "Effect",
    "JointMotion",
    "LinkFrame",
    "LinkLength",
    "LoadedEffect",
    "MarkerMotion",
    "NoiseModel",
    "ParameterSpec",
    "Readings",
    "Setting",
    "Spring",
    "Symbols",
    "TorqueEffect",
    "add_deflection",
    "index",
    "joints",
    "links",
    "load_plugins",
    "motion_unit",
    "register_criterion",
    "register_effect",
    "register_noise_model",
    "rigid",
    "turning_joints",
]

load_plugins = plugin_loader.load_plugins

E = TypeVar("E", bound=Effect)
N = TypeVar("N", bound=NoiseModel)
C = TypeVar("C")


def register_effect(effect: E) -> E:
    """Make an effect known to `identify`, `design` and `diagnose`.

    It acts behind the last effect of its stage; cells name it by `effect.name`.

    Raises InputError, with file and line of the call, where `effect` is none, says too little, or
    has the name of another one.
    """
    return _registered(effects.register, effect)


def register_noise_model(model: N) -> N:
    """Make a noise model known to `identify`, which tries it beside the built-in ones.

    Raises InputError, with file and line of the call, where `model` is none, or has the name of
    another one.
    """
    from elastocal.identification.noise_structure import register

    return _registered(register, model)


def register_criterion(criterion: C) -> C:
    """Make a criterion known to `design`.

    Raises InputError, with file and line of the call, where `criterion` is none, or has the name of
    another one.
    """
    from elastocal.planning.criteria import register  # type: ignore[import-not-found, unused-ignore]

    return _registered(register, criterion)


def _registered(register: Callable[[C], Any], what: C) -> C:
    """What was registered, so that a criterion's class can be decorated."""
    try:
        register(what)
        return what
    except InputError as error:
        caller = sys._getframe(2)
        file = caller.f_code.co_filename
        where = "" if file.startswith("<") else f"{file}, line {caller.f_lineno}: "
        raise InputError(f"{where}{error}") from None
