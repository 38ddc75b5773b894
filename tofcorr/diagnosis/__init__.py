"""Diagnosis of the sim-to-real gap: where simulator and recording differ, which effect is missing.

Everything is computed in the forward form

    measured = distance(hand-eye, pose, plane) + error(that distance, pixel, amplitude)
               + effects + noise,

whose regressors contain no measured distance. With measured distances among its regressors, the
point-to-plane residual can be made small without explaining anything: the scale of the robot and
the distance term shrink it together, and "robot kinematics" explains data that lack nothing.

One pass over the pixels sums up each pose (`sums`). Folds, sign flips, bootstraps and pairs of
effects then need only small linear systems. The pose is the unit of every test; image tiles are the
units for effects that few images show. `findings` holds the conclusions, `next` what to record
next, `rerun` the simulator run with the effects, `report` the result and its page.
"""
