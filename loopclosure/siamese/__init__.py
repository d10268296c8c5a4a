"""Siamese networks that tell whether two images show one place. Only here is torch imported."""
