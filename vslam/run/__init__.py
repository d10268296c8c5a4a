"""A run over a sequence: prepare, track and record its frames, and collect the results."""
