"""Scripted studies: many independent tasks, on the local cores or on a Dask cluster."""
