"""Light transport by a third party: Mitsuba with mitransient.

Both are of the extra `renewed`. Nothing here but `rooms`, `histograms` and `slab` imports them.
"""
