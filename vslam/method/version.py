"""The version of the SLAM method. It changes whenever the resulting trajectories change."""

# Increment it whenever the results of the method change: tests/product/test_method_version.py fails
# if the results have changed, but the version has not.
METHOD_VERSION = 12
