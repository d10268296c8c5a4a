"""Stress tests: bisection of the strength at which runs fail, for laws, systems and seeds."""
