"""A calibrated arm in the formats that other programs read, and what each of them cannot hold."""
