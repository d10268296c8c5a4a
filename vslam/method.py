"""The version of the method, which stands for its trajectories."""

# Increment it whenever the results of the method change; tests/test_method_version.py detects that.
METHOD_VERSION = 2
