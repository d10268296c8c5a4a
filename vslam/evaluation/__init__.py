"""How good a run is: its trajectory, and its loops."""
