"""How long `tofcorr.SensorModel` takes for a VGA frame, with each effect that an image can show.

    python -m benchmarks.sensor_speed [--threads 2] [--repeats 30] [EFFECT ...]

A box on a floor, seen from above. The sensor has D, P and I errors, noise with correlated
neighbours, missing and saturated pixels, and light; then one effect, or none. Times are the
quickest of the repeats; `frames/s` is by the clock, which other programs on the machine slow down.
"""

import argparse
import time
import warnings
from typing import Any

import torch
from torch import Tensor

from tofcorr.sensor.effects import ImageEffects
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.simulation.effects import CATALOGUE

HEIGHT, WIDTH, FOCAL = 480, 640, 525.0
# Every coefficient of an effect, as a share of its prior deviation (no unit). Chosen: small
# errors; the time does not depend on it.
_STRENGTH = 0.05
_SENSOR: dict[str, Any] = {
    "format": "tofcorr-sensor",
    "version": 1,
    "camera": {
        "width": WIDTH,
        "height": HEIGHT,
        "K": [[FOCAL, 0.0, 319.5], [0.0, FOCAL, 239.5], [0.0, 0.0, 1.0]],
        "distortion": [0.05, -0.1, 0.0, 0.0, 0.0],
    },
    "depth_kind": "z",
    "modulation_frequency_hz": 2e7,
    "error": {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
            {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 3},
        ],
        "coefficients": {
            "distance": {"c0": 0.03, "c1": -0.02, "c2": 0.008, "c3": -0.001},
            "pixel": {"p1": 2e-8, "r0": 200.0, "p2": -1e-8, "c0": 300.0},
            "intensity": {"l1": 0.01, "l2": -0.002, "l3": 1e-4},
        },
    },
    "noise": {
        "floor_m": 0.001,
        "shot_m": 0.003,
        "read_m": 0.001,
        "reference_amplitude": 800.0,
        "correlation_px": 1.0,
        "fixed_share": 0.1,
    },
    "dropouts": {
        "base_share": 0.001,
        "amplitude_at_half": 60.0,
        "width": 0.2,
        "saturation_amplitude": 20000.0,
        "saturated_share": 0.9,
    },
    "light": {"amplitude_at_1m": 4000.0},
    "validity": {
        "radial_distance_m": [0.4, 4.0],
        "amplitude": [50.0, 20000.0],
        "normalised_amplitude": [50.0, 20000.0],
    },
}
_CONDITIONS = {
    "timestamp_s": 90.0,
    "integration_time_us": 800.0,
    "room_temperature_c": 25.0,
    "ambient": 300.0,
}


def sensor_with(name: str | None) -> SensorModel | None:
    """Return the sensor with one effect, every coefficient used; None if no image can show it."""
    effects = []
    if name is not None:
        shape = {"height": HEIGHT, "width": WIDTH} if "pattern" in name else {}
        drawn = {"rms_m": 0.004} if name == "fixed_pattern" else {}
        terms = () if shape else CATALOGUE[name].terms(CATALOGUE[name].shape_type())
        effects = [{"name": name, **shape, **drawn}]
        effects[0] |= {term.name: _STRENGTH * term.prior_sd for term in terms}
    sensor = SensorFile.from_mapping({**_SENSOR, "effects": effects}, "the benchmark")
    shown = ImageEffects(sensor.intrinsics(), sensor.effects, sensor.modulation_frequency_hz)
    return None if shown.left_out else SensorModel(sensor)


def box_on_floor() -> tuple[Tensor, Tensor]:
    """Return depth along the optical axis (H, W), metres, and a checkered reflectivity."""
    row, column = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    down = (row - HEIGHT / 2) / FOCAL
    depth = (0.9 / (down.clamp(min=0.05) + 0.3)).clamp(max=3.5)
    box = (column - 320).abs() + (row - 260).abs() < 120
    reflectivity = torch.where((column // 20 + row // 20) % 2 == 0, 0.7, 0.2)
    return torch.where(box, 1.2, depth).float(), reflectivity.float()


def milliseconds(sensor: SensorModel, repeats: int) -> tuple[float, float]:
    """Return processor and clock milliseconds of a frame, each the least of the repeats."""
    depth, reflectivity = box_on_floor()
    generator = torch.Generator().manual_seed(1)
    spent = []
    with torch.inference_mode():
        for _ in range(repeats + 1):
            start = time.process_time(), time.perf_counter()
            sensor(depth, reflectivity=reflectivity, generator=generator, **_CONDITIONS)
            spent.append((time.process_time() - start[0], time.perf_counter() - start[1]))
    return tuple(1e3 * min(column) for column in zip(*spent[1:], strict=True))  # type: ignore[return-value]


def main() -> None:
    """Print one row for every effect."""
    parser = argparse.ArgumentParser(description="How long a sensor takes for a VGA frame.")
    parser.add_argument("effects", nargs="*", choices=[*CATALOGUE, []], metavar="EFFECT")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=30)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    warnings.simplefilter("ignore")
    print(f"{'effect':>20}  processor, ms  clock, ms  frames/s   ({given.threads} threads)")
    for name in given.effects or [None, *CATALOGUE]:
        sensor = sensor_with(name)
        if sensor is None:
            print(f"{name:>20}  no depth image shows it")
            continue
        processor, clock = milliseconds(sensor, given.repeats)
        print(f"{name or 'none':>20}  {processor:13.1f}  {clock:9.1f}  {1e3 / clock:8.1f}")


if __name__ == "__main__":
    main()
