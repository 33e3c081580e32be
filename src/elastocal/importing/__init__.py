"""Exports of trackers and robot controllers → the measurement table."""

from elastocal import loaded_on_demand

ROOMS = {
    "assemble": "Imported",
    "foreign_text": "Clock Text krl_rows rapid_rows read_lines",
    "joining": "dwells groups_alike",
    "mapping_file": "preset_text read_mapping wanted",
    "records": "Records Understood with_positions",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
