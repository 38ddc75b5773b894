#!/usr/bin/env bash
# The main job on a built-in simulated recording: simulate, train, evaluate, export, correct.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
out=${1:-runs/demo}
rm -rf "$out"
mkdir -p "$out"
tofcorr simulate --config configs/simulate/demo.yaml --out "$out/recording"
tofcorr train --config configs/train/ea.yaml --recording "$out/recording" --out "$out/run"
tofcorr evaluate --config configs/evaluate/paper.yaml --recording "$out/recording" --out "$out/evaluation"
tofcorr export --run "$out/run" --format lut --out "$out/corrector.npz"
tofcorr correct --model "$out/run/corrector.ts" --recording "$out/recording" --out "$out/corrected"
echo "Done. Look at $out/run/report.json, $out/evaluation, and: tensorboard --logdir $out/run/tb"
