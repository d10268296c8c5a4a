"""Benchmarks: a grid of sequences, perturbations, detectors and seeds, with a process per run."""
