"""The command line: parse, call, print. Heavy packages are imported only when a command runs."""
