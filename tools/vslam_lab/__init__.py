"""Experiments: benchmarks of many runs, stress tests, and comparisons of loop detectors on images.

The SLAM system itself does not need this package. Only the command line imports it.
``tests/project/test_dependencies.py`` checks that no other package imports it.
"""
