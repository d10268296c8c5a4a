"""Experiments: benchmarks of many runs, stress tests, comparisons of loop detectors on images.

Running SLAM does not need them; only the command line imports them (tests/test_dependencies.py).
"""
