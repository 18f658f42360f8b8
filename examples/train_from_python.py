"""Trains SplitGaussian from Python; without ``--data`` on the built-in scene, a small ray-traced room.

python examples/train_from_python.py --iterations 300
python examples/train_from_python.py --data nerfds/as --preset best --iterations 10000
"""

import argparse
import dataclasses
import json
from pathlib import Path

import warpgs
from warpgs.config.presets import PRESETS


def main() -> None:
    """Reads the options, trains and prints the metrics."""
    parser = argparse.ArgumentParser(description="Train SplitGaussian from Python.")
    parser.add_argument("--data", type=Path, help="folder of a capture (default: the built-in scene)")
    parser.add_argument("--preset", choices=list(PRESETS), default="quick", help="defaults of the config")
    parser.add_argument("--iterations", type=int, default=300, help="total iterations (default: 300)")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<capture>-<preset>)")
    options = parser.parse_args()
    # Every option of `warpgs train` is a field of the config; `config.model` and its other parts are dataclasses, too.
    preset = PRESETS[options.preset]
    config = dataclasses.replace(preset, data=options.data, iterations=options.iterations, out=options.out)
    run = warpgs.train(config, log=print)
    metrics = json.loads((run.folder / "metrics.json").read_text())
    print(f"PSNR on evaluation views: {metrics['psnr']:.2f} dB")


if __name__ == "__main__":
    main()
