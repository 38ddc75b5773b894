"""What a training loop of torch does to a module: several processes, filled frames, copies."""

import copy
import io
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kinds_of_terms import KINDS
from module.modules import CAMERA, frames, module_of, with_missing
from torch.func import functional_call, stack_module_state

from tofcorr.errors import ConfigError, ExportError, FrameError
from tofcorr.geometry.camera import CameraIntrinsics
from tofcorr.geometry.rays import ray_directions
from tofcorr.module.depth_correction import DepthCorrection

TERMS = "distance_polynomial", "amplitude_polynomial", "integration_time"
DISTRIBUTED = """
import sys, torch
import torch.distributed as dist
from module.modules import frames, module_of
place, rank = sys.argv[1], int(sys.argv[2])
dist.init_process_group("gloo", init_method=f"file://{place}/store", rank=rank, world_size=2)
module = module_of("distance_polynomial", "amplitude_polynomial", "integration_time")
parallel = torch.nn.parallel.DistributedDataParallel(module)
for _ in range(2):  # What the first one misses, the second one refuses.
    module.zero_grad()
    depth, amplitude = frames()
    parallel(depth[rank], amplitude[rank]).square().sum().backward()
torch.save({name: one.grad for name, one in module.named_parameters()}, f"{place}/{rank}.pt")
"""


@pytest.mark.slow
def test_two_processes_train_it_without_a_search_for_unused_parameters(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "ignore", "-c", DISTRIBUTED, str(tmp_path)]
    ranks = [
        subprocess.Popen([*command, str(rank)], cwd=Path(__file__).parents[1]) for rank in "01"
    ]
    assert [one.wait(100) for one in ranks] == [0, 0]
    module = module_of(*TERMS)
    module(*frames()).square().sum().backward()
    for rank in "01":
        for name, found in torch.load(tmp_path / f"{rank}.pt").items():
            gradient = module.get_parameter(name).grad
            expected = torch.zeros_like(found) if gradient is None else gradient / 2
            torch.testing.assert_close(found, expected)


def test_what_is_filled_has_no_gradient_and_poisons_none() -> None:
    module = module_of("distance_polynomial", "amplitude_polynomial")
    depth, amplitude = frames()
    given = with_missing(depth).requires_grad_()
    filled, usual = module(given, amplitude, fill=0.0), module(given, amplitude)
    missing = usual.isnan()
    assert torch.equal(filled, torch.where(missing, 0.0, usual))
    filled.square().sum().backward()
    assert given.grad is not None
    assert (given.grad[missing] == 0).all()
    gradients = [one.grad for one in module.error_model.parameters()]
    assert all(one is not None and bool(one.isfinite().all()) for one in gradients)


def _saved(module: DepthCorrection) -> DepthCorrection:
    content = io.BytesIO()
    torch.save(module, content)
    content.seek(0)
    return torch.load(content, weights_only=False)


COPIES: dict[str, Callable[[DepthCorrection], Callable[..., torch.Tensor]]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda module: pickle.loads(pickle.dumps(module)),
    "torch.save": _saved,
    "torch.export": lambda module: torch.export.export(module, frames()).module(),
}


@pytest.mark.parametrize("name", COPIES)
def test_a_copy_gives_the_same(name: str) -> None:
    module = module_of(*TERMS)
    assert torch.equal(COPIES[name](module)(*frames()), module(*frames()))


