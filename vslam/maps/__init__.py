"""Map files, and the export of maps to other programs."""
