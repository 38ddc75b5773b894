"""The importers that the command line lists."""

from tofcorr.cli.main import group

group(["import", "--help"], standalone_mode=False)
