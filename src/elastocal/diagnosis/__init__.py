"""The diagnosis of what is left over: hypotheses, their evidence, the verdict, the shrinkage."""
