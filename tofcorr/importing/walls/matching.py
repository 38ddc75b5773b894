"""Planes of many images matched into walls, the hand-eye being unknown."""

import torch
from torch import Tensor

from tofcorr.geometry import se3
from tofcorr.importing.walls.directions import candidate_rotations, varied
from tofcorr.importing.walls.gathering import WallPlanes, gather
from tofcorr.importing.walls.joint import Joint, corrected, fit_jointly
from tofcorr.importing.walls.places import candidate_translation
from tofcorr.importing.walls.seen_planes import SeenPlanes

# Of the rotations proposed, this many are followed up: those under which places agree best.
_MOST_TRIED = 6
# And only those that agree at least this well, relative to the best. Set by hand: places of a wrong
# rotation agree by chance alone.
_WORTH_TRYING = 0.5
# A fit as good as the best, to this share: then the one nearest the guess is taken. The images
# say nothing of a difference that small.
_AS_GOOD = 0.02
_ROUNDS = 2


def match(planes: SeenPlanes, guess: Tensor, fewest: int) -> Joint:
    """Find the walls that the planes of many images show, and the hand-eye transform with them.

    Args:
        planes: The planes of all images.
        guess: A hand-eye transform (4, 4); it is tried, and decides what the images leave open.
        fewest: Images that make a wall.
    """
    few = varied(planes)
    proposed = []
    for rotation in candidate_rotations(few, guess[None, :3, :3]):
        translation, agreement = candidate_translation(few, rotation, guess[:3, 3])
        proposed.append((agreement, se3.assemble(rotation, translation)))
    proposed.sort(key=lambda one: -one[0])
    fits = [
        _followed(planes, transform, fewest)
        for agreement, transform in proposed[:_MOST_TRIED]
        if agreement >= _WORTH_TRYING * proposed[0][0]
    ]
    least = min(joint.cost() for joint in fits)
    good = [joint for joint in fits if joint.cost() <= (1 + _AS_GOOD) * least + 1e-9]
    return min(good, key=lambda joint: _turn(guess, joint.tool_from_camera))


def _turn(first: Tensor, second: Tensor) -> float:
    return float(se3.rotation_angle(first[:3, :3].T @ second[:3, :3]))


def _followed(planes: SeenPlanes, transform: Tensor, fewest: int) -> Joint:
    """Gather walls under a proposed hand-eye transform (4, 4), and fit everything."""
    walls = gather(planes, transform, fewest)
    joint = fit_jointly(planes, transform, walls)
    for _ in range(_ROUNDS):
        # Better known poses show further walls, and which walls are one.
        walls = gather(corrected(planes, joint.parameters), joint.tool_from_camera, fewest)
        again = fit_jointly(planes, joint.tool_from_camera, walls)
        if again.cost() >= joint.cost():
            break
        joint = again
    return _without_small(planes, joint, fewest)


def _without_small(planes: SeenPlanes, joint: Joint, fewest: int) -> Joint:
    """Drop walls that too few images show after all, and fit again."""
    if planes.label is not None:
        return joint
    count = [len(planes.image[joint.wall == k].unique()) for k in range(len(joint.walls))]
    kept = torch.tensor([number >= fewest for number in count], dtype=torch.bool)
    if bool(kept.all()):
        return joint
    walls = WallPlanes(joint.walls.normal[kept], joint.walls.offset[kept])
    return fit_jointly(planes, joint.tool_from_camera, walls)
