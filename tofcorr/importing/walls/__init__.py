"""Walls without a board: found in each depth image, matched between robot poses, and estimated.

`image_planes` finds the large planes of an image. `directions` and `places` find, of all rotations
and translations of the hand-eye, those under which planes seen from many poses coincide; `joint`
then fits hand-eye and walls together. `recording` writes one frame for each image and wall.
"""
