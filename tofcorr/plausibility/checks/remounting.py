"""Does the camera sit at one place on the tool throughout?"""

from tofcorr.plausibility import camera_parts, frame_offsets
from tofcorr.plausibility.camera_step import CameraStep
from tofcorr.plausibility.finding import Finding, in_words
from tofcorr.plausibility.look import Look


def check(look: Look) -> list[Finding]:
    """Judge the step of the camera on the tool, at one moment or for frames in any order."""
    if look.step is not None:
        first = _numbers(look, look.step)[0]
        where = f"From frame {first} on, or about there,"
        cause = "it was knocked or mounted anew, or poses and images are of different times"
        return [_finding(look.step, where, cause)]
    if look.parts is not None:
        where = f"In {in_words(_numbers(look, look.parts))}"
        cause = "some poses are of another frame of the robot, such as its flange"
        return [_finding(look.parts, where, cause)]
    return _not_looked_for(look)


def _not_looked_for(look: Look) -> list[Finding]:
    """Say what cannot be seen where the poses are too few."""
    if look.linear is None or not look.scene.moves:
        return []
    poses = len(frame_offsets.one_of_each_pose(look.scene.poses))
    if poses >= camera_parts.FEWEST:
        return []
    unseen = f"some poses are of another frame of the robot ({camera_parts.FEWEST} are needed)"
    if poses < frame_offsets.FEWEST:
        unseen = f"the camera moved on the tool ({frame_offsets.FEWEST} are needed) or {unseen}"
    sentence = f"{poses} distinct poses are too few to see whether {unseen}."
    return [Finding("remounting", "note", sentence)]


def _numbers(look: Look, found: CameraStep) -> list[int]:
    return look.frames[look.scene.known][found.frames].tolist()


def _finding(found: CameraStep, where: str, cause: str) -> Finding:
    return Finding(
        "remounting",
        "doubtful",
        f"{where} the points lie {1e3 * found.size:.0f} mm elsewhere, as if the camera had moved "
        f"on the tool (two hand-eye transforms explain {100 * found.share:.0f} % of what one "
        f"leaves): {cause}; train the parts apart.",
        spoils=True,
    )
