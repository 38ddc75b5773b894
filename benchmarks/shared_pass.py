"""One large recording, trained on by 1, 2 and 4 processes of torchrun.

python -m benchmarks.shared_pass [--frames 977] [--processes 1 --processes 2] [--repeats 1]

977 VGA frames are 300 million pixels and 2.4 GB on disk. Every process computes with one thread.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click

from benchmarks.scene import write_vga

_SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "train.py"


def train(recording: Path, out: Path, processes: int) -> tuple[float, dict[str, float]]:
    """Train in some processes; return seconds of the clock, all and those of each stage."""
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    arguments = ["--config", "ea", "--recording", recording, "--out", out, "--force"]
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, *launcher, _SCRIPT, *arguments],
        check=True,
        capture_output=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    seconds = time.perf_counter() - start
    return seconds, json.loads((out / "report.json").read_text())["seconds"]


@click.command()
@click.option("--frames", default=977, show_default=True)
@click.option("--processes", multiple=True, default=(1, 2, 4), show_default=True)
@click.option("--repeats", default=1, show_default=True)
def main(frames: int, processes: tuple[int, ...], repeats: int) -> None:
    """Write the recording, train on it, print."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "vga"
        write_vga(recording, frames)
        print(f"{frames * 480 * 640 / 1e6:.0f} million pixels, {os.cpu_count()} cores")
        for round_number in range(repeats):
            for number in processes:
                out = Path(folder) / f"run_{number}_{round_number}"
                seconds, stages = train(recording, out, number)
                print(f"{number} processes: {seconds:.1f} s in all, fit {stages['fit']:.1f} s")


if __name__ == "__main__":
    main()
