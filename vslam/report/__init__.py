"""The report of one run, in its folder: JSON for scripts; Markdown, HTML and PNG for people."""
