"""The chain of a robot's joints: poses, how they move, and what is no robot description."""

from pathlib import Path

import pytest
import torch

from tofcorr.correction.export.urdf import corrected_description
from tofcorr.errors import ConfigError
from tofcorr.geometry import se3
from tofcorr.geometry.arm import Arm, PosedArm
from tofcorr.simulation.options import ArmOptions

# A gantry with a wrist: it slides along y, and turns about an axis askew at the end of a link.
_JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>{}</joint>'
GANTRY = "".join(
    [
        '<robot name="gantry">',
        _JOINT.format("rail", "prismatic", "floor", "cart", '<axis xyz="0 1 0"/>'),
        _JOINT.format("mast", "fixed", "cart", "top", '<origin xyz="0 0 2" rpy="0 0 1.5"/>'),
        _JOINT.format("wrist", "continuous", "top", "hand", '<axis xyz="0 3 4"/>'),
        _JOINT.format("lamp", "fixed", "cart", "light", ""),
        # As in ros_control: no joint of the robot.
        '<transmission><joint name="rail"><interface/></joint></transmission></robot>',
    ]
)


@pytest.fixture
def gantry(tmp_path: Path) -> Path:
    file = tmp_path / "gantry.urdf"
    file.write_text(GANTRY)
    return file


def test_a_pose_is_the_product_of_the_joints(gantry: Path) -> None:
    arm = Arm.read(gantry, "floor", "hand")
    assert (arm.names, arm.turns) == (("rail", "wrist"), [False, True])
    found = arm.poses(torch.tensor([[0.3, 0.7]], dtype=torch.float64))[0]
    mast = se3.exp(torch.tensor([0, 0, 0, 0, 0, 1.5], dtype=torch.float64))[:3, :3]
    turn = se3.exp(0.7 * torch.tensor([0, 0, 0, 0, 0.6, 0.8], dtype=torch.float64))[:3, :3]
    wanted = se3.assemble(mast @ turn, torch.tensor([0, 0.3, 2.0], dtype=torch.float64))
    assert torch.allclose(found, wanted, atol=1e-14)


@pytest.mark.parametrize("backwards", [False, True])
def test_motions_are_the_derivatives_of_poses(backwards: bool) -> None:
    arm = ArmOptions().arm(1.0)
    angles, tool = arm.placed(torch.randn(3, 6).double()), se3.exp(torch.randn(3, 6).double())
    posed = PosedArm(arm, (1, 2, 4), angles, tool, backwards)
    offsets = torch.randn(3).double()
    slope = torch.autograd.functional.jacobian(posed.poses, offsets)
    assert isinstance(slope, torch.Tensor)
    found = posed.poses(offsets)[:, None] @ posed.motions(offsets)
    assert torch.allclose(found, slope.movedim(-1, 1), atol=1e-12)


def test_a_corrected_description_at_angles_is_the_old_one_at_true_angles(
    gantry: Path, tmp_path: Path
) -> None:
    arm = Arm.read(gantry, tip="hand", tolerance=0.1)
    assert arm.names == ("rail", "mast z", "wrist")
    offsets = {"rail": 0.01, "mast z": 0.02, "wrist": -0.004}
    file = tmp_path / "corrected.urdf"
    file.write_text(corrected_description(gantry, arm, offsets))
    angles = torch.randn(4, 2).double()
    true = arm.placed(angles) + torch.tensor([*offsets.values()], dtype=torch.float64)
    assert torch.allclose(Arm.read(file, tip="hand").poses(angles), arm.poses(true), atol=1e-9)


def test_a_simulated_arm_of_other_lengths_is_that_of_a_longer_description(tmp_path: Path) -> None:
    file = tmp_path / "longer.urdf"
    text = ArmOptions().file.read_text()
    file.write_text(text.replace("0 0 0.43", "0 0 0.4307").replace('"0 0.11 0"', '"0 0.109 0"'))
    angles = torch.randn(4, 6).double()
    exact = ArmOptions(lengths_mm=(0.0, -1.0, 0.7)).exact(angles)
    assert torch.allclose(exact, Arm.read(file).poses(angles), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("</robot>", "", "is no URDF"),
        ("continuous", "floating", "joint wrist is of type 'floating'"),
        ('"0 3 4"', '"0 3"', "expected three numbers in xyz, got '0 3'"),
        ('<child link="hand"/>', "", "joint wrist has no child link"),
        ('link="light"', 'link="hand2"', r"may end at hand, hand2; name one"),
    ],
)
def test_what_is_no_chain_is_refused(gantry: Path, old: str, new: str, said: str) -> None:
    gantry.write_text(GANTRY.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        Arm.read(gantry, tip=None if "hand2" in new else "hand")
    gantry.write_text(GANTRY)
    with pytest.raises(ConfigError, match="no joint moves between 'cart' and 'top'"):
        Arm.read(gantry, "cart", "top")
