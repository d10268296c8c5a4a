"""Experiments: benchmarks of many runs, stress tests, comparisons of loop detectors on images.

Running SLAM does not need this package; only the command line imports it
(tests/test_dependencies.py).
"""
