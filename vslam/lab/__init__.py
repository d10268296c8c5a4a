"""The laboratory: benchmarks of many runs, stress tests, loop detectors compared on images.

No run needs it; only the command line imports it (tests/test_dependencies.py).
"""
