"""From images of a checkerboard to a recording with known planes, by OpenCV.

`pairs` finds depth and infrared images that belong together, `images` reads them, and `detection`
finds the board's corners. `calibration` estimates the camera intrinsics unless they are given.
`pose` estimates the pose of the board, `board_area` the pixels that see it. `agreement` compares
the depth with the pose and finds wrong units and mixed-up images. `degeneracy` reports which
quantities a board cannot separate. `views` does this for one view, `importer` for a folder.
"""
