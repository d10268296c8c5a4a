"""The report of one run, which is written into the folder of the run.

JSON is for scripts. Markdown, HTML and PNG are for people.
"""
