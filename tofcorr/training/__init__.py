"""A calibration from start to end: frames are split, fitted, measured, watched and filed."""
