"""Names of the planning criteria, in the order in which they are listed.

Help and completion of the command line say them without loading what the criteria, which are
`elastocal.planning.criteria`, are made of.
"""

TEST_POSE, ROBUST = "test_pose", "robust"
DETERMINANT, VARIANCES, EIGENVALUE = "D", "A", "E"
WORST_PREDICTION, PREDICTION, COMBINATION = "G", "I", "c"
OBSERVABILITY = O1, O2, O3, O4, O5 = "O1", "O2", "O3", "O4", "O5"
NAMES = (
    TEST_POSE, ROBUST, DETERMINANT, VARIANCES, EIGENVALUE, WORST_PREDICTION, PREDICTION,
    COMBINATION, *OBSERVABILITY,
)  # fmt: skip
