"""Stress tests, which find the strength of a perturbation at which runs fail.

The strength is searched by bisection, for each law, system and seed.

A *law* is a kind of perturbation without its strength, such as fog or blur.
"""
