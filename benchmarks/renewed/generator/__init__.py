"""The renewed generator: recordings whose physics and designs owe nothing to the program's own."""
