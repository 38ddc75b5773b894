"""One large recording, trained on by 1, 2 and 4 processes of torchrun.

python -m benchmarks.shared_pass [--frames 977] [--processes 1 --processes 2]

977 VGA frames are 300 million pixels and 2.4 GB on disk. Every process computes with one thread.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from benchmarks.scene import write_vga

_SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "train.py"


def train(recording: Path, out: Path, processes: int) -> dict[str, float]:
    """Train in some processes; return the seconds of each stage."""
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    arguments = ["--config", "ea", "--recording", recording, "--out", out, "--force"]
    subprocess.run(
        [sys.executable, *launcher, _SCRIPT, *arguments],
        check=True,
        capture_output=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    return json.loads((out / "report.json").read_text())["seconds"]


@click.command()
@click.option("--frames", default=977, show_default=True)
@click.option("--processes", multiple=True, default=(1, 2, 4), show_default=True)
def main(frames: int, processes: tuple[int, ...]) -> None:
    """Write the recording, train on it, print."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "vga"
        write_vga(recording, frames)
        print(f"{frames * 480 * 640 / 1e6:.0f} million pixels, {os.cpu_count()} cores")
        for number in processes:
            stages = train(recording, Path(folder) / f"run_{number}", number)
            print(f"{number} processes: fit {stages['fit']:.1f} s")


if __name__ == "__main__":
    main()
