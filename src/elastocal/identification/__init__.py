"""The weighted identification: least squares on B, noise, intervals, faulty readings."""
