"""warpgs: SplitGaussian, dynamic scenes from one moving camera, on NVIDIA Warp kernels.

    import warpgs

    scene = warpgs.open_run("runs/builtin-quick")       # a trained scene
    capture = warpgs.load_capture("nerfds/as")          # cameras, images, masks, depth
    camera = capture.cameras[capture.train[0]]
    image = scene.render(camera, time=0.5).joint.image  # [H, W, 3]

Nothing heavy is imported before a name is first used.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# On CPU torch's threads would spin after each of its operations, on the cores that Warp's kernels run on by then: an
# iteration takes a third longer, and many times as long where another program needs a core. torch reads this when it is
# imported, so import warpgs first.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if TYPE_CHECKING:
    from .cameras import Camera
    from .captures.opening import load_capture
    from .config import RenderSettings
    from .distortion import Distortion
    from .model.splats import Splats
    from .rendering import render
    from .runs.opening import open_run
    from .runs.progress import Progress
    from .training.train import train

    __version__: str

__all__ = [
    "Camera",
    "Distortion",
    "Progress",
    "RenderSettings",
    "Splats",
    "__version__",
    "load_capture",
    "open_run",
    "render",
    "train",
]

_HOMES = {
    "Camera": "cameras",
    "Distortion": "distortion",
    "Progress": "runs.progress",
    "RenderSettings": "config",
    "Splats": "model.splats",
    "load_capture": "captures.opening",
    "open_run": "runs.opening",
    "render": "rendering",
    "train": "training.train",
}
"""The module of each public name."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module(".command_line.version", __name__).version()
    if name not in _HOMES:
        raise AttributeError(f"module 'warpgs' has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
