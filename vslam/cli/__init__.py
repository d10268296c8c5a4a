"""The command line: ``main.py`` and one file for each group of commands.

Heavy imports stay inside the commands, so that ``--help`` appears at once.
"""
