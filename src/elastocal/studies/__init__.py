"""Scripted studies: many independent tasks, on the local cores or on a Dask cluster.

A study is a folder with a `study.py` (what to compute), a `study.toml` (seed, options, columns)
and, once it has run, a Parquet dataset of results.  `study_folder` reads the folder and carries
out one task, `study_run` hands the tasks to workers, `study_results` is the dataset.

    study = read_study("experiment_design/coverage", options=["replicates=200"])
    run_study(study, "look", jobs=4)
    frame = read_results("look")
"""
