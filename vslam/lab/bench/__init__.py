"""Benchmarks: a grid of sequences, perturbations, detectors and seeds.

A *cell* of the grid is one run. Each run has its own process.
"""
