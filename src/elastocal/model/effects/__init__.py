"""The effects by stage, a module each; `catalogue` has them by name."""
