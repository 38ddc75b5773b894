"""Corrected depth of a RealSense L515: `python realsense.py corrector.ts`.

Needs torch and pyrealsense2. The D400 series measures by stereo and has
other errors than a time-of-flight camera.
"""

import itertools
import json
import sys
from collections.abc import Iterator

import numpy as np
import pyrealsense2 as rs
import torch


def corrected_frames(model: str) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Yield corrected depth (H, W), where it is valid, and points (H, W, 3) in metres."""
    corrector = torch.jit.load(model).eval()
    camera = json.loads(corrector.metadata())["camera"]
    width, height = camera["width"], camera["height"]
    config = rs.config()
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, 30)
    config.enable_stream(rs.stream.infrared, width, height, rs.format.y8, 30)
    pipeline = rs.pipeline()
    scale = pipeline.start(config).get_device().first_depth_sensor().get_depth_scale()
    try:
        while True:
            frames = pipeline.wait_for_frames()
            images = [frames.get_depth_frame(), frames.get_infrared_frame()]
            if not all(images):
                print("A frame without depth or infrared was left out.", file=sys.stderr)
                continue
            arrays = (np.asanyarray(one.get_data()).astype(np.float32) for one in images)
            depth, amplitude = (torch.from_numpy(one) for one in arrays)
            depth *= scale
            with torch.inference_mode():
                corrected, valid = corrector(depth, amplitude)
                points = corrector.points(depth, amplitude)
            yield corrected, valid, points
    finally:
        pipeline.stop()


if __name__ == "__main__":
    for depth, valid, _ in itertools.islice(corrected_frames(sys.argv[1]), 100):
        print(f"{valid.float().mean():.0%} valid, median {depth.nanmedian():.4f} m")
