"""Siamese networks that tell whether two images show one place; runs ask them without torch."""
