"""Recordings from images of other programs.

`registry` lists the importers. Each prepares its views; `run` writes the recording and its report
for all of them. Images of a moving robot go through `posed`, those of a board through
`checkerboard`.
"""

import os

# A file of a megabyte may hold an image of gigabytes. OpenCV reads this limit when it is imported;
# 64 megapixels are four times what a large depth camera has.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))
