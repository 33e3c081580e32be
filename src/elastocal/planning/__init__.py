"""Measurement plans: criteria, certified relaxation, exchange, polish, feasibility, order."""

from elastocal import loaded_on_demand

ROOMS = {
    "bodies": (
        "Body Pair capsule_between cell_bodies coal_shape data_base few_points hull mesh_hull "
        "rotation_to support touches"
    ),
    "candidates": "Candidates JointSpace draw feasible joint_space sobol",
    "checkpoint": "Checkpoint Stage key_of",
    "choices": "Choice Chosen",
    "collision": "Collisions Kinematics MotionBound StaticTorque arm_configuration arm_model",
    "criteria": (
        "DeterminantCriterion GCriterion SpectralCriterion TraceCriterion criterion_named "
        "make_criterion register"
    ),
    "criterion": "Criterion CriterionInputs ScenarioCriterion candidate_sums",
    "arrangement": "Selection ordered",
    "design": "DesignOptions DesignSearch Effort",
    "doubts": "in_doubt missing",
    "exact_plan": "Prices efficient_rounding round_weights size_curve",
    "drift": "Alias Drifting",
    "execution": "greedy_tour held_karp_bound schedule shortest_tour tour_bound tour_cost",
    "feasibility": "Feasibility PoseFeasibility",
    "information": "Estimable LoadStates PoseInformation load_states measured next_number rows_of",
    "moves": "Blockers Unreachable",
    "plan": (
        "Certificate Chance Gain Plan PlanRows PlanSize plan_rows predicted reasons write_plan "
        "write_plan_json"
    ),
    "polish": (
        "Goal LocalSearch PlanValue Searches Sensitivity estimate excess margins search_all "
        "signed_distance smooth_min sphere_cover symbolic_blocks"
    ),
    "programs": "krl_program load_name number plain urscript_program",
    "relaxation": "CandidatePool pieces_of relax",
    "selection": (
        "DesignProblem Exchanged best_addition efficiency fitted greedy_plan "
        "information_without largest_sum lower_bound random_plan regular_plan tangent_bound "
        "values_without"
    ),
    "setup": "FeasiblePool Known Setup set_up shares_of",
    "test_poses": "TargetPoses check_cell prediction_rows",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
