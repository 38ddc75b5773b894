"""Pure functions of tensors: rays, distances, rigid transforms and planes.

Transforms are named target first, so that inner names cancel:
`world_from_camera = world_from_tool @ tool_from_camera`. Pixels count from the centre of the
top-left pixel, columns to the right and rows down, as OpenCV does. Distances are metres.
"""
