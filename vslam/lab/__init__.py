"""Experiments: benchmarks of many runs, stress tests, and comparisons of loop detectors on images.

SLAM does not need this package. Only the command line imports this package.
tests/test_dependencies.py checks this.
"""
