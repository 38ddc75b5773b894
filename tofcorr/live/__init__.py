"""Calibration while a recording grows: frame by frame, and as a page in the browser."""
