"""The diagnosis of what is left over: hypotheses, their evidence, the verdict, the shrinkage."""

from elastocal import loaded_on_demand

ROOMS = {
    "backlash_model": "doubt under_other_backlash_model with_likelier_backlash_model",
    "baseline": (
        "Baseline Blocks VisitPlaces fit_baseline from_centre made_once prior_deviations thinned"
    ),
    "component_answer": "SumAnswer",
    "component_families": "catalogue_components driven_columns joint_curves line_families",
    "component_search": "about_sum compared_score search_components with_returned",
    "components": "Component FittedSum Sizes SumOfComponents fit_sum posed",
    "diagnose": "DiagnosisOptions write_extended_cell",
    "diagnosis": (
        "Candidate ComponentShare Curve Diagnosis EffectAt EffectGroup ExtraPlan FaultyReading "
        "FittedParameter FoundEffect Gap Location NearRepeats NoiseFloor RivalPair "
        "StructureTest Untested publish"
    ),
    "diagnosis_data": "DiagnosisData diagnosis_data_of",
    "discrimination": (
        "Discrimination VisitPool campaign_of joined load_forces rows_of visit_pool_of"
    ),
    "effect_search": "ForwardSelection SelectedEffects Slot base_score is_far relinearised",
    "evidence": "EntrySums Flips Grams Scan direct evidence_of exceedance log_prior_odds scan",
    "extra_poses": "expected expected_of_random fewest measuring_order plan_extra",
    "hypotheses": (
        "Hypothesis SettingsGrid change_times compute_columns grid_of judged_together model_keys "
        "possible with_recorded_drivers"
    ),
    "left_out": "blocks_of_time left_out_residual left_out_together squared_lengths",
    "model_set": (
        "Item ModelSet distances extended fit_extended fit_set packed_columns refine "
        "settings_to_try signal_of"
    ),
    "next_poses": "NextPoses doubts_after verdict_of with_effects_of",
    "noise_floor": (
        "NoiseValues NoisyData Weighted covariance fit_noise likelihood log_prior noise_draws "
        "posterior project"
    ),
    "reading_faults": "OutlierScreening left_out_errors screen_outliers",
    "rivals": "RivalSet Suspects alternatives with_neighbours",
    "shrinkage": ("Change Confirmation PosteriorDraw new_pose_table rms_with_interval"),
    "stated_floor": (
        "SupportedFloor describe_faulty near_pairs near_repeats noise_rms pure_error returned "
        "smooth_scatter supported_floor"
    ),
    "unknown": "Generic generic_blocks monomials waves wrenches",
    "verdict": "warnings",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
