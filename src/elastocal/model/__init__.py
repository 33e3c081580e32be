"""The symbolic manipulator: nominal chain, effects on it, exact B_i for whole tables."""

from elastocal import loaded_on_demand

ROOMS = {
    "arm": "Arm Parameter ParameterSpec Setting row_inputs usual_sizes",
    "calibrated": "CalibratedArm nominal_flange_rows read_calibrated",
    "calibrated_tool": "CalibratedTool ToolPoint share_of_levels tool_point",
    "chain": "Chain Joint LinkMass finite_ranges joint_index joint_limits",
    "choice": "choose_effects load_chain",
    "dh": "read_dh",
    "effects": "effect_of register",
    "evaluate": (
        "BackendReport BatchFunction chosen_backend row_blocks run_blocks summary thread_count"
    ),
    "inverse_kinematics": "Postures",
    "manipulator": "Model",
    "mjcf": "MjcfArm read_mjcf",
    "observations": "Observations observe pair_loaded_with_unloaded subset",
    "rigid": "nominal_flange nominal_flanges",
    "symbolic": "SymbolicArm configuration_rows",
    "urdf": "check_urdf read_urdf",
    "valued": "Conditions Valued arm_with random_table unstated_needs",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
