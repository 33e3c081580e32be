"""Exports of trackers and robot controllers → the measurement table."""

from elastocal import loaded_on_demand

ROOMS = {
    "export_columns": "wanted",
    "foreign_text": "Clock Text krl_rows rapid_rows read_lines",
    "import_files": "Imported",
    "joining": "groups_alike standstills",
    "mapping_file": "preset_text read_mapping",
    "records": "Records Understood with_positions",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
