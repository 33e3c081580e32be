"""Scripted studies: many independent tasks, on the local cores or on a Dask cluster.

A study is a folder with a `study.py` (what to compute), a `study.toml` (seed, options, columns)
and, once it has run, a Parquet dataset of results.  The way of a task:

    definition → package (what a worker needs) → job → execution → recorder → dataset

`local` and `cluster` hand jobs to workers; they know nothing of what a job computes, and only
the one process that the user started writes.
"""
