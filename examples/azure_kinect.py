"""Corrected depth of an Azure Kinect: `python azure_kinect.py corrector.ts`; needs torch, pyk4a."""

import itertools
import json
import sys
from collections.abc import Iterator

import numpy as np
import torch
from pyk4a import ColorResolution, Config, DepthMode, PyK4A


def corrected_frames(
    model: str, mode: DepthMode = DepthMode.NFOV_UNBINNED
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Yield corrected depth (H, W), where it is valid, and points (H, W, 3) in metres."""
    corrector = torch.jit.load(model).eval()
    camera = json.loads(corrector.metadata())["camera"]
    device = PyK4A(Config(color_resolution=ColorResolution.OFF, depth_mode=mode))
    device.start()
    try:
        while True:
            capture = device.get_capture()
            if capture.depth is None or capture.ir is None:
                print("A capture without depth or infrared was left out.", file=sys.stderr)
                continue
            if capture.depth.shape != (camera["height"], camera["width"]):
                found = "x".join(map(str, capture.depth.shape[::-1]))
                sys.exit(f"{mode}: {found} pixels; the model is for another depth mode.")
            depth = torch.from_numpy(capture.depth.astype(np.float32) * np.float32(1e-3))
            amplitude = torch.from_numpy(capture.ir.astype(np.float32))
            with torch.inference_mode():
                corrected, valid = corrector(depth, amplitude)
                points = corrector.points(depth, amplitude)
            yield corrected, valid, points
    finally:
        device.stop()


if __name__ == "__main__":
    for depth, valid, _ in itertools.islice(corrected_frames(sys.argv[1]), 100):
        print(f"{valid.float().mean():.0%} valid, median {depth.nanmedian():.4f} m")
