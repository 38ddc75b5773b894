"""Whether a recording can be what it says: checked before any fit, and by `tofcorr inspect`.

A recording may keep its format and still be wrong: millimetres for metres, poses of another frame,
a mirrored image. Each check here looks at one such mistake, on a few pixels of each frame.
"""
