"""Train a corrector: takes the arguments of `tofcorr train`."""

import sys

from tofcorr.cli.main import main

if __name__ == "__main__":
    sys.argv[1:1] = ["train"]
    main()
