"""The checks: one file each, registered in `tofcorr.plausibility.registry`."""
