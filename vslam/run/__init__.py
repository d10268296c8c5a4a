"""A run over a sequence. A run prepares, tracks and records the frames, and collects the
results."""
