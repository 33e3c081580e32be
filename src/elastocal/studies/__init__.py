"""Scripted studies: many independent tasks, on the local cores or on a Dask cluster.

A study is a folder with a `study.py` (what to compute), a `study.toml` (seed, options, columns)
and, once it has run, a Parquet dataset of results.  `study_folder` reads the folder and carries
out one task, `study_run` hands the tasks to workers, `study_results` is the dataset.

    study = read_study("experiment_design/coverage", options=["replicates=200"])
    run_study(study, "look", jobs=4)
    frame = read_results("look")
"""

from elastocal import loaded_on_demand

ROOMS = {
    "study_folder": "Study read_study",
    "study_results": "read_results",
    "study_run": "ClusterLostError StudyStop Way run_cluster run_local run_study summarise",
}
__all__ = [name for names in ROOMS.values() for name in names.split()]
__getattr__, __dir__ = loaded_on_demand(__name__, ROOMS)
