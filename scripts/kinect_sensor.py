"""Measure configs/sensor/kinect_v2.yaml anew from the images of a real Kinect v2.

    python scripts/kinect_sensor.py RECORDING [OUT.yaml]

RECORDING is what `tofcorr import checkerboard` makes of the images; docs/how-to/sensor.md has the
command.
"""

import sys
import time
from pathlib import Path

from tofcorr.data.recording import Recording
from tofcorr.observables.measure import DropoutMeasurement, NoiseMeasurement
from tofcorr.observables.read import Observed
from tofcorr.sensor.model import section_of
from tofcorr.sensor.sensor_file import (
    ErrorSection,
    SensorFile,
    dropout_section,
    light_section,
    sensor_text,
    validity_of,
)
from tofcorr.simulation.options import CameraOptions
from tofcorr.training.run import calibration_state, train

ROOT = Path(__file__).resolve().parents[1]
# Every view is fitted: the held-out error of these terms stands in docs/results/models.md.
CONFIG = {
    "name": "D+P2+log I",
    "model": {
        "terms": [
            {"kind": "distance_polynomial", "degree": 3},
            {"kind": "pixel_polynomial", "degree": 2},
            {"kind": "amplitude_polynomial", "variable": "log_amplitude", "degree": 3},
        ]
    },
    "outlier_window_mm": 80.0,
    "split": {"test_fraction": 0.0},
    "advice": 0,
}
NOT_KNOWN = (
    "No robot and no rail: truth is the pose of the printed board, so that focal length, scale of "
    "the board and slope of the distance error cannot be told apart.",
    "Intrinsics are typical ones of the model, not those of this unit.",
    "Not known: temperature, exposure, modulation frequency in use, repeats. The noise is that of "
    "neighbouring pixels.",
    "Seen: board pixels only, white and black print. The light section takes the brightest print "
    "as reflectivity 0.8.",
)


def main(recording_path: Path, out: Path) -> None:
    """Train, measure noise and missing pixels, and write the file."""
    started = time.process_time()
    recording = Recording.open(recording_path, check_contents=False)
    result = train(recording, CONFIG)
    print(f"training: {result.report['error_mm']} ({time.process_time() - started:.0f} s)")
    observed = Observed(recording)
    noise, missing = NoiseMeasurement(observed), DropoutMeasurement(observed)
    print(f"noise: {noise.curve} from {noise.source}")
    print(f"missing: {missing.model} ({missing.share:.4f} of the pixels)")
    state = calibration_state(result.data, result.options, result.fit)
    pixels = int(observed.map_frames.sum())
    terms = state.error_model.with_columns().terms
    sensor = SensorFile(
        format="tofcorr-sensor",
        version=1,
        title="Kinect v2: one unit, measured on views of a printed checkerboard.",
        measured_from=(
            f"{recording.num_frames} views of one board, {pixels} pixels on it "
            "(github.com/alberttjc/iai_kinect2, kinect_cal_data); "
            "made by scripts/kinect_sensor.py.",
            *NOT_KNOWN,
        ),
        camera=CameraOptions(**state.camera.section()),
        depth_kind=state.depth_kind,
        modulation_frequency_hz=recording.modulation_frequency,
        error=section_of(state.model().error, ErrorSection(reads="measured_distance", terms=terms)),
        noise=noise.curve,
        dropouts=dropout_section(missing.model, observed),
        light=light_section(observed),
        validity=validity_of(state.domain),
    )
    out.write_text(sensor_text(sensor), encoding="utf-8")
    print(f"{out} written ({time.process_time() - started:.0f} s of processor time)")


if __name__ == "__main__":
    given = sys.argv[1:]
    if not 1 <= len(given) <= 2:
        sys.exit(__doc__)
    default = ROOT / "configs" / "sensor" / "kinect_v2.yaml"
    main(Path(given[0]), Path(given[1]) if len(given) == 2 else default)
