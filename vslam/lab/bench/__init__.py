"""Many runs: a grid of sequences, perturbations, detectors and seeds, each run in its process."""
