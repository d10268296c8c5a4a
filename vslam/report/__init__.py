"""The report of one run in the folder of the run. JSON is for scripts. Markdown, HTML and PNG are
for people."""
