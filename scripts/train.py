"""Train a corrector: takes the arguments of `tofcorr train`."""

import sys

from tofcorr.cli.program import run

if __name__ == "__main__":
    sys.argv[1:1] = ["train"]
    run()
