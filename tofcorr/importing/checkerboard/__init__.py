"""Everything OpenCV: from images of a board to a recording with known planes.

`pairs` finds depth and infrared images that belong together, `images` reads them, `detection` finds
the board's corners, `calibration` or `intrinsics_file` says how the camera projects, `pose` tells
where the board stands, `board_area` which pixels look at it. `agreement` holds the depth against
the pose to find wrong units and mixed-up images, `degeneracy` says what a board cannot tell apart,
and `checkerboard` puts it together, with `report` for what there is to know afterwards.
"""
