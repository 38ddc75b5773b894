"""From images of a board to a recording with known planes, by OpenCV.

`boards` finds the board's points, `pose` estimates the camera intrinsics and the pose of the board.
`checks` compares the depth with the pose, finds wrong units and mixed-up images, and reports which
quantities a board cannot separate. `importer` does this for a folder.
"""
