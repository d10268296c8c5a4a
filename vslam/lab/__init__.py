"""The laboratory: many runs and their page, stress tests, loop detectors on images.

No run needs it: only the command line imports it (tests/test_dependencies.py).
"""
