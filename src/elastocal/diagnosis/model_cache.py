"""Models that are derived from another one, kept for as long as that one is."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from weakref import WeakKeyDictionary

from elastocal.manipulator.model import Model

MOST = 12  # models that are kept of each; those asked for last

_kept: WeakKeyDictionary[Model, dict[Hashable, Model]] = WeakKeyDictionary()


def made_once(model: Model, key: Hashable, make: Callable[[], Model]) -> Model:
    """What `make` derives from the model, or what it derived under the same `key` before.

    A diagnosis comes back to the same few models, and to write and differentiate an arm takes
    longer than to evaluate it at sixty poses.
    """
    known = _kept.setdefault(model, {})
    known[key] = known.pop(key) if key in known else make()
    while len(known) > MOST:
        known.pop(next(iter(known)))
    return known[key]
