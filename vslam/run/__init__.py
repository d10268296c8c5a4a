"""A run over a sequence: frames prepared, tracked and recorded, and what came of it."""
