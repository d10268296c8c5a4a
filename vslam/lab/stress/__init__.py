"""Stress tests: find by bisection the strength at which runs fail, per law, system and seed.

A *law* is a kind of perturbation without its strength, such as fog or blur.
"""
