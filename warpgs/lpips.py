"""LPIPS v0.1 (Zhang et al. 2018): distance of pictures in the features of AlexNet, VGG-16 or SqueezeNet 1.1.

The networks are written out here, so that torchvision is not needed; their weights come from files:
``<net>_features`` of torchvision and the linear layers of the LPIPS authors, below one folder.
"""

import os
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

NetName = Literal["squeeze", "alex", "vgg"]

# The inputs, in [-1, 1], are shifted and scaled by these before the network (the LPIPS authors' scaling layer).
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

CHANNELS: dict[NetName, tuple[int, ...]] = {
    "alex": (64, 192, 384, 256, 256),
    "vgg": (64, 128, 256, 512, 512),
    "squeeze": (64, 128, 256, 384, 384, 512, 512),
}
"""Channels of the layers that are compared."""

TAPS: dict[NetName, tuple[int, ...]] = {
    "alex": (1, 4, 7, 9, 11),
    "vgg": (3, 8, 15, 22, 29),
    "squeeze": (1, 4, 7, 9, 10, 11, 12),
}
"""Index of the module after which each is taken."""

FEATURE_FILES: dict[NetName, str] = {"squeeze": "squeezenet1_1*.pth", "alex": "alexnet*.pth", "vgg": "vgg16*.pth"}
SMALLEST_SIDE = 32
"""Pixels under which the last layers of the networks have no pixel left."""


class _Fire(nn.Module):
    """SqueezeNet's module: squeeze to few channels, expand by 1×1 and 3×3 side by side."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def _squeeze() -> nn.Sequential:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    fires = [(64, 16, 64), (128, 16, 64), (128, 32, 128), (256, 32, 128)]
    fires += [(256, 48, 192), (384, 48, 192), (384, 64, 256), (512, 64, 256)]
    f = [_Fire(*sizes) for sizes in fires]
    return nn.Sequential(nn.Conv2d(3, 64, 3, 2), nn.ReLU(), pool(), *f[:2], pool(), *f[2:4], pool(), *f[4:])


def _alex() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def _vgg() -> nn.Sequential:
    modules: list[nn.Module] = []
    inputs = 3
    for block, (outputs, convolutions) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        if block:
            modules.append(nn.MaxPool2d(2, 2))
        for _ in range(convolutions):
            modules += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
    return nn.Sequential(*modules)


_FEATURES = {"squeeze": _squeeze, "alex": _alex, "vgg": _vgg}


class Lpips(nn.Module):
    """Distance of two pictures, 0 for equal ones.

    Attributes:
        net: Name of the network.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: NetName) -> None:
        super().__init__()
        self.net = net
        self.features = _FEATURES[net]()
        self.weights = nn.ParameterList([torch.ones(c) for c in CHANNELS[net]])
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None])
        self.requires_grad_(False)

    def forward(self, image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
        """Σ over layers of the mean over pixels of w · (unit features' difference)², for images in [0, 1].

        Raises:
            ValueError: If the images are smaller than 32 pixels a side.
        """
        if min(image.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"LPIPS needs {SMALLEST_SIDE} pixels a side, got {list(image.shape)}")
        x = torch.stack([image, truth]).permute(0, 3, 1, 2)
        x = (2.0 * x - 1.0 - self.shift) / self.scale
        taps = dict(zip(TAPS[self.net], self.weights, strict=True))
        total = x.new_zeros(())
        for index, module in enumerate(self.features):
            x = module(x)
            if index in taps:
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)  # keeps all-zero features finite
                difference = (unit[0] - unit[1]).square()
                total = total + (difference * taps[index][:, None, None]).sum(0).mean()
        return total


def load(folder: Path, net: NetName) -> Lpips:
    """Reads the weights of a network below ``folder``: its features and ``lpips_v0.1_<net>_lin`` or ``<net>.pth``.

    Raises:
        ValueError: If a file is missing or has other weights; the message names it.
    """
    features, linear = _one(folder, FEATURE_FILES[net]), _linear_file(folder, net)
    lpips = Lpips(net)
    state = {name.removeprefix("features."): value for name, value in _read(features).items()}
    wanted = lpips.features.state_dict().keys()
    try:
        lpips.features.load_state_dict({name: value for name, value in state.items() if name in wanted})
        heads = sorted(_read(linear).items())
        for weight, (_, value) in zip(lpips.weights, heads, strict=True):
            weight.copy_(value.reshape(weight.shape))
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{features} and {linear} are not the weights of LPIPS ({net}): {reason}") from error
    return lpips.eval()


def find(folder: Path | None) -> Lpips | None:
    """LPIPS with the first network whose weights are in a folder, or in WARPGS_LPIPS, or None if neither is given.

    Raises:
        ValueError: If a folder is given but holds the weights of no network.
    """
    given = folder or (Path(os.environ["WARPGS_LPIPS"]) if os.environ.get("WARPGS_LPIPS") else None)
    if given is None:
        return None
    for net in CHANNELS:
        if list(given.glob(FEATURE_FILES[net])) and _linear_file(given, net, required=False) is not None:
            return load(given, net)
    wanted = ", ".join(FEATURE_FILES.values())
    raise ValueError(f"{given} holds no weights of LPIPS: one of {wanted} and its lpips_v0.1_<net>_lin.pth")


def _one(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if not found:
        raise ValueError(f"{folder / pattern} is missing")
    return found[0]


def _linear_file(folder: Path, net: NetName, required: bool = True) -> Path:
    for name in (f"lpips_v0.1_{net}_lin.pth", f"{net}.pth"):
        if (folder / name).is_file():
            return folder / name
    if required:
        raise ValueError(f"{folder}/lpips_v0.1_{net}_lin.pth is missing")
    return None  # type: ignore[return-value]


def _read(path: Path) -> dict[str, Tensor]:
    """Tensors of a file; never executes anything of it."""
    try:
        return load_file(path) if path.suffix == ".safetensors" else torch.load(path, "cpu", weights_only=True)
    except Exception as error:  # torch raises a different class for each kind of damage
        raise ValueError(f"{path} can't be read as weights: {str(error).splitlines()[0]}") from error
