"""The weighted identification: least squares on B, noise, intervals, faulty readings."""

from elastocal import loaded_on_demand

ROOMS = {
    "constrained": "ActiveConstraint constrained_fit minimise",
    "constrained_solver": "ConstrainedObjective ResidualLoss",
    "covariance": "Covariance cluster_robust hc t_quantile",
    "error_budget": "BudgetStep gap_budget",
    "faulty_readings": "FaultyGroup OutlierReport outlier_report",
    "findings": "judged next_steps standings warning_sentences",
    "intervals": "cluster_by_parts profile_interval profile_of worth_clustering",
    "knowledge": (
        "Bounds Constraints GaussianPrior Knowledge KnowledgeTable LinearEquality "
        "SemidefiniteMatrix equal non_negative physical_constraints read_knowledge "
        "share_of_prior"
    ),
    "knowledge_fit": ("degrees_of_freedom profile_fit_interval profile_linear_interval"),
    "least_squares": "FitProblem SumOfSquares descend fit",
    "linear_solver": "solve_weighted",
    "trimmed": "least_trimmed_squares majority",
    "noise_choice": "Trial estimate_noise outlier_screening own_noise unexplained_readings",
    "noise_structure": (
        "NoiseModel Readings by_axis by_group independent noise_models shared_effects"
    ),
    "noise_summary": "LackOfFit Noise NoiseSize lack_of_fit",
    "options": "Method Options",
    "outliers": "Outlier blocks describe find_faulty verdict",
    "prediction": "NewPoses Position PredictedError Uncertainty position_at predicted_error",
    "published": "eq14 eq14_weights group_sigma ols wls",
    "reml": "LogPrior evaluate kenward_roger prior_of_groups slope stacks",
    "residuals": (
        "ResidualSummary held_out_by_parts held_out_residual normal_scores rms_3d "
        "simultaneous_level summarise_residuals"
    ),
    "result": "Calibration Combination Finding TestErrors Verdict",
    "robust": (
        "Absolute Bisquare Huber StudentT asymptotic_covariance bisquare clustered_covariance "
        "design huber log_likelihood m_estimate robust_fit student_t tukey"
    ),
    "solve": "Problem Reduction Solution reduce residual_sigma sizes_and_check",
    "start": "RegistrationProblem check_limits check_table fixed_and_free register start_values",
    "weighted_problem": (
        "Evaluation Partition RFactor Weights merge part_of scaled_by_component weights_for"
    ),
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
