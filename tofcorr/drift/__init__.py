"""Does a calibration still hold?"""
