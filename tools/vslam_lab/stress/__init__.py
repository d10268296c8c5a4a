"""Stress tests. For each kind of perturbation, they find the strength at which runs fail.

The strength is found by bisection, separately for each system and seed. In the code, a *law* is a
kind of perturbation without its strength, such as fog.
"""
