"""A run over a sequence: it prepares, tracks and records the frames, and collects the results."""
