"""`python -m tofcorr`: the same program as `tofcorr`."""

from tofcorr.cli.main import main

if __name__ == "__main__":
    main()
