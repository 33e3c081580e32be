"""Simulated measurements."""

from elastocal import loaded_on_demand

ROOMS = {
    "simulate": "draw_errors expand_plan values_from",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
