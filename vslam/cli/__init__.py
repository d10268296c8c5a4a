"""The command line, with one file for each group of commands. The entry point is ``main.py``.

Slow imports are made inside the commands, so that ``--help`` appears at once.
"""
