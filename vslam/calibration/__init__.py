"""Camera models, calibration files and the rectification of images."""
