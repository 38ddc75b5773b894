"""Small real-looking input that a user can start from, drawn by the sensor simulator.

`example` lists the examples and writes one of them, `simulated` draws what camera and robot record,
`files` and `bags` write it in the formats of other programs.
"""
