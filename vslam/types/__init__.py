"""Plain typed data that the parts of vslam exchange, and the geometry that it needs."""
