"""The command line: parse, call, print.

One file a command; heavy imports wait until a command runs.
"""
