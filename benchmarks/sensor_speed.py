"""How long `tofcorr.SensorModel` takes for a VGA frame, with each effect that an image can show.

    python -m benchmarks.sensor_speed [--threads 2] [--repeats 30] [EFFECT ...]

A box on a floor, seen from above. The sensor is the shipped Kinect's in VGA: D, P and I errors,
noise with correlated neighbours, missing and saturated pixels, light; then one effect, or none.
Times are the quickest of the repeats.
"""

import time
import warnings

import click
import torch
from torch import Tensor

from benchmarks.scene import camera_of
from benchmarks.sealed.scores import table
from benchmarks.timing import timed
from tofcorr.sensor.model import SensorModel
from tofcorr.sensor.scene import ImageEffects
from tofcorr.sensor.sensor_file import SensorFile
from tofcorr.simulation.effects import CATALOGUE

HEIGHT, WIDTH, FOCAL = 480, 640, 900.0
# What differs from the shipped Kinect.
VGA = {"modulation_frequency_hz": 2e7, "camera": camera_of(HEIGHT, WIDTH)}
CONDITIONS = {
    "timestamp_s": 90.0,
    "integration_time_us": 800.0,
    "room_temperature_c": 25.0,
    "ambient": 300.0,
}


def sensor_with(name: str | None) -> SensorModel | None:
    """Return the sensor with one effect, every coefficient used; None if no image can show it."""
    values = SensorModel.load("kinect_v2").sensor.to_mapping() | VGA
    effects = []
    if name is not None:
        shape = {"height": HEIGHT, "width": WIDTH} if "pattern" in name else {}
        drawn = {"rms_m": 0.004} if name == "fixed_pattern" else {}
        terms = () if shape else CATALOGUE[name].terms(CATALOGUE[name].shape_type())
        effects = [{"name": name, **shape, **drawn}]
        # A share of the prior deviation; the time does not depend on it.
        effects[0] |= {term.name: term.prior_sd / 20 for term in terms}
    sensor = SensorFile.from_mapping(values | {"effects": effects}, "the benchmark")
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


def milliseconds(sensor: SensorModel, repeats: int) -> float:
    """Return the processor time of a frame, the least of the repeats."""
    depth, reflectivity = box_on_floor()
    generator = torch.Generator().manual_seed(1)

    def job() -> object:
        return sensor(depth, reflectivity=reflectivity, generator=generator, **CONDITIONS)

    with torch.inference_mode():
        return 1e3 * min(timed({"frame": job}, repeats, clock=time.process_time)["frame"])


@click.command()
@click.argument("effects", nargs=-1, type=click.Choice(list(CATALOGUE)), metavar="[EFFECT]...")
@click.option("--threads", default=2, show_default=True)
@click.option("--repeats", default=30, show_default=True)
def main(effects: tuple[str, ...], threads: int, repeats: int) -> None:
    """Print how long a sensor takes for a VGA frame: one row for every effect."""
    torch.set_num_threads(threads)
    warnings.simplefilter("ignore")
    rows: list[tuple[object, ...]] = []
    for name in effects or [None, *CATALOGUE]:
        sensor = sensor_with(name)
        known = "no depth image shows it"
        rows.append((name or "none", f"{milliseconds(sensor, repeats):.1f}" if sensor else known))
    click.echo(table((f"effect, {threads} threads", "processor, ms"), rows))


if __name__ == "__main__":
    main()
