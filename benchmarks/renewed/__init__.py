"""The generator of recordings, and the check on other physics, forms and ranges, opened once.

Written independently of the program's simulator: nothing here imports tofcorr.
"""
