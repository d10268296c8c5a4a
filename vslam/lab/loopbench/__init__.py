"""Loop detectors compared on images of places, under changes of light, view and town."""
