"""A calibrated arm in the formats that other programs read, and what each of them cannot hold."""

from elastocal import loaded_on_demand

ROOMS = {
    "dh_table": "split",
    "export": "Exported Wish to_yaml",
    "exportable": "Conditions cost_of evaluate_pieces keep random_table",
    "joint_correction": "JointCorrection read_joint_correction",
    "mjcf_file": "MujocoRest",
    "urdf_file": "Frames read_urdf_text",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
