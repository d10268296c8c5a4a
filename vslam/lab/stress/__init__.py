"""Stress tests. For each perturbation, they find the strength at which runs of vslam fail.

The strength is found by bisection. There is one search for each law, system and seed.

A *law* is a kind of perturbation without its strength, such as fog or blur.
"""
