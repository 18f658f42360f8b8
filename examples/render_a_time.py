"""Renders a trained scene at a time of your choice, through a camera that it was trained with.

python examples/render_a_time.py runs/builtin-quick --time 0.5 --view 10
"""

import argparse
from pathlib import Path

import warpgs
from warpgs.files import write_png
from warpgs.visualize.images import to_bytes


def main() -> None:
    """Reads the options and writes the image."""
    parser = argparse.ArgumentParser(description="Render a trained scene at one time, as a PNG file.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--time", type=float, default=0.5, help="time in [0, 1] (default: 0.5)")
    parser.add_argument("--view", type=int, default=0, help="index of the training view whose camera is used")
    parser.add_argument("--out", type=Path, default=Path("time.png"), help="file to write (default: time.png)")
    options = parser.parse_args()
    try:
        scene = warpgs.open_run(options.run)
        capture = scene.open_capture()
    except ValueError as error:
        parser.error(str(error))
    if not 0 <= options.view < len(capture.train):
        parser.error(f"--view must be from 0 to {len(capture.train) - 1}, got {options.view}")
    camera = capture.cameras[capture.train[options.view]]
    rendering = scene.render(camera, options.time, branches=True)  # .joint, .static and .dynamic
    write_png(options.out, to_bytes(rendering.joint.image))
    print(f"{options.out}: time {options.time}, {camera.width}×{camera.height}")


if __name__ == "__main__":
    main()
