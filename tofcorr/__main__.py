"""`python -m tofcorr`: the same program as `tofcorr`."""

from tofcorr.cli.program import run

if __name__ == "__main__":
    run()