def test_four_cameras_in_one_batch_are_four_modules() -> None:
    modules = [module_of("distance_polynomial", "pixel_polynomial") for _ in range(4)]
    for number, module in enumerate(modules):
        module.error_model.constant.data += 0.01 * number
        module.geometry.radial_of_depth *= 1.0 + 0.1 * number
    depth, amplitude = frames((4,))
    stacked = stack_module_state(modules)
    found = torch.vmap(lambda state, *of_one: functional_call(modules[0], state, of_one))(
        stacked, depth, amplitude
    )
    expected = torch.stack([m(*one) for m, *one in zip(modules, depth, amplitude, strict=True)])
    assert torch.equal(found, expected)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_correction_of_a_crop_is_the_crop_of_the_correction(kind: str, depth_kind: Any) -> None:
    module = module_of(kind, depth_kind=depth_kind)
    part = module.crop(1, 2, 3, 4).crop(1, 0, 2, 4)
    depth, amplitude = frames()
    window = (..., slice(2, 4), slice(2, 6))
    of_part = part(depth[window], amplitude[window])
    assert torch.equal(of_part, module(depth, amplitude)[window])
    expected = module.points(depth, amplitude)[..., 2:4, 2:6, :]
    assert torch.equal(part.points(depth[window], amplitude[window]), expected)
    assert [id(one) for one in part.parameters()] == [id(one) for one in module.parameters()]
    rays = ray_directions(part.camera)
    torch.testing.assert_close(part.geometry.ray_directions, rays, rtol=0, atol=1e-12)
    with pytest.raises(ConfigError, match="is a crop or resized, and shares its parameters"):
        part.to_state()
    with pytest.raises(FrameError, match="a crop of rows 4 to 5, columns 0 to 6: the image has 5"):
        module.crop(4, 0, 2, 7)


@pytest.mark.parametrize("depth_kind", ["radial", "z"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_module_enlarged_and_binned_is_the_module(kind: str, depth_kind: Any) -> None:
    module = module_of(kind, depth_kind=depth_kind)
    again, frame = module.resize(10, 14).bin(2), frames()
    assert again.camera.matrix == pytest.approx(np.array(module.camera.matrix))
    torch.testing.assert_close(again(*frame), module(*frame), rtol=0, atol=1e-9)
    assert [id(one) for one in again.parameters()] == [id(one) for one in module.parameters()]
    # A bin of a crop is the crop of a bin.
    first, second = module.crop(2, 2, 2, 4).bin(2), module.bin(2).crop(1, 1, 1, 2)
    part = [one[..., :1, :2] for one in frame]
    torch.testing.assert_close(first(*part), second(*part), rtol=0, atol=1e-9)
    rays = ray_directions(module.camera.bin(2))
    torch.testing.assert_close(module.bin(2).geometry.ray_directions, rays, rtol=0, atol=1e-12)


def test_the_error_of_a_binned_pixel_lies_between_those_of_its_pixels() -> None:
    module, flat = module_of("pixel_polynomial"), torch.full((5, 7), 1.3)
    error = module.error(flat, flat)
    mean = torch.nn.functional.avg_pool2d(error[None], 2)[0]
    found = module.bin(2).error(flat[:2, :3], flat[:2, :3])
    # A quadratic is a quarter of its curvature less at the centre of two pixels than their mean.
    bend = (
        module.error(flat, flat).diff(n=2, dim=0)[0, 0] + module.error(flat, flat).diff(n=2)[0, 0]
    )
    torch.testing.assert_close(found, mean - bend / 8, rtol=0, atol=1e-7)


def test_pixels_of_a_binned_camera_look_between_those_of_the_camera() -> None:
    camera = CameraIntrinsics(width=7, height=4, matrix=CAMERA.matrix)
    rays, binned = ray_directions(camera), ray_directions(camera.bin(2))
    places = rays[..., :2] / rays[..., 2:]
    expected = places[:, :6].unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2))
    torch.testing.assert_close(binned[..., :2] / binned[..., 2:], expected)
    again = camera.resize(8, 14).resize(4, 7).matrix_tensor()
    torch.testing.assert_close(again, camera.matrix_tensor())


def test_a_script_of_the_module_is_refused_with_what_to_do() -> None:
    module = module_of(*TERMS)
    with pytest.raises(ExportError, match=r"write module\.export\('torchscript'"):
        torch.jit.script(module)
    with pytest.raises(FrameError, match="expected a torch tensor, got Proxy"):
        torch.fx.symbolic_trace(module)
