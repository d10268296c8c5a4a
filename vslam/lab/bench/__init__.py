"""Benchmarks: a grid of sequences, perturbations, detectors and seeds.

A *cell* of the grid is one run, which has its own process.
"""
