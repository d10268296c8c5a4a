"""Benchmarks: run vslam on a grid of sequences, perturbations, detectors and seeds.

A *cell* of the grid is one run of vslam. Each run has its own process.
"""
