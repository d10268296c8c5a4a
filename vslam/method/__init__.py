"""What happens to a frame: tracking, mapping, the search for loops and their correction."""
