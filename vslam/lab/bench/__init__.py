"""Many runs: a grid of sequences, perturbations, detectors and seeds, one process per run."""
