"""Colours and width that the figures of a diagnosis share."""

BLUE, RED, GREY = "#2166ac", "#b2182b", "#777777"
"""The simulator or what is explained; the recording or the gap; what is neither."""
WIDTH = 5.7
"""Width of a figure, inches: 547 pixels, so that its words can be read on a narrow page too."""
