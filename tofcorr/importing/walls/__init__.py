"""Walls without a board: found in each depth image, matched between robot poses, and estimated.

`image_planes` finds the large planes of each image. `hand_eye` finds, of all rotations and
translations of the hand-eye, those under which planes seen from many poses coincide, and fits
hand-eye and walls together. `finding` names the walls.
"""
