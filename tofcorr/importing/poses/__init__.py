"""Where the robot's tool was, and when: pose files of other programs, and interpolation.

`track` holds what every file becomes, one file a format reads it, and `read` finds the format.
"""
