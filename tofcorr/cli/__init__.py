"""The command line: parse, call, print.

Each command has its file. Heavy packages are imported only when a command runs.
"""
