"""Commands that put the real tool where the nominal arm was told to go."""

from elastocal import loaded_on_demand

ROOMS = {
    "commands": "nominal_path",
    "compensate": "Compensation commands_csv summary",
    "correction_table": "CorrectionGrid box_grid joint_grid",
    "targets": "one_target read_targets targets_at",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
