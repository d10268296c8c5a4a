"""A run over a sequence, which prepares, tracks and records the frames and collects the results."""
