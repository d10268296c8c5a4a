"""Stress tests: find by bisection the strength at which runs fail, per law, system and seed."""
