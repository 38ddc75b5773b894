"""Where simulator and recording part, which effect the simulator lacks, how far adding it goes.

Everything is decided in the forward form

    measured = distance(hand-eye, pose, plane) + error(that distance, pixel, amplitude)
               + effects + noise,

whose regressors hold no measured distance: the point-to-plane residual with measured distances
among its regressors lets a robot's scale and the distance term shrink the residual together and
"explain" data in which nothing is missing. One pass over the pixels sums up each pose
(`moments`, `blocks`); whatever follows - folds, sign flips, bootstraps, pairs of effects - solves
small systems. The pose is the unit of every test; effects that few images show are tested by parts
of these (`parts`).
"""
