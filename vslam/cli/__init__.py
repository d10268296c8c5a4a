"""The command line: ``main.py`` and one file for each group of commands.

Slow imports are made inside the commands, so that ``--help`` appears at once.
"""
