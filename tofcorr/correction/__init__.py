"""What is calibrated, and what runs on the robot.

`CalibrationModel` (float64) holds everything that training fits: the error model and the hand-eye
transform. `DepthCorrector` (float32) is built from it once and corrects frames; `export` writes it
for programs that do not have this package.
"""
