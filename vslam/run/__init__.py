"""A run over a sequence: frames are prepared, tracked and recorded, and the results collected."""
